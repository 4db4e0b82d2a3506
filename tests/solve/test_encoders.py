"""Encoders whose readings have a scale, which is found or said, and an offset, which is a turn of an axis."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, Traverse, build_graph, graph_keys, simulate, solve
from pancam_graph.base.geometry import wrap_angle
from pancam_graph.data import Solution
from pancam_graph.rigs import RigUncertainty, mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.smoother._incremental import solve_incrementally
from support.small_drives import HARD, SMALL, near_part
from support.truth import errors_in_sigmas

EXACT = RigUncertainty.exact()
SERVO = replace(EXACT, pan_scale=0.02, tilt_scale=0.02)
SCALE = np.array([0.011, -0.016])
PART = SimulationOptions(stops=2, pans=9, points_per_image=20)
"""Part of a panorama: no ring closes, so that focal length and scale of pans look alike."""
TO_THE_END = SolveOptions(loss="none", relative_decrease=1e-12)


def read_with(traverse: Traverse, uncertainty: RigUncertainty, scale: np.ndarray = SCALE) -> Traverse:
    """A traverse whose angles are a scale times what it says, and whose rig is so uncertain."""
    frames = tuple(
        replace(f, pan_rad=f.pan_rad / (1 + scale[0]), tilt_rad=f.tilt_rad / (1 + scale[1]))
        for f in traverse.frames
    )
    return replace(traverse, frames=frames, rig=replace(traverse.rig, uncertainty=uncertainty))


@cache
def drive(seed: int = 3, **options: object) -> Simulation:
    return simulate(mer_navcam(), replace(PART, **options), seed=seed)  # type: ignore[arg-type]  # by name


def scale_of(solution: Solution) -> np.ndarray:
    assert [r.entry for r in solution.refined if r.quantity == "encoders"] == ["pan_scale", "tilt_scale"]
    return np.array([r.change for r in solution.refined if r.quantity == "encoders"])


def test_without_noise_the_scale_is_exact() -> None:
    made = drive(noise_px=0.0, prior="truth")
    solution = solve(read_with(made.traverse, SERVO), TO_THE_END)
    # Its prior pulls: by the square of what telemetry says over what the prior does.
    assert scale_of(solution) == pytest.approx(SCALE, abs=2e-4)
    wide = solve(read_with(made.traverse, replace(SERVO, pan_scale=1e3, tilt_scale=1e3)), TO_THE_END)
    assert scale_of(wide) == pytest.approx(SCALE, abs=1e-9)
    assert np.abs(wrap_angle(wide.final.pan_tilt_rad - made.truth.pan_tilt_rad)).max() < 1e-9


def test_a_scale_is_found_within_its_sigma_or_the_verdict_fails() -> None:
    made = drive()
    solution = solve(read_with(made.traverse, SERVO))
    assert solution.passed
    angles, stops = errors_in_sigmas(made, solution)
    assert np.abs(angles).max() < 5
    assert stops.max() < 3
    sigma = np.array([r.sigma for r in solution.refined])
    assert np.abs((scale_of(solution) - SCALE) / sigma).max() < 4
    assert sigma.max() < 2e-3
    assert not solve(read_with(made.traverse, EXACT)).passed


@pytest.mark.parametrize("way", ["stop by stop", pytest.param("explicit", marks=pytest.mark.slow)])
def test_stop_by_stop_and_explicit_landmarks_have_the_same_scale(way: str) -> None:
    near = near_part(simulate(mer_navcam(), SMALL, seed=2))
    traverse = read_with(near, replace(SERVO, flex_rad=2e-4))
    whole = solve(traverse, TO_THE_END)
    if way == "explicit":
        other = solve(traverse, replace(TO_THE_END, landmarks="explicit"))
    else:
        other = solve_incrementally(traverse, SolveOptions(loss="none"))
    assert other.cost_final == pytest.approx(whole.cost_final, rel=1e-6)
    np.testing.assert_allclose(other.angle_sigma_rad, whole.angle_sigma_rad, rtol=1e-4)
    for a, b in zip(whole.refined, other.refined, strict=True):
        assert abs(a.change - b.change) < 0.02 * a.sigma
        assert b.sigma == pytest.approx(a.sigma, rel=1e-2)


@pytest.mark.slow
def test_the_graph_has_the_same_cost() -> None:
    near = read_with(near_part(simulate(mer_navcam(), SMALL, seed=2)), SERVO)
    options = replace(HARD, rig="estimated")
    ours, keys = solve(near, options), graph_keys(near, options)
    graph, values = build_graph(near, options)
    assert keys.entries(keys.encoders()) == ("pan_scale", "tilt_scale")
    values.update(keys.encoders(), scale_of(ours))
    for stop, pose in zip(near.stops, ours.final.world_T_mast, strict=True):
        values.update(keys.mast(stop.id), pose)
    for i, frame in enumerate(near.frames):
        values.update(keys.angles(frame.id), ours.final.pan_tilt_rad[i])
    for i, point in enumerate(ours.final.landmarks_m):
        if values.exists(key := gtsam.symbol("L", i)):
            values.update(key, point)
    assert graph.error(values) == pytest.approx(ours.cost_final, rel=1e-6)


@pytest.mark.slow
def test_a_scale_that_is_considered_is_in_the_sigmas() -> None:
    """By as much as a scale of one sigma, solved again, moves each angle."""
    t = drive(noise_px=0.0, prior="truth").traverse
    few = replace(EXACT, pan_scale=1e-2)
    considered = solve(read_with(t, few, np.zeros(2)), replace(TO_THE_END, rig="considered"))
    held = replace(TO_THE_END, rig="held")
    base, moved = (solve(read_with(t, few, np.array([s, 0.0])), held) for s in (0.0, 1e-2))
    expected = np.hypot(base.angle_sigma_rad, moved.final.pan_tilt_rad - base.final.pan_tilt_rad)
    assert np.max(expected / base.angle_sigma_rad) > 1.02
    np.testing.assert_allclose(considered.angle_sigma_rad, expected, rtol=0.01)  # of first order


def test_a_wrong_frame_is_let_go_beside_a_scale() -> None:
    made = drive()
    frames = list(made.traverse.frames)
    frames[4] = replace(frames[4], pan_rad=frames[4].pan_rad + np.deg2rad(3.0))
    traverse = read_with(replace(made.traverse, frames=tuple(frames)), SERVO)
    solution = solve(traverse)
    assert solution.passed
    assert any("the pan of frame00004" in w and w.endswith("let go") for w in solution.warnings)
    assert np.abs(errors_in_sigmas(made, solution)[0]).max() < 5


def test_an_offset_of_readings_is_a_turn_of_the_tilt_axis() -> None:
    """Of tilts about y; of pans about z, where the tilt axis stands on the pan axis as in the design."""
    rig, angles = mer_navcam(), np.array([[1.1, -0.3], [-2.0, 0.2]])
    off = np.array([4e-3, -7e-3])
    eye = np.zeros(2, dtype=np.int64)
    turn = gtsam.Rot3.Rz(off[0]) * rig.pan_T_tilt.rotation() * gtsam.Rot3.Ry(-off[1])
    assert not rig.pan_T_tilt.translation()[:2].any()
    turned = replace(rig, pan_T_tilt=gtsam.Pose3(turn, rig.pan_T_tilt.translation()))
    for a, b in zip(rig.mast_T_camera(angles + off, eye), turned.mast_T_camera(angles, eye), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.slow
def test_errors_of_drawn_scales_agree_with_their_sigmas() -> None:
    """Squared error over variance of angles, stops and scales over seeds, all of the rig drawn."""
    rig = mer_navcam()
    rig = replace(rig, uncertainty=replace(rig.uncertainty, pan_scale=0.01, tilt_scale=0.01))
    squares = []
    for seed in range(300, 330):
        made = simulate(rig, replace(PART, rig_error="drawn"), seed=seed)
        found = solve(made.traverse)
        assert found.passed
        angles, stops = errors_in_sigmas(made, found)
        squares.append((np.mean(angles**2), np.mean(stops**2)))
    np.testing.assert_allclose(np.mean(squares, axis=0), 1.0, atol=0.3)
