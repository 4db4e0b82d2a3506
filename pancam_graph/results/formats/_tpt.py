"""Tie points of marsnav: `.tpt` as XML and as the older text."""

from collections import Counter
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import (
    Constraint,
    FramePoint,
    LandmarkAzimuth,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPosition,
    State,
    Traverse,
)
from pancam_graph.io.vicar import AdjustedTie, ReferenceFrame, Tie, TieFile, tie_text, tie_xml
from pancam_graph.results.formats._source import Source
from pancam_graph.results.formats._vicar import nearest_points, pairs_of_tracks, site_frame, site_xyz

__all__ = ["tie_file", "write_tpt", "write_tpt_text"]

_FRAME = "SITE"


def write_tpt(source: Source, path: Path) -> None:
    """Write a `.tpt`, XML: a tie for each two images that follow each other on a track, and constraints.

    Raises InputError without observations.
    """
    path.write_text(tie_xml(tie_file(source)), encoding="utf-8", newline="\n")


def write_tpt_text(source: Source, path: Path) -> None:
    """Write a `.tpt`, text: the ties alone; images are counted from 0 in their order."""
    file = tie_file(source)
    pairs = [tie for tie in file.ties if tie.type == 0]
    if len(pairs) < len(file.ties):
        source.warnings.append(
            f"tpt-text: the older text has no constraints; {len(file.ties) - len(pairs)} left out"
        )
    path.write_text(tie_text(pairs), encoding="utf-8", newline="\n")


def tie_file(source: Source) -> TieFile:
    """The ties of a source."""
    traverse = source.solution.traverse
    frame = site_frame(source, _FRAME)
    known: dict[int, list[Constraint]] = {}
    lost: Counter[str] = Counter()
    seen_once: list[Tie] = []
    for constraint in traverse.constraints:
        if isinstance(constraint, FramePoint):
            seen_once.append(_fiducial(traverse, constraint, frame))
            continue
        tracks = [traverse.track_of(landmark) for landmark in constraint.landmarks]
        if len(tracks) == 1 and tracks[0] is not None and _says(constraint):
            known.setdefault(tracks[0], []).append(constraint)
        else:
            lost[constraint.kind] += 1
    ties: list[Tie] = []
    for track, rows in pairs_of_tracks(source):
        mine = known.get(track, [])
        ties += _pairs(source, track, rows, mine, frame)
        for constraint in mine:
            singles = _singles(source, track, rows, constraint, frame)
            ties += singles
            # Angles are from a stop: without an image of it that sees the point there is no tie.
            lost[constraint.kind] += bool(constraint.stops) and not singles
    if not ties:  # what one image sees joins nothing
        raise InputError("tpt: expected observations that join two images, found none")
    each = ", ".join(f"{count} {kind}" for kind, count in lost.items() if count)
    if each:
        source.warnings.append(f"tpt: ties of marsnav have no equal of some constraints, left out: {each}")
    images: dict[int, str | None] = {row: who.unique_id for row, who in enumerate(source.identities)}
    return TieFile(images=images, ties=(*ties, *seen_once), frames=(frame,))


def _says(constraint: Constraint) -> bool:
    """Whether a type of tie says what a constraint on a point does."""
    if isinstance(constraint, LandmarkPosition):
        return constraint.axes.tolist() in ([0, 1, 2], [0, 1])
    return isinstance(constraint, LandmarkHeight | LandmarkInfinity | LandmarkAzimuth | LandmarkElevation)


def _pairs(
    source: Source, track: int, rows: IntArray, constraints: list[Constraint], frame: ReferenceFrame
) -> list[Tie]:
    """A tie for each two images that follow each other; infinity and height are types of their own."""
    observations = source.solution.traverse.observations
    assert observations is not None  # there are rows
    kind, xyz = 0, None
    for constraint in constraints:
        if isinstance(constraint, LandmarkInfinity):
            kind = 3
        elif isinstance(constraint, LandmarkHeight):
            kind, xyz = 8, (None, None, -constraint.height_m)
    ties = []
    for left, right in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        ties.append(
            Tie(
                type=kind,
                left=int(observations.image[left]),
                left_uv=_uv(observations.uv_px[left]),
                right=int(observations.image[right]),
                right_uv=_uv(observations.uv_px[right]),
                xyz=xyz,
                track=track,
                adjusted=_adjusted(source, left, right) if source.is_solved else None,
                frame=frame,
            )
        )
    return ties


