"""Files of VICAR taken into a traverse: ties become observations and constraints, pointings telemetry."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, wrap_angle
from pancam_graph.data import (
    Constraint,
    FramePoint,
    LandmarkAzimuth,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPosition,
    Observations,
    Traverse,
)
from pancam_graph.io._json import prefixed
from pancam_graph.io._site_files import rover_poses
from pancam_graph.io.vicar._identity import PictureIdentity, picture_identities
from pancam_graph.io.vicar._nav_file import NavFile
from pancam_graph.io.vicar._tie_file import PAIR_TYPES, TIE_TYPES, Tie, TieFile

__all__ = ["Mark", "TieSigmas", "image_rows", "joined", "with_pointing", "with_rovers", "with_ties"]

_SITE_NAMES = {"SITE", "SITE_FRAME"}
_IN_SITE = frozenset({1, 4, 5, 6, 7, 8})
"""Types whose numbers are in the frame of the set."""
_NAMED = 3
_SLIDES_PX = 1000.0
"""Standard deviation of a one-dimensional tie along its line."""
_ROUND = 0.05
"""Share of its variances by which the covariance of a place may differ from that of a sphere."""
_SAME_POINTING_RAD = 1e-4
"""Pointings of one frame by several images that differ by less are one."""


@dataclass(frozen=True, kw_only=True)
class TieSigmas:
    """Standard deviations of what ties say, which their files do not tell: our stated assumptions."""

    pixel_px: float = 0.5
    """Of a mark."""
    fiducial_m: float = 0.01
    """Of each coordinate of a fiducial."""
    orbital_m: float = 0.5
    """Of a point of an orbital map."""
    angle_rad: float = 2e-3
    """Of an azimuth or an elevation."""
    height_m: float = 0.05
    """Of a Z surface."""


TIE_SIGMAS = TieSigmas()


@dataclass(frozen=True, kw_only=True)
class Mark:
    """A pixel of a point in an image."""

    image: int
    """Row of the image."""
    uv: tuple[float, float]
    covariance_px2: tuple[float, float, float]
    """Entries uu, uv, vv."""


class _Groups:
    """Which things are one point: joined in any order."""

    def __init__(self) -> None:
        self._above: dict[object, object] = {}

    def first(self, thing: object) -> object:
        """What stands for the group of a thing."""
        path = []
        while (above := self._above.setdefault(thing, thing)) != thing:
            path.append(thing)
            thing = above
        for one in path:
            self._above[one] = thing
        return thing

    def join(self, things: Iterable[object]) -> None:
        """Make these one group."""
        firsts = [self.first(thing) for thing in things]
        for other in firsts[1:]:
            self._above[other] = firsts[0]


def image_rows(
    names: Sequence[str], identities: Sequence[PictureIdentity], path: Path, traverse: Traverse
) -> dict[str, int]:
    """Row of the image of each name (a unique id, an id of the traverse, or a file's name) that is there.

    Raises InputError naming some of them where none is.
    """
    rows: dict[str, int] = {}
    for row, (who, image) in enumerate(zip(identities, traverse.images, strict=True)):
        stem = () if image.file is None else (Path(image.file).stem, Path(image.file).name)
        for name in (who.unique_id, image.id, *stem):
            rows.setdefault(name.lower(), row)
    found = {name: rows[name.lower()] for name in names if name.lower() in rows}
    if not found:
        missing = f"{', '.join(names[:_NAMED])}{' and others' if len(names) > _NAMED else ''}"
        raise InputError(
            f"{path}: images: expected pictures of {traverse.folder or traverse.name}, found {missing}, "
            "none of which is there"
        )
    return found


def joined(
    traverse: Traverse,
    groups: dict[object, list[Mark]],
    said: Sequence[tuple[object, Callable[[int], Constraint]]],
    path: Path,
    warnings: Sequence[str],
) -> Traverse:
    """A traverse with these points in place of its observations; `groups` are the marks of each point.

    `said` has for each constraint its point, and what makes it of the point's track. Of points that one image
    sees, those of known place are `FramePoint`s; others are left out, with their constraints, and a second
    mark of a point in an image: warnings say how many. Raises InputError where nothing joins two images.
    """
    rows: list[tuple[int, int, Mark]] = []
    track_of: dict[object, int] = {}
    alone: dict[object, Mark] = {}
    twice = 0
    for group, marks in groups.items():
        first: dict[int, Mark] = {}
        for mark in marks:
            other = first.setdefault(mark.image, mark)
            twice += other.uv != mark.uv
        if len(first) < 2:
            alone.update((group, mark) for mark in first.values())
            continue
        track_of[group] = len(track_of)
        rows += [(mark.image, track_of[group], mark) for mark in first.values()]
    if not rows:
        raise InputError(f"{path}: expected points that two images or more see, found none")
    in_frames: list[tuple[object, FramePoint]] = []
    for group, make in said:
        one = _in_frame(traverse, alone[group], make(0)) if group in alone else None
        if one is not None:
            in_frames.append((group, one))
    lost = sum(group not in track_of for group, _ in said) - len(in_frames)
    single = len(alone) - len({group for group, _ in in_frames})
    notes = list(warnings)
    if single:
        and_ties = f", and {lost} constraints on them" if lost else ""
        notes.append(f"{path.name}: {single} points are seen in one image alone: they are left out{and_ties}")
    if twice:
        notes.append(f"{path.name}: {twice} marks are second ones of a point in an image: the first counts")
    uu, uv, vv = np.array([mark.covariance_px2 for *_, mark in rows]).T
    covariance = np.stack([uu, uv, uv, vv], axis=1).reshape(-1, 2, 2)
    plain = bool(np.all(uv == 0) and np.all(uu == vv))
    observations = Observations(
        image=np.array([image for image, *_ in rows]),
        track=np.array([track for _, track, _ in rows]),
        uv_px=np.array([mark.uv for *_, mark in rows]),
        sigma_px=np.sqrt((uu + vv) / 2),
    )
    with prefixed(path):
        constraints = [make(track_of[group]) for group, make in said if group in track_of]
        return replace(
            traverse,
            observations=observations if plain else observations.with_covariance(covariance),
            constraints=(
                *(c for c in traverse.constraints if not (c.landmarks or isinstance(c, FramePoint))),
                *constraints,
                *(one for _, one in in_frames),
            ),
            points=None,
            warnings=(*traverse.warnings, *notes),
        )


def _in_frame(traverse: Traverse, mark: Mark, constraint: Constraint) -> FramePoint | None:
    """What a constraint says of a point that one image alone sees; None where that is nothing of the image.

    A place whose covariance is not that of a sphere is none.
    """
    if not isinstance(constraint, LandmarkPosition) or len(constraint.axes) < len("xyz"):
        return None
    covariance, image = constraint.covariance, traverse.images[mark.image]
    sigma = float(np.sqrt(np.trace(covariance) / 3))
    if np.abs(covariance - sigma**2 * np.eye(3)).max() > _ROUND * sigma**2:
        return None
    uu, _, vv = mark.covariance_px2
    return FramePoint(
        frame=image.frame,
        camera=image.camera,
        u_px=mark.uv[0],
        v_px=mark.uv[1],
        sigma_px=float(np.sqrt((uu + vv) / 2)),
        position_m=tuple(constraint.target_m.tolist()),
        sigma_m=sigma,
        robust=constraint.robust,
    )


def with_ties(traverse: Traverse, file: TieFile, path: Path, sigmas: TieSigmas = TIE_SIGMAS) -> Traverse:
    """A traverse with the ties of a `.tpt` in place of its observations and its constraints on points.

    Marks that share a pixel, a tie or a track are of one point; so are fiducials and orbital points of the
    same coordinates. Constraints may be wrong (`robust`). Ties of images that the traverse has not are left
    out, with a warning. Raises InputError where no image of the file is there, for another frame than the
    site's, and where nothing joins two images.
    """
    identities = picture_identities(traverse)
    row_of = _rows_of_keys(file, identities, path, traverse)
    groups, marks = _Groups(), dict[object, Mark]()
    said: list[tuple[object, Callable[[int], Constraint]]] = []
    missing = 0
    usual = sigmas.pixel_px**2
    for tie in file.ties:
        keys = [tie.left] if tie.right is None else [tie.left, tie.right]
        if any(key not in row_of for key in keys):
            missing += 1
            continue
        if tie.type in _IN_SITE:
            _require_site(tie, identities, path)
        things: list[object] = []
        for side, (key, uv) in enumerate(zip(keys, (tie.left_uv, tie.right_uv), strict=False)):
            assert uv is not None  # a pair has both
            thing = ("mark", row_of[key], uv)
            covariance = (usual, 0.0, usual)
            if tie.type == 2 and side == 1:
                covariance = _along(tie.angle_deg or 0.0, sigmas.pixel_px)
            marks.setdefault(thing, Mark(image=row_of[key], uv=uv, covariance_px2=covariance))
            things.append(thing)
        if tie.track is not None:
            things.append(("track", tie.track))
        if tie.xyz is not None and tie.type in {1, 4, 5}:
            things.append(("point", tie.xyz))
        groups.join(things)
        for make in _constraints(tie, traverse, row_of[tie.left], sigmas):
            with prefixed(f"{path}: {tie.where} ({TIE_TYPES[tie.type]})"):
                make(0)  # refuses what is none
            said.append((things[0], make))
    of_group: dict[object, list[Mark]] = {}
    for one, held in marks.items():
        of_group.setdefault(groups.first(one), []).append(held)
    notes = (
        [f"{path.name}: {missing} of {len(file.ties)} ties are of images that are not there"]
        if missing
        else []
    )
    once = {(groups.first(thing), str(make(0).__dict__)): (groups.first(thing), make) for thing, make in said}
    return joined(traverse, of_group, list(once.values()), path, notes)


def _rows_of_keys(
    file: TieFile, identities: Sequence[PictureIdentity], path: Path, traverse: Traverse
) -> dict[int, int]:
    """Row of the image of each key that is there; the older text counts images in the traverse's order."""
    named = {key: name for key, name in file.images.items() if name is not None}
    if named:
        rows = image_rows(list(named.values()), identities, path, traverse)
        return {key: rows[name] for key, name in named.items() if name in rows}
    largest = max(file.images)
    if largest >= len(traverse.images):
        raise InputError(
            f"{path}: expected images 0 to {len(traverse.images) - 1} of {traverse.name}, found {largest}"
        )
    return {key: key for key in file.images}


def _require_site(tie: Tie, identities: Sequence[PictureIdentity], path: Path) -> None:
    frame = tie.frame
    if frame is None:
        return
    where = f"{path}: {tie.where} ({TIE_TYPES[tie.type]}): reference_frame"
    if frame.name.upper() not in _SITE_NAMES:
        raise InputError(f"{where}: expected SITE, found {frame.name[:60]}")
    labelled = [who.place[0] for who in identities if who.is_labelled]
    if frame.index and labelled and frame.index[0] != labelled[0]:
        raise InputError(f"{where}: expected site {labelled[0]}, as the labels have, found {frame.index[0]}")


def _along(angle_deg: float, sigma_px: float) -> tuple[float, float, float]:
    """Covariance of a mark that may slide along a line, at an angle anticlockwise from samples."""
    a = np.radians(angle_deg)
    along, across = np.array([np.cos(a), -np.sin(a)]), np.array([-np.sin(a), -np.cos(a)])
    c = _SLIDES_PX**2 * np.outer(along, along) + sigma_px**2 * np.outer(across, across)
    return float(c[0, 0]), float(c[0, 1]), float(c[1, 1])


def _constraints(
    tie: Tie, traverse: Traverse, left: int, sigmas: TieSigmas
) -> list[Callable[[int], Constraint]]:
    """What a tie says of its point besides pixels: a maker of the constraint on a track."""
    x, y, z = tie.xyz or (None, None, None)
    stop = traverse.stops[int(traverse.image_stop[left])].id
    if tie.type in {1, 4, 5}:
        sigma = sigmas.fiducial_m if tie.type == 1 else sigmas.orbital_m
        position = (x, None if y is None else -y, None if z is None else -z)
        told = tuple(None if value is None else sigma for value in position)
        return [
            lambda track: LandmarkPosition(landmark=track, position_m=position, sigma_m=told, robust=True)
        ]
    if tie.type == 3:
        return [lambda track: LandmarkInfinity(landmark=track, robust=True)]
    if tie.type == 8 and z is not None:
        height = -z
        return [
            lambda track: LandmarkHeight(
                landmark=track, height_m=height, sigma_m=sigmas.height_m, robust=True
            )
        ]
    angle = np.radians(tie.angle_deg or 0.0)
    if tie.type == 6:
        # Clockwise from x where z is down is anticlockwise by the other sign where z is up.
        azimuth = float(wrap_angle(-angle))
        return [
            lambda track: LandmarkAzimuth(
                landmark=track, stop=stop, azimuth_rad=azimuth, sigma_rad=sigmas.angle_rad, robust=True
            )
        ]
    if tie.type == 7:
        elevation = float(angle)
        return [
            lambda track: LandmarkElevation(
                landmark=track, stop=stop, elevation_rad=elevation, sigma_rad=sigmas.angle_rad, robust=True
            )
        ]
    assert tie.type in PAIR_TYPES  # of which nothing more is known
    return []


def with_pointing(traverse: Traverse, file: NavFile, path: Path) -> Traverse:
    """A traverse with the corrected pointings of a `.nav` as its telemetry; sigmas stay.

    The images of a frame share one pointing: the mean of theirs, with a warning where they differ by more
    than 0.1 mrad. Twist, cameras and surface of the file are not used. Raises InputError where no image of
    the file is there, and for text with another number of lines than there are images.
    """
    identities = picture_identities(traverse)
    named = [entry.unique_id for entry in file.entries if entry.unique_id is not None]
    if named:
        rows = image_rows(named, identities, path, traverse)
        pairs = [(rows[e.unique_id], e) for e in file.entries if e.unique_id in rows]
    else:
        if len(file.entries) != len(traverse.images):
            raise InputError(
                f"{path}: expected a line for each of the {len(traverse.images)} images of {traverse.name}, "
                f"in their order, found {len(file.entries)}"
            )
        pairs = list(enumerate(file.entries))
    found: dict[int, list[tuple[float, float]]] = {}
    for row, entry in pairs:
        azimuth, elevation = entry.pointing_deg[:2]
        frame = int(traverse.image_frame[row])
        found.setdefault(frame, []).append(identities[row].pan_tilt_rad(azimuth, elevation))
    notes: Counter[str] = Counter()
    frames = list(traverse.frames)
    for row, told in found.items():
        pans_tilts = np.array(told)
        apart = wrap_angle(pans_tilts - pans_tilts[0])
        notes["differ"] += bool(np.abs(apart).max() > _SAME_POINTING_RAD)
        pan, tilt = _mean(pans_tilts[0], apart)
        frames[row] = replace(frames[row], pan_rad=pan, tilt_rad=tilt)
    said = []
    if len(found) < len(frames):
        said.append(f"{path.name}: {len(frames) - len(found)} of {len(frames)} frames are not in it and stay")
    if len(pairs) < len(file.entries):
        said.append(f"{path.name}: {len(file.entries) - len(pairs)} of its images are not there")
    if notes["differ"]:
        said.append(
            f"{path.name}: images of {notes['differ']} frames are pointed differently: their mean counts"
        )
    with prefixed(path):
        return replace(traverse, frames=tuple(frames), warnings=(*traverse.warnings, *said))


def with_rovers(traverse: Traverse, path: Path) -> Traverse:
    """A traverse whose stops are where an `.rvf` has the rover in their site; sigmas stay.

    Stops are known by site and drive of their images' labels, without labels by their rows. Raises InputError
    for a rig that does not know where the mast is on the rover, and where no stop of the file is there.
    """
    mounted = traverse.rig.rover_T_mast
    if mounted is None:
        raise InputError(
            f"{path}: expected a rig whose place on the rover is known (rover_T_mast), found none in "
            f"{traverse.folder or traverse.name}"
        )
    identities = picture_identities(traverse)
    place_of = {int(traverse.image_stop[row]): who.place for row, who in enumerate(identities)}
    site = place_of[min(place_of)][0] if place_of else 0
    poses = rover_poses(path, site)
    stops = list(traverse.stops)
    for row, place in place_of.items():
        if place in poses:
            stops[row] = replace(stops[row], world_T_mast=poses[place] * mounted)
    n = sum(place in poses for place in place_of.values())
    if not n:
        known = ", ".join(f"{a}/{b}" for a, b in sorted(set(place_of.values()))[:_NAMED])
        found = ", ".join(f"{a}/{b}" for a, b in sorted(poses)[:_NAMED]) or "none"
        raise InputError(
            f"{path}: expected rover poses in site {site} of the stops (site/drive {known}), found {found}"
        )
    said = []
    if n < len(stops):
        said.append(f"{path.name}: {len(stops) - n} of {len(stops)} stops are not in it and stay")
    with prefixed(path):
        return replace(traverse, stops=tuple(stops), warnings=(*traverse.warnings, *said))


def _mean(first: FloatArray, apart: FloatArray) -> tuple[float, float]:
    pan, tilt = first + apart.mean(axis=0)
    if abs(tilt) > np.pi:
        tilt = float(wrap_angle(tilt))
    return float(wrap_angle(pan)), float(tilt)
