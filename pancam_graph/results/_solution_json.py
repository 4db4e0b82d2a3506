"""The numbers of a solution: `solution.json`."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import gtsam
import numpy as np
from pydantic import Field

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.base.regular_files import is_missing
from pancam_graph.cameras import FieldCamera
from pancam_graph.data import (
    ENTRIES,
    Flex,
    Incremental,
    Quantity,
    RigTreatment,
    Site,
    Solution,
    Verdict,
    VerdictTest,
    flex_of,
)
from pancam_graph.io import (
    SOLUTION_FORMAT,
    VERSION,
    AnyCamera,
    Entry,
    Label,
    PoseEntry,
    SiteEntry,
    SparseEntry,
    Text,
    camera_entry,
    read_json,
    validated,
)
from pancam_graph.results._cross_validation import CrossValidationEntry
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["SOLUTION_WRITER", "SolutionFile", "read_solution_json", "solution_file", "solution_json"]

Vector6 = Annotated[list[float], Field(min_length=6, max_length=6)]


class SecondsEntry(Entry):
    """Wall-clock time of each part."""

    read: float
    initialise: float
    solve: float
    report: float


class BeforeAfterEntry(Entry):
    """A number before and after the adjustment; null where it is not defined."""

    initial: float | None
    final: float | None


class CountsEntry(Entry):
    """How many observations took part, and how many did not."""

    used: int
    rejected: int


class SolvedStopEntry(SparseEntry):
    """Mast pose of a stop; null where it is not finite."""

    _OPTIONAL: ClassVar = frozenset({"latitude_deg", "longitude_deg", "height_m", "azimuth_deg"})

    id: str
    world_T_mast: PoseEntry | None
    covariance: Annotated[list[Vector6], Field(min_length=6, max_length=6)] | None
    """6 x 6, rotation first, body frame; 0 for a held stop, null where unknown."""
    latitude_deg: float | None = None
    """Of the mast's origin on the site's planet; these keys are missing without a site."""
    longitude_deg: float | None = None
    height_m: float | None = None
    azimuth_deg: float | None = None
    """Where the mast's x axis points, clockwise from north."""


class FlexEntry(Entry):
    """An entry of the flex of all frames: as told, and as found."""

    entry: str
    sigma: float
    rms: float
    largest: float
    frame: Label
    """The frame with the largest value."""


class RigTreatmentEntry(Entry):
    """What became of the rig's uncertainty."""

    treatment: RigTreatment
    flex: list[FlexEntry]
    """Empty where heads were taken to sit firmly."""


class SolvedFrameEntry(SparseEntry):
    """Angles of a frame with their formal standard deviations; null where not finite."""

    _OPTIONAL: ClassVar = frozenset({"flex"})

    id: str
    pan_rad: float | None
    tilt_rad: float | None
    sigma_pan_rad: float | None
    sigma_tilt_rad: float | None
    flex: dict[str, float] | None = None
    """How its head stands off the rigid mast, by entry; the key is missing where heads sit firmly."""


class SolvedImageEntry(SparseEntry):
    """Camera pose of an image; count and RMS residual length of its used observations."""

    _OPTIONAL: ClassVar = frozenset({"azimuth_deg", "elevation_deg"})

    id: str
    world_T_camera: PoseEntry | None
    rms_px: float | None
    """Null without used observations."""
    observations: int
    azimuth_deg: float | None = None
    """Of the camera's axis, clockwise from north; these keys are missing without a site."""
    elevation_deg: float | None = None
    """Of the camera's axis above the horizontal."""


class RefinedEntry(Entry):
    """An entry of the rig that was free. Null: the entry has no such owner, or the number is not finite."""

    quantity: Quantity
    entry: str
    camera: str | None
    stop: str | None
    image: str | None
    nominal: float | None
    change: float | None
    sigma: float | None
    prior_sigma: float | None


class FieldEntry(Entry):
    """Coefficients of the smooth distortion field of a camera, by rows of the image (`cameras.Fields`)."""

    camera: str
    u_px: list[list[float]]
    v_px: list[list[float]]