def _singles(
    source: Source, track: int, rows: IntArray, constraint: Constraint, frame: ReferenceFrame
) -> list[Tie]:
    """A tie of each image that sees a point whose position, azimuth or elevation is known."""
    traverse = source.solution.traverse
    observations = traverse.observations
    assert observations is not None  # there are rows
    kind, angle = 1, None
    xyz: tuple[float | None, float | None, float | None] | None = None
    if isinstance(constraint, LandmarkPosition):
        x, y, z = constraint.position_m
        assert x is not None and y is not None  # `_says` has looked
        kind, xyz = 1 if z is not None else 4, (x, -y, None if z is None else -z)
    elif isinstance(constraint, LandmarkAzimuth):
        kind, angle = 6, float(np.rad2deg(-constraint.azimuth_rad) % 360.0)
    elif isinstance(constraint, LandmarkElevation):
        kind, angle = 7, float(np.rad2deg(constraint.elevation_rad))
    else:
        return []
    images = observations.image[rows]
    if angle is not None:
        stops = np.array([traverse.stops[s].id for s in traverse.image_stop[images]])
        rows = rows[stops == constraint.stops[0]]
    return [
        Tie(
            type=kind,
            left=int(observations.image[row]),
            left_uv=_uv(observations.uv_px[row]),
            xyz=xyz,
            angle_deg=angle,
            track=track,
            frame=frame,
        )
        for row in rows.tolist()
    ]


def _fiducial(traverse: Traverse, point: FramePoint, frame: ReferenceFrame) -> Tie:
    """The tie of a known place that one image sees."""
    image = traverse.image_of(point)
    assert image is not None  # the traverse has looked
    return Tie(
        type=1,
        left=image,
        left_uv=(point.u_px, point.v_px),
        xyz=_xyz(site_xyz(point.place_m)),
        frame=frame,
    )


def _adjusted(source: Source, left: int, right: int) -> AdjustedTie | None:
    """What an adjustment made of a tie; None without a terrain point."""
    solution = source.solution
    landmark = int(solution.landmark_row[left])
    numbers = np.stack(
        [
            of[row]
            for row in (left, right)
            for of in (solution.residual_initial_px, solution.residual_final_px)
        ]
    )
    if (
        landmark < 0
        or not np.isfinite(numbers).all()
        or not np.isfinite(solution.final.landmarks_m[landmark]).all()
    ):
        return None
    before, init_miss = _met(source, solution.initial, left, right)
    _, final_miss = _met(source, solution.final, left, right)
    return AdjustedTie(
        residuals=tuple(_uv(number) for number in numbers),
        init_miss_m=init_miss,
        final_miss_m=final_miss,
        init_xyz=_xyz(site_xyz(before)),
        final_xyz=_xyz(site_xyz(solution.final.landmarks_m[landmark])),
    )


def _met(source: Source, state: State, left: int, right: int) -> tuple[FloatArray, float]:
    """Where the lines of sight of two observations are nearest, and by how far they pass each other."""
    observations = source.solution.traverse.observations
    assert observations is not None  # there are rows
    ends = []
    for row in (left, right):
        image = int(observations.image[row])
        R, t = state.world_R_camera[image], state.world_t_camera[image]
        rays = source.solution.image_cameras[image].unproject(observations.uv_px[[row]])
        ends += [R @ rays.origin_m[0] + t, R @ rays.direction[0]]
    return nearest_points(*ends)


def _uv(pixel: FloatArray) -> tuple[float, float]:
    return float(pixel[0]), float(pixel[1])


def _xyz(point: FloatArray) -> tuple[float, float, float]:
    return float(point[0]), float(point[1]), float(point[2])
