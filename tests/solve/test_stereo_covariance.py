"""Covariances of places that stereo pairs see: against what angles alone do, and over seeds."""

from dataclasses import replace

import numpy as np
import pytest

from pancam_graph import SimulationOptions, Solution, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.geometry import FloatArray
from pancam_graph.rigs import rig_template
from pancam_graph.simulate import Truth

DRIVE = SimulationOptions(
    stops=1, pans=3, sweep_rad=None, tilts_rad=(-0.3,), points_per_image=8, rig_error="none"
)


def symmetric(entries: FloatArray) -> FloatArray:
    """(..., 3, 3) of (..., 6)."""
    return entries[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def node(solution: Solution, pair: int, depth: int, row: int, column: int) -> tuple[FloatArray, FloatArray]:
    """World point of a node, and its covariance (3, 3) in the world, square metres."""
    found = solution.stereo_covariance
    assert found is not None
    n = found.covariance.shape[2]
    left, extent = found.left[pair], found.extent[pair]
    share = np.array([column, row]) / (n - 1)
    x, y = extent[::2] + share * (extent[1::2] - extent[::2])
    z, R = found.depth_m[depth], solution.final.world_R_camera[left]
    to_camera = z * np.array([[1, 0, -x], [0, 1, -y], [0, 0, -1]])
    covariance = R @ to_camera @ symmetric(found.covariance[pair, depth, row, column]) @ to_camera.T @ R.T
    return solution.final.world_t_camera[left] + R @ np.array([x, y, 1.0]) * z, covariance


def test_with_a_held_rig_the_angles_of_a_held_stop_are_all_that_moves_what_it_sees() -> None:
    traverse = simulate(rig_template("mer-navcam"), DRIVE, seed=5).traverse
    solution = solve(traverse, SolveOptions(rig="held", loss="none", stereo_covariances=True))
    found = solution.stereo_covariance
    assert found is not None
    assert (
        traverse.image_frame[found.left].tolist() == traverse.image_frame[found.right].tolist() == [0, 1, 2]
    )
    mast = solution.final.world_T_mast[0]
    up = mast.rotation().matrix()[:, 2]
    for pair in range(3):
        pan_rad = solution.final.pan_tilt_rad[pair, 0]
        ahead = mast.rotation().matrix() @ np.array([np.cos(pan_rad), np.sin(pan_rad), 0.0])
        for depth, row, column in ((1, 3, 3), (4, 5, 1), (8, 2, 6)):
            point, covariance = node(solution, pair, depth, row, column)
            arm = point - mast.translation()
            lifted = np.sqrt(up @ covariance @ up)
            assert lifted == pytest.approx(solution.angle_sigma_rad[pair, 1] * (arm @ ahead), rel=1e-4)
            # The pan turns it about the mast, the tilt not along the axis of the tilt.
            side = np.cross(up, ahead)
            aside = np.sqrt(side @ covariance @ side)
            assert aside == pytest.approx(solution.angle_sigma_rad[pair, 0] * abs(arm @ ahead), rel=1e-4)


def test_it_is_there_only_where_it_is_asked_for_and_can_be_known() -> None:
    traverse = simulate(rig_template("mer-navcam"), DRIVE, seed=5).traverse
    assert solve(traverse, SolveOptions(rig="held", loss="none")).stereo_covariance is None
    asked = SolveOptions(model="free", loss="none", stereo_covariances=True)
    assert solve(traverse, asked).stereo_covariance is None
    one_eye = replace(traverse.rig, eyes=traverse.rig.eyes[:1])
    left = simulate(one_eye, DRIVE, seed=5).traverse
    assert (
        solve(left, SolveOptions(rig="held", loss="none", stereo_covariances=True)).stereo_covariance is None
    )


def true_place(
    traverse: Traverse, truth: Truth, solution: Solution, pair: int, point: FloatArray
) -> FloatArray:
    """Where the true cameras have what the estimated ones see at a point, by the pixels of both eyes."""
    found = solution.stereo_covariance
    assert found is not None and truth.world_T_mast is not None
    true = replace(
        traverse,
        rig=truth.rig,
        stops=tuple(
            replace(stop, world_T_mast=pose)
            for stop, pose in zip(traverse.stops, truth.world_T_mast, strict=True)
        ),
        frames=tuple(
            replace(frame, pan_rad=float(pan), tilt_rad=float(tilt))
            for frame, (pan, tilt) in zip(traverse.frames, truth.pan_tilt_rad, strict=True)
        ),
    )
    R, centre = true.camera_poses(flex=truth.flex)
    rows = [int(found.left[pair]), int(found.right[pair])]

    def pixels(at: FloatArray) -> FloatArray:
        each = [
            true.rig.eyes[true.image_eye[i]].camera.project((at - centre[i])[None] @ R[i])[0][0] for i in rows
        ]
        return np.concatenate(each)

    state = solution.final
    seen = np.concatenate(
        [
            solution.image_cameras[i].project(
                (point - state.world_t_camera[i])[None] @ state.world_R_camera[i]
            )[0][0]
            for i in rows
        ]
    )
    at, step = point.copy(), 1e-4
    for _ in range(4):
        slope = np.column_stack([(pixels(at + d) - pixels(at - d)) / (2 * step) for d in step * np.eye(3)])
        at = at + np.linalg.lstsq(slope, seen - pixels(at), rcond=None)[0]
    return at


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mer-navcam", "msl-navcam"])
def test_places_err_over_seeds_as_their_covariances_say(name: str) -> None:
    options = SimulationOptions(stops=2, pans=4, sweep_rad=None, points_per_image=15, rig_error="drawn")
    seeds = range(3100, 3140)
    squared = np.empty((len(seeds), 4))
    for i, seed in enumerate(seeds):
        simulation = simulate(rig_template(name), options, seed=seed)
        solution = solve(simulation.traverse, SolveOptions(stereo_covariances=True))
        assert solution.stereo_covariance is not None
        last = len(solution.stereo_covariance.left) - 1
        for k, (pair, depth, row, column) in enumerate(
            ((0, 2, 3, 3), (0, 6, 1, 5), (last, 2, 5, 2), (last, 5, 3, 3))
        ):
            point, covariance = node(solution, pair, depth, row, column)
            off = point - true_place(simulation.traverse, simulation.truth, solution, pair, point)
            squared[i, k] = off @ np.linalg.solve(covariance, off) / 3
    # Four nodes of 40 seeds with three numbers each that hang together: standard error 0.1 of each mean.
    assert np.all((squared.mean(axis=0) > 0.65) & (squared.mean(axis=0) < 1.45))
    assert squared.max() < 9