class IncrementalEntry(Entry):
    """Time, cost and relinearised variables of each stop, in order."""

    seconds_per_stop: list[float]
    cost_per_stop: list[float]
    relinearised_per_stop: list[int]

    @staticmethod
    def of(steps: Incremental) -> "IncrementalEntry":
        """The entry of the steps of a smoother."""
        return IncrementalEntry(
            seconds_per_stop=[float(s) for s in steps.seconds_per_stop],
            cost_per_stop=[float(c) for c in steps.cost_per_stop],
            relinearised_per_stop=[int(n) for n in steps.relinearised_per_stop],
        )


class VerdictTestEntry(Entry):
    """One test of the solution."""

    name: str
    value: float | None
    """Null where it is not finite, or where there was nothing to test."""
    limit: float
    passed: bool
    says: str


class VerdictEntry(Entry):
    """Whether the numbers can be believed."""

    passed: bool
    """Whether every test passed."""
    tests: list[VerdictTestEntry]

    @staticmethod
    def of(verdict: Verdict) -> "VerdictEntry":
        """The entry of a verdict."""
        tests = [
            VerdictTestEntry(name=t.name, value=t.value, limit=t.limit, passed=t.passed, says=t.says)
            for t in verdict.tests
        ]
        return VerdictEntry(passed=verdict.passed, tests=tests)

    def verdict(self) -> Verdict:
        """The verdict of the entry."""
        return Verdict(tests=tuple(VerdictTest(**dict(t)) for t in self.tests))


class SolutionFile(Entry):
    """`solution.json`."""

    format: Literal["pancam-graph/solution"] = "pancam-graph/solution"
    version: Literal[1] = 1
    model: str
    landmarks: str
    converged: bool
    stop_reason: str
    verdict: VerdictEntry | None = None
    """Where the solution was tested; else the key is missing."""
    iterations: int
    seconds: SecondsEntry
    cost: BeforeAfterEntry
    """Half the sum of squares, priors included."""
    rms_px: BeforeAfterEntry
    observations: CountsEntry
    stops: list[SolvedStopEntry]
    frames: list[SolvedFrameEntry]
    images: list[SolvedImageEntry]
    cameras: list[AnyCamera]
    """As the cameras of a rig in `traverse.json`, refined where an eye has one correction for all images."""
    method: str = "joint"
    """The key is missing where it was joint."""
    rig: RigTreatmentEntry | None = None
    """The key is missing in files of older versions."""
    refined: list[RefinedEntry] = Field(default_factory=list)
    """Entries of the rig that were free; no such key where none was."""
    fields: list[FieldEntry] = Field(default_factory=list)
    """Of each eye of the rig; no such key where none was free."""
    warnings: list[str]
    folder: Text | None = None
    """The folder that was refined, relative to that of the results; the key is missing without one."""
    parts: list[Text] = Field(default_factory=list)
    """Folders that were refined together, relative to `folder`; the key is missing where it was one."""
    site: SiteEntry | None = None
    """Where the world is on its planet; the key is missing where that is not known."""
    cross_validation: CrossValidationEntry | None = None
    """Where it was asked for; else the key is missing."""
    incremental: IncrementalEntry | None = None
    """Where stops were added one by one; else the key is missing."""


def read_solution_json(path: Path | str) -> SolutionFile:
    """Read a `solution.json`. Raises InputError naming file, entry, expected and found."""
    path = Path(path)
    if is_missing(path):
        raise InputError(f"{path}: expected a folder of results or its solution.json, found nothing there")
    return validated(SolutionFile, read_json(path, SOLUTION_FORMAT, VERSION), path)


def solution_json(solution: Solution, out: Path | None = None) -> bytes:
    """A solution as the content of `solution.json`; null in place of what is not finite.

    `out` is the folder of results, from which the way to the pictures is told.
    """
    missing = {
        "method": solution.method == "joint",
        "verdict": solution.verdict is None,
        "rig": solution.treatment is None,
        "refined": not solution.refined,
        "fields": not any(isinstance(eye.camera, FieldCamera) for eye in solution.rig.eyes),
        "folder": out is None or solution.traverse.folder is None,
        "parts": out is None or not solution.traverse.parts,
        "site": solution.traverse.site is None,
        "cross_validation": solution.cross_validation is None,
        "incremental": solution.incremental is None,
    }
    data = solution_file(solution, out).model_dump(exclude={name for name, gone in missing.items() if gone})
    entries = ",\n".join(f"{_compact(name)}: {_by_line(value)}" for name, value in data.items())
    return f"{{\n{entries}\n}}\n".encode()


