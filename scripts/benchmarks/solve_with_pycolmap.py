"""Solve a traverse folder with COLMAP's rig bundle adjustment and print what it took, as JSON.

Another problem than ours: a rig with known mounts, but no mast, so every frame has a pose of its own; and
no telemetry, so the first two frames' cameras hold the gauge. Its cost does not compare; its time does.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pycolmap

from benchmarks.memory import peak_memory_mb
from pancam_graph import Traverse, read_traverse
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cli import run

_FUNCTION_TOLERANCE = 1e-6


def reconstruction(traverse: Traverse, start_m: FloatArray) -> pycolmap.Reconstruction:
    """The traverse at its telemetry, landmarks (tracks, 3) in metres at `start_m`."""
    observations = traverse.observations
    assert observations is not None  # the benchmark's traverses have them
    scene = pycolmap.Reconstruction()
    head_R, head_t = _head_poses(traverse)
    rig = pycolmap.Rig(rig_id=1)
    for e, eye in enumerate(traverse.rig.eyes):
        p = eye.camera.pinhole
        camera = pycolmap.Camera(
            camera_id=e + 1,
            model="PINHOLE",
            width=p.width_px,
            height=p.height_px,
            params=[
                p.fx_px,
                p.fy_px,
                p.cx_px + 0.5,
                p.cy_px + 0.5,
            ],  # COLMAP's first pixel centre is (0.5, 0.5)
        )
        scene.add_camera(camera)
        if e == 0:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            between = eye.head_T_camera.inverse() * traverse.rig.eyes[0].head_T_camera
            rig.add_sensor(camera.sensor_id, _rigid(between))
    scene.add_rig(rig)
    first = traverse.rig.eyes[0].head_T_camera
    images_of = [np.flatnonzero(traverse.image_frame == f) for f in range(len(traverse.frames))]
    order = np.argsort(observations.image, kind="stable")
    limits = np.searchsorted(observations.image[order], np.arange(len(traverse.images) + 1))
    row_in_image = np.empty(len(observations), dtype=np.int64)
    row_in_image[order] = np.arange(len(observations)) - limits[observations.image[order]]
    for f, images in enumerate(images_of):
        head = gtsam.Pose3(gtsam.Rot3(head_R[f]), head_t[f])
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=1, rig_from_world=_rigid((head * first).inverse()))
        made = []
        for i in images:
            rows = order[limits[i] : limits[i + 1]]
            image = pycolmap.Image(
                image_id=int(i) + 1,
                name=traverse.images[i].id,
                camera_id=int(traverse.image_eye[i]) + 1,
                frame_id=f + 1,
                points2D=[pycolmap.Point2D(uv) for uv in observations.uv_px[rows] + 0.5],
            )
            frame.add_data_id(image.data_id)
            made.append(image)
        scene.add_frame(frame)
        for image in made:
            scene.add_image(image)
        scene.register_frame(f + 1)
    by_track = np.argsort(observations.track, kind="stable")
    limits = np.searchsorted(observations.track[by_track], np.arange(len(start_m) + 1))
    for t, point_m in enumerate(start_m):
        track = pycolmap.Track()
        for row in by_track[limits[t] : limits[t + 1]]:
            track.add_element(int(observations.image[row]) + 1, int(row_in_image[row]))
        scene.add_point3D(point_m, track)
    return scene


def _head_poses(traverse: Traverse) -> tuple[FloatArray, FloatArray]:
    """World poses of the heads at telemetry: rotations (frames, 3, 3), translations (frames, 3)."""
    pan, tilt = traverse.pan_tilt_rad.T
    mast_R, mast_t = traverse.rig.mast_T_head(pan, tilt)
    stops = [traverse.stops[s].world_T_mast for s in traverse.frame_stop]
    heads = [stop * gtsam.Pose3(gtsam.Rot3(R), t) for stop, R, t in zip(stops, mast_R, mast_t, strict=True)]
    return np.array([h.rotation().matrix() for h in heads]), np.array([h.translation() for h in heads])


def _rigid(pose: gtsam.Pose3) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation().matrix()), pose.translation())


def solve(scene: pycolmap.Reconstruction, threads: int, solver: str) -> Any:
    """Adjust frames and points; mounts and calibration stay. Returns Ceres's summary.

    `solver`: "auto", COLMAP's own choice, or a name of Ceres's linear solvers.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.print_summary = False
    ceres = options.ceres
    ceres.solver_options.function_tolerance = _FUNCTION_TOLERANCE
    ceres.solver_options.num_threads = threads
    if solver != "auto":
        ceres.auto_select_solver_type = False
        names: Any = type(ceres.solver_options.linear_solver_type)  # pycolmap does not export the enumeration
        ceres.solver_options.linear_solver_type = names.__members__[solver]
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in scene.images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary: Any = pycolmap.create_default_bundle_adjuster(options, config, scene).solve()
    return summary.ceres_summary  # of the class that is returned for Ceres, not of its base


def main() -> int:
    """Read, try each solver once, then repeat the fastest, always from the start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("traverse", type=Path)
    parser.add_argument("start_m", type=Path)
    parser.add_argument("--solvers", nargs="+", required=True)
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--repeats", type=int, required=True, help="solves with the fastest, first included")
    a = parser.parse_args()
    traverse, start_m = read_traverse(a.traverse), np.load(a.start_m)
    observations = traverse.observations
    assert observations is not None  # the benchmark's traverses have them
    tried, memory_mb = {}, {}
    for solver in a.solvers:
        tried[solver] = solve(reconstruction(traverse, start_m), a.threads, solver)
        memory_mb[solver] = peak_memory_mb()  # of a later solver: no less than of those before
    best = min(tried, key=lambda s: float(tried[s].total_time_in_seconds))
    again = [solve(reconstruction(traverse, start_m), a.threads, best) for _ in range(a.repeats - 1)]
    ceres = tried[best]
    others = [f"{s} {tried[s].total_time_in_seconds:.3g} s" for s in tried if s != best]
    used = [ceres.linear_solver_type_used.name, f"{a.threads} threads", "no mast, no telemetry"]
    measured = {
        "seconds": [s.total_time_in_seconds for s in (ceres, *again)],
        "iterations": ceres.num_successful_steps
        + ceres.num_unsuccessful_steps
        - 1,  # the start counts as one
        "cost_final": ceres.final_cost / float(observations.sigma_px[0]) ** 2,
        "rms_px": float(np.sqrt(2 * ceres.final_cost / len(observations))),
        "memory_mb": memory_mb[best],
        "detail": "; ".join([", ".join(used), *others]),
    }
    print(json.dumps(measured))
    return 0


if __name__ == "__main__":
    run(main)
