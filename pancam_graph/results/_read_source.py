"""What files for other programs are made from, read: a folder of results, a traverse, or one camera."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, pose_arrays, so3_log
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.cameras import FIELD_SHAPE, Camera, FieldCamera
from pancam_graph.data import (
    ENTRIES,
    Frame,
    Image,
    Observations,
    RigCorrection,
    Solution,
    State,
    Stop,
    Traverse,
)
from pancam_graph.io import NpzFile, prefixed, read_cahvor, read_input, with_network
from pancam_graph.io.vicar import (
    picture_identities,
    read_nav,
    read_ties,
    with_pointing,
    with_rovers,
    with_ties,
)
from pancam_graph.results._ply import read_points
from pancam_graph.results._solution_json import SolutionFile
from pancam_graph.results._solved_folder import SOLUTION_JSON, camera_poses, read_solved
from pancam_graph.results.formats import Source
from pancam_graph.rigs import Eye, Rig

__all__ = ["TAKEN_IN", "camera_source", "read_any", "results_source", "traverse_source"]

_RESIDUALS = "residuals.npz"
_POINTS = "points.ply"


def traverse_source(traverse: Traverse) -> Source:
    """A drive as telemetry has it, all observations in use, without terrain points."""
    n = 0 if traverse.observations is None else len(traverse.observations)
    rotations, centres = traverse.camera_poses()
    state = State(
        world_T_mast=tuple(stop.world_T_mast for stop in traverse.stops),
        pan_tilt_rad=traverse.pan_tilt_rad,
        world_R_camera=rotations,
        world_t_camera=centres,
        landmarks_m=np.zeros((0, 3)),
    )
    unknown = np.full((n, 2), np.nan)
    solution = Solution(
        traverse=traverse,
        model="mast",
        landmarks="eliminated",
        converged=False,
        stop_reason="not adjusted",
        iterations=0,
        cost_history=(),
        cost_initial=np.nan,
        cost_final=np.nan,
        initial=state,
        final=state,
        landmark_track=np.zeros(0, dtype=np.int64),
        used=np.ones(n, dtype=bool),
        reason=("",) * n,
        residual_initial_px=unknown,
        residual_final_px=unknown,
        sigma_px=np.zeros(0) if traverse.observations is None else traverse.observations.sigma_px,
        stop_covariance=np.array([np.diag(stop.sigmas**2) for stop in traverse.stops]),
        angle_sigma_rad=traverse.pan_tilt_sigmas_rad,
    )
    return Source(
        solution=solution,
        identities=picture_identities(traverse),
        point_sigma_m=np.zeros(0),
        is_solved=False,
    )


def camera_source(path: Path) -> Source:
    """The camera of a `.cahvor` file as a drive of one image, in the frame of the file."""
    model = read_cahvor(path)
    camera, frame_T_camera = model.split()
    name = path.stem
    rig = Rig(
        name=name,
        pan_T_tilt=gtsam.Pose3(),
        eyes=(Eye(name="camera", camera=camera, head_T_camera=frame_T_camera),),
    )
    held = {"sigma_rotation_rad": 0.0, "sigma_translation_m": 0.0}
    traverse = Traverse(
        name=name,
        rig=rig,
        stops=(Stop(id="0", world_T_mast=gtsam.Pose3(), **held),),
        frames=(Frame(id="0", stop="0", pan_rad=0.0, tilt_rad=0.0, sigma_pan_rad=0.0, sigma_tilt_rad=0.0),),
        images=(Image(id=name, frame="0", camera="camera"),),
    )
    return traverse_source(traverse)


def results_source(out: Path, folder: Path | None) -> Source:
    """A folder of results. `folder` is the one that was refined; None: where it was then.

    Raises InputError as `read_solved` does, and for files of the results that are missing, damaged or of
    another run.
    """
    file, traverse = read_solved(out, folder, "expected one an eye")
    path = out / SOLUTION_JSON
    with prefixed(path):
        traverse, columns = _observed(out / _RESIDUALS, traverse)
    n = 0 if traverse.observations is None else len(traverse.observations)
    points = read_points(out / _POINTS)
    rotations, centres = camera_poses(file, path)
    told_R, told_t = traverse.camera_poses()
    unknown = np.full((n, 2), np.nan)
    masts = [stop.world_T_mast for stop in traverse.stops]
    final = State(
        world_T_mast=tuple(
            mast if s.world_T_mast is None else s.world_T_mast.pose(f"{path}: stops: {s.id}")
            for mast, s in zip(masts, file.stops, strict=True)
        ),
        pan_tilt_rad=np.array([_pair(f.pan_rad, f.tilt_rad) for f in file.frames]),
        world_R_camera=rotations,
        world_t_camera=centres,
        landmarks_m=points.xyz_m,
        rig=_correction(file, traverse, path),
    )
    initial = State(
        world_T_mast=tuple(masts),
        pan_tilt_rad=traverse.pan_tilt_rad,
        world_R_camera=told_R,
        world_t_camera=told_t,
        landmarks_m=np.full_like(points.xyz_m, np.nan),
    )
    solution = Solution(
        traverse=traverse,
        model=file.model,
        landmarks=file.landmarks,
        converged=file.converged,
        stop_reason=file.stop_reason,
        iterations=file.iterations,
        cost_history=(),
        cost_initial=_or_nan(file.cost.initial),
        cost_final=_or_nan(file.cost.final),
        initial=initial,
        final=final,
        landmark_track=points.track,
        used=columns["used"].astype(bool) if n else np.zeros(0, dtype=bool),
        reason=("",) * n,
        residual_initial_px=_two(columns, "initial_du_px", "initial_dv_px") if n else unknown,
        residual_final_px=_two(columns, "final_du_px", "final_dv_px") if n else unknown,
        sigma_px=columns["sigma_px"] if n else np.zeros(0),
        stop_covariance=np.array(
            [np.full((6, 6), np.nan) if s.covariance is None else s.covariance for s in file.stops]
        ),
        angle_sigma_rad=np.array([_pair(f.sigma_pan_rad, f.sigma_tilt_rad) for f in file.frames]),
        verdict=None if file.verdict is None else file.verdict.verdict(),
        method=file.method,
    )
    return Source(
        solution=solution,
        identities=picture_identities(traverse),
        point_sigma_m=points.sigma_m,
        is_solved=True,
    )


def _observed(path: Path, traverse: Traverse) -> tuple[Traverse, dict[str, FloatArray]]:
    """The traverse with the observations of a solution, and the columns of its residuals."""
    archive = NpzFile(path)
    with prefixed(path):
        if not archive.names:
            return replace(traverse, observations=None, constraints=()), {}
        names = archive.array("image_names").astype(str).tolist()
        if names != [image.id for image in traverse.images]:
            raise InputError("image_names: expected the images that were refined, found others")
        wanted = ("image", "track", "u_px", "v_px", "sigma_px", "used", "initial_du_px", "initial_dv_px")
        columns = {name: archive.array(name) for name in (*wanted, "final_du_px", "final_dv_px")}
        if len({column.shape for column in columns.values()}) != 1 or columns["used"].ndim != 1:
            raise InputError("columns: expected one length, found others")
    given = traverse.observations
    observations = Observations(
        image=columns["image"],
        track=columns["track"],
        uv_px=_two(columns, "u_px", "v_px"),
        sigma_px=columns["sigma_px"],
        origin="images" if given is None else given.origin,
        point_track={} if given is None else given.point_track,
    )
    return replace(traverse, observations=observations), columns


def _two(columns: dict[str, FloatArray], first: str, second: str) -> FloatArray:
    return np.column_stack([columns[first], columns[second]])


def _correction(file: SolutionFile, traverse: Traverse, path: Path) -> RigCorrection:
    """The differences between the adjusted rig and that of the traverse."""
    own = traverse.rig.eyes
    found = [entry.eye(f"{path}: cameras: {entry.name}") for entry in file.cameras]
    row, column = np.array([0, 1, 0, 0, 1]), np.array([0, 1, 1, 2, 2])
    calibration, mounts, fields = [], [], []
    for mine, other in zip(own, found, strict=True):
        change = other.camera.pinhole.calibration_matrix - mine.camera.pinhole.calibration_matrix
        calibration.append(change[row, column])
        (R, found_R), (t, found_t) = pose_arrays([mine.head_T_camera, other.head_T_camera])
        mounts.append(np.concatenate([so3_log(R.T @ found_R), R.T @ (found_t - t)]))
        fields.append(_field_px(other.camera) - _field_px(mine.camera))
    pan_T_tilt = np.zeros((len(traverse.stops), 6))
    stops = {stop.id: i for i, stop in enumerate(traverse.stops)}
    for entry in file.refined:
        if (
            entry.quantity == "pan_T_tilt"
            and entry.entry in ENTRIES["pan_T_tilt"]
            and entry.change is not None
        ):
            which = slice(None) if entry.stop is None else stops.get(entry.stop, slice(0))
            pan_T_tilt[which, ENTRIES["pan_T_tilt"].index(entry.entry)] = entry.change
    return RigCorrection(
        calibration_px=np.array(calibration)[traverse.image_eye],
        mount=np.array(mounts)[traverse.image_eye],
        pan_T_tilt=pan_T_tilt,
        radius_m=np.zeros(len(traverse.images)),
        field_px=np.array(fields) if np.any(fields) else None,
    )


def _field_px(camera: Camera) -> FloatArray:
    return camera.field_px if isinstance(camera, FieldCamera) else np.zeros(FIELD_SHAPE)


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _pair(first: float | None, second: float | None) -> list[float]:
    return [_or_nan(first), _or_nan(second)]


def read_any(path: Path, images: Path | None) -> Source:
    """The source of a path: a folder of results, a folder of a drive, or a file.

    A file of ties, pointings, rover poses or a control network is taken into the drive of the folder
    `images`; any other is read as a `.cahvor` file. Raises InputError as the reader does.
    """
    if path.is_dir():
        if (path / SOLUTION_JSON).exists():
            return results_source(path, images)
        return traverse_source(read_input(path))
    take = TAKEN_IN.get(path.suffix.lower())
    if take is None:
        return camera_source(path)
    other = instead_of_file(path)
    if other is not None:
        raise InputError(f"{path}: expected a file, found {other}")
    if images is None:
        raise InputError(f"{path}: expected the folder of its pictures (--images), found none told")
    given = read_input(images)
    traverse = take(given, path)
    source = traverse_source(traverse)
    source.warnings.extend(traverse.warnings[len(given.warnings) :])
    return source


def _with_ties(traverse: Traverse, path: Path) -> Traverse:
    return with_ties(traverse, read_ties(path), path)


def _with_pointing(traverse: Traverse, path: Path) -> Traverse:
    return with_pointing(traverse, read_nav(path), path)


TAKEN_IN: Mapping[str, Callable[[Traverse, Path], Traverse]] = {
    ".tpt": _with_ties,
    ".nav": _with_pointing,
    ".rvf": with_rovers,
    ".csv": with_network,
}
"""What takes a file of another program into a drive, by the file's ending."""