def _by_line(value: object) -> str:
    """JSON with a line for each element of a list of objects; else one line."""
    if not (isinstance(value, list) and value and isinstance(value[0], dict)):
        return _compact(value)
    return "[\n" + ",\n".join(map(_compact, value)) + "\n]"


_compact = json.JSONEncoder(allow_nan=False, ensure_ascii=False).encode


def solution_file(solution: Solution, out: Path | None = None) -> SolutionFile:
    """A solution as the model of its file; see `solution_json`."""
    traverse, final = solution.traverse, solution.final
    stops = [
        SolvedStopEntry(
            id=stop.id,
            world_T_mast=_pose(pose),
            covariance=_covariance(covariance),
            **_place_of(traverse.site, pose),
        )
        for stop, pose, covariance in zip(
            traverse.stops, final.world_T_mast, solution.stop_covariance, strict=True
        )
    ]
    flex = flex_of(solution)
    frames = [
        SolvedFrameEntry(
            id=frame.id,
            pan_rad=_number(angles[0]),
            tilt_rad=_number(angles[1]),
            sigma_pan_rad=_number(sigmas[0]),
            sigma_tilt_rad=_number(sigmas[1]),
            flex=_flex_of_frame(solution, row, flex),
        )
        for row, (frame, angles, sigmas) in enumerate(
            zip(traverse.frames, final.pan_tilt_rad, solution.angle_sigma_rad, strict=True)
        )
    ]
    seconds, validation = solution.seconds, solution.cross_validation
    n_used = int(np.count_nonzero(solution.used))
    return SolutionFile(
        model=solution.model,
        landmarks=solution.landmarks,
        converged=bool(solution.converged),
        stop_reason=solution.stop_reason,
        verdict=None if solution.verdict is None else VerdictEntry.of(solution.verdict),
        iterations=int(solution.iterations),
        seconds=SecondsEntry(
            read=float(seconds.read),
            initialise=float(seconds.initialise),
            solve=float(seconds.solve),
            report=float(seconds.report),
        ),
        cost=BeforeAfterEntry(initial=_number(solution.cost_initial), final=_number(solution.cost_final)),
        rms_px=BeforeAfterEntry(
            initial=_number(solution.rms_initial_px) if n_used else None,
            final=_number(solution.rms_final_px) if n_used else None,
        ),
        observations=CountsEntry(used=n_used, rejected=len(solution.used) - n_used),
        stops=stops,
        frames=frames,
        images=_images(solution),
        cameras=[camera_entry(e) for e in solution.rig.eyes],
        rig=None
        if solution.treatment is None
        else RigTreatmentEntry(
            treatment=solution.treatment,
            flex=[
                FlexEntry(entry=f.entry, sigma=f.sigma, rms=f.rms, largest=f.largest, frame=f.frame)
                for f in flex
            ],
        ),
        refined=[
            RefinedEntry(
                quantity=r.quantity,
                entry=r.entry,
                camera=r.camera,
                stop=r.stop,
                image=r.image,
                nominal=r.nominal,
                change=_number(r.change),
                sigma=_number(r.sigma),
                prior_sigma=_number(r.prior_sigma),
            )
            for r in solution.refined
        ],
        fields=_fields(solution),
        # Warnings of the reader come first, and once, also where the solver passed them on.
        warnings=list(dict.fromkeys([*traverse.warnings, *solution.warnings])),
        folder=None if out is None or traverse.folder is None else _way(traverse.folder, out),
        parts=list(traverse.parts),
        site=None if traverse.site is None else SiteEntry.of(traverse.site),
        method=solution.method,
        cross_validation=None if validation is None else CrossValidationEntry.of(validation, traverse),
        incremental=None if solution.incremental is None else IncrementalEntry.of(solution.incremental),
    )


