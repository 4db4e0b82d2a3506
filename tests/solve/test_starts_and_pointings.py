"""Starts in other turns than telemetry's, and heads that look straight down."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.graph import Model
from pancam_graph.initialise import Start, start_from_telemetry
from pancam_graph.rigs import TEMPLATES, mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.solve import prepare
from support.parameters import slow_but_for
from support.small_drives import SMALL
from support.truth import errors_in_sigmas

MODELS: tuple[Model, ...] = ("mast", "circle", "free")


@pytest.mark.parametrize(
    ("model", "first_rad"),
    slow_but_for([("mast", 0.0), ("free", -4 * np.pi)], product(MODELS, [0.0, -4 * np.pi])),
)
def test_pans_of_a_start_may_be_in_any_turn(model: Model, first_rad: float) -> None:
    """A prior 360 degrees away gave a cost of 1e8 at the start, which explicit landmarks never left."""
    simulation = simulate(mer_navcam(), replace(SMALL, sweep_rad=2.0), seed=0)
    t = simulation.traverse
    options = SolveOptions(model=model)
    usual = solve(t, options)
    said = start_from_telemetry(t)
    pan, tilt = said.pan_tilt_rad.T
    turned = np.column_stack([first_rad + np.mod(pan, 2 * np.pi), tilt])
    assert np.abs(turned - said.pan_tilt_rad).max() > 6  # some are a turn away
    solution = solve(t, options, start=replace(said, pan_tilt_rad=turned))
    assert solution.converged
    assert solution.cost_initial == pytest.approx(usual.cost_initial, rel=1e-6)
    np.testing.assert_allclose(solution.final.pan_tilt_rad, usual.final.pan_tilt_rad, atol=1e-5)


def test_a_start_for_another_number_of_frames_is_refused() -> None:
    t = simulate(mer_navcam(), SMALL, seed=0).traverse
    start = Start(world_T_mast=tuple(s.world_T_mast for s in t.stops), pan_tilt_rad=t.pan_tilt_rad[1:])
    with pytest.raises(InputError, match=r"start: pan_tilt_rad: expected shape .* found"):
        solve(t, start=start)


def straight_down(seed: int) -> Simulation:
    """Left eyes stand where right eyes stood half a turn before, and see the same ground."""
    options = SimulationOptions(stops=2, spacing_m=0.5, pans=6, tilts_rad=(-np.pi / 2,))
    return simulate(mer_navcam(), options, seed=seed)


@pytest.mark.parametrize(("model", "left_out"), [("mast", 0), ("circle", 7)])
def test_free_cameras_do_without_tracks_seen_from_one_place(model: Model, left_out: int) -> None:
    prepared = prepare(straight_down(8011).traverse, SolveOptions(model=model))
    assert np.count_nonzero(prepared.reason == "single") == 2 * left_out
    assert any("7 tracks seen from one place" in w for w in prepared.warnings) == (left_out > 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [8008, 8011, 8013, 8014])
def test_heads_that_look_straight_down_on_a_circle_converge(seed: int) -> None:
    """With tracks seen from one place alone these four of twenty drives did not."""
    simulation = straight_down(seed)
    solution = solve(simulation.traverse, SolveOptions(model="circle"))
    assert solution.passed
    assert np.abs(errors_in_sigmas(simulation, solution)[0]).max() < 5


@pytest.mark.parametrize(
    ("model", "tilt_deg"),
    slow_but_for(
        [("mast", -88.9), ("circle", -59.0), ("free", -61.0), ("free", -90.0)],
        product(MODELS, [-90.0, -88.9, -61.0, -59.0]),
    ),
)
def test_pan_is_known_where_the_head_looks_down(model: Model, tilt_deg: float) -> None:
    """There the x axis of the head has no pan: read from it, pans were 2.7 rad off, their sigmas 8.8."""
    options = SimulationOptions(
        stops=2, spacing_m=0.5, pans=6, points_per_image=8, tilts_rad=(float(np.deg2rad(tilt_deg)),)
    )
    simulation = simulate(mer_navcam(), options, seed=0)
    solution = solve(simulation.traverse, SolveOptions(model=model))
    angles, _ = errors_in_sigmas(simulation, solution)
    assert np.abs(angles).max() < 5
    assert np.rad2deg(solution.angle_sigma_rad.max()) < 1


@pytest.mark.slow
def test_pictures_that_hardly_overlap_do_not_tell_focal_lengths_and_say_so() -> None:
    """Five pans of 60 degrees around a turn share a point or two: what was told badly stays as badly known.

    Each eye's focal length is 5 % off as its sigma says, pans and tilts 50 mrad; the solution passes, and
    its sigmas are what its errors are.
    """
    told_rad, told_focal = 0.05, 0.05
    rig = TEMPLATES["stereo-pan-tilt"]()
    options = SimulationOptions(stops=1, pans=5, tilts_rad=(-0.45,), points_per_image=40)
    squares = []
    for seed in range(1, 9):
        made, rng = simulate(rig, options, seed=seed), np.random.default_rng([seed, 2])
        eyes = []
        for eye in rig.eyes:
            K = eye.camera.pinhole.calibration_matrix.copy()
            K[:2, :2] *= 1 + told_focal * rng.standard_normal()
            eyes.append(replace(eye, camera=eye.camera.with_calibration(K)))
        wide = replace(rig.uncertainty, focal=told_focal)
        angles = made.truth.pan_tilt_rad + told_rad * rng.standard_normal(made.truth.pan_tilt_rad.shape)
        frames = [
            replace(f, pan_rad=float(p), tilt_rad=float(t), sigma_pan_rad=told_rad, sigma_tilt_rad=told_rad)
            for f, (p, t) in zip(made.traverse.frames, angles, strict=True)
        ]
        told = replace(rig, eyes=tuple(eyes), uncertainty=wide)
        solution = solve(replace(made.traverse, rig=told, frames=tuple(frames)))
        assert solution.passed
        focal = [entry for entry in solution.refined if entry.entry == "focal"]
        assert min(entry.sigma for entry in focal) > 0.5 * told_focal
        squares.append(errors_in_sigmas(made, solution)[0] ** 2)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.45)  # 80 numbers, three of their standard errors
    assert np.max(squares) < 16