def _way(folder: Path, out: Path) -> str:
    """The way from one folder to another; whole where there is none, as between drives of Windows."""
    try:
        way = os.path.relpath(folder.resolve(), out.resolve())
    except ValueError:
        way = str(folder.resolve())
    return way.encode(errors="replace").decode()


def _flex_of_frame(solution: Solution, row: int, flex: tuple[Flex, ...]) -> dict[str, float] | None:
    """The flex of one frame by entry; None where heads sit firmly."""
    rig = solution.final.rig
    if not flex or rig is None or rig.flex is None:
        return None
    return {f.entry: float(rig.flex[row, ENTRIES["flex"].index(f.entry)]) for f in flex}


def _fields(solution: Solution) -> list[FieldEntry]:
    named = ((eye.name, eye.camera) for eye in solution.rig.eyes)
    fields = ((name, camera.field_px.tolist()) for name, camera in named if isinstance(camera, FieldCamera))
    return [FieldEntry(camera=name, u_px=u_px, v_px=v_px) for name, (u_px, v_px) in fields]


def _images(solution: Solution) -> list[SolvedImageEntry]:
    traverse, final = solution.traverse, solution.final
    n = len(traverse.images)
    count: IntArray = np.zeros(n, dtype=np.int64)
    squared: FloatArray = np.zeros(n)
    if traverse.observations is not None:
        image = traverse.observations.image[solution.used]
        length2 = np.sum(solution.residual_final_px[solution.used] ** 2, axis=1)
        count = np.bincount(image, minlength=n)
        squared = np.asarray(np.bincount(image, weights=length2, minlength=n), dtype=float)
    return [
        SolvedImageEntry(
            id=entry.id,
            world_T_camera=_pose_of(rotation, translation),
            rms_px=_number(np.sqrt(total / views)) if views else None,
            observations=int(views),
            **_direction_of(traverse.site, rotation[:, 2]),
        )
        for entry, rotation, translation, views, total in zip(
            traverse.images, final.world_R_camera, final.world_t_camera, count, squared, strict=True
        )
    ]


def _place_of(site: Site | None, world_T_mast: gtsam.Pose3) -> dict[str, float]:
    """Where a mast is on its planet, and where its x axis points; nothing without a site or a finite pose."""
    if site is None or not np.isfinite(world_T_mast.matrix()).all():
        return {}
    ((latitude, longitude, height),) = site.geographic(world_T_mast.translation()[None]).tolist()
    forward = world_T_mast.rotation().matrix()[:, 0]
    return {
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": height,
        "azimuth_deg": site.azimuth_deg(float(np.arctan2(forward[1], forward[0]))),
    }


def _direction_of(site: Site | None, axis: FloatArray) -> dict[str, float]:
    """Azimuth and elevation of a direction (3,) of the world; nothing without a site, or if not finite."""
    if site is None or not np.isfinite(axis).all():
        return {}
    return {
        "azimuth_deg": site.azimuth_deg(float(np.arctan2(axis[1], axis[0]))),
        "elevation_deg": float(np.degrees(np.arctan2(axis[2], np.hypot(axis[0], axis[1])))),
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _pose(pose: gtsam.Pose3) -> PoseEntry | None:
    return PoseEntry.of(pose) if np.isfinite(pose.matrix()).all() else None


def _pose_of(rotation: FloatArray, translation: FloatArray) -> PoseEntry | None:
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return PoseEntry.of(gtsam.Pose3(gtsam.Rot3(rotation), translation))


def _covariance(covariance: FloatArray) -> list[list[float]] | None:
    return covariance.tolist() if np.isfinite(covariance).all() else None


def _write(written: Written, path: Path) -> Written:
    solution = written.solution
    timed = solution.with_seconds(report=solution.seconds.report + written.seconds())
    path.write_bytes(solution_json(timed, path.parent))
    return replace(written, solution=timed)


SOLUTION_WRITER = OutputWriter(write=_write)
