"""A rig that is estimated within its uncertainty, held, or considered."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pancam_graph import Freedom, Sharing, SimulationOptions, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import wrap_angle
from pancam_graph.data import FIXED, RigTreatment, Solution, VerdictTest, sharing_within
from pancam_graph.rigs import Rig, RigUncertainty, ladybug3, mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.smoother._incremental import solve_incrementally
from pancam_graph.solve import judge
from support.solving import fitted

EXACT = RigUncertainty.exact()
TO_THE_END = SolveOptions(loss="none", relative_decrease=1e-12)


@cache
def drive(seed: int = 3, **options: object) -> Simulation:
    small = SimulationOptions(stops=2, pans=9, points_per_image=14)
    return simulate(mer_navcam(), replace(small, **options), seed=seed)  # type: ignore[arg-type]  # by name


@cache
def solved(rig: RigTreatment) -> Solution:
    """The drive of seed 3."""
    return solve(drive().traverse, SolveOptions(rig=rig, landmark_covariances=True))


def with_rig(traverse: Traverse, rig: Rig) -> Traverse:
    return replace(traverse, rig=rig)


def with_focal(rig: Rig, share: float, sigma: float) -> Rig:
    """A rig that claims focal lengths so much too long, and so sure of them."""
    eyes = []
    for eye in rig.eyes:
        K = eye.camera.pinhole.calibration_matrix
        K[:2, :2] *= 1 + share
        eyes.append(replace(eye, camera=eye.camera.with_calibration(K)))
    return replace(rig, eyes=tuple(eyes), uncertainty=replace(rig.uncertainty, focal=sigma))


def named(solution: Solution, name: str) -> VerdictTest:
    assert solution.verdict is not None
    return next(test for test in solution.verdict.tests if test.name == name)


# --- what is free ---


def test_a_rigid_mast_has_all_numbers_free_within_their_uncertainty() -> None:
    sharing = sharing_within(RigUncertainty(focal=0.01, principal_point_px=3.0, mount_m=0.0), "mast")
    assert sharing.calibration.entries("calibration") == ("focal", "aspect", "skew_px", "cx_px", "cy_px")
    assert sharing.calibration.sigma["focal"] == 0.01
    assert sharing.calibration.sigma["cx_px"] == 3.0
    assert sharing.mounts.entries("mounts") == ("rx_rad", "ry_rad", "rz_rad")
    assert sharing.pan_T_tilt.scope == "all"


def test_other_models_have_only_what_they_depend_on() -> None:
    for model in ("circle", "free"):
        sharing = sharing_within(RigUncertainty(), model)
        assert sharing.calibration.scope == "eye"
        assert sharing.mounts == sharing.pan_T_tilt == sharing.flex == FIXED
    assert not sharing_within(RigUncertainty(), "projective").any_free
    assert not sharing_within(EXACT, "mast").any_free
    assert sharing_within(ladybug3().uncertainty, "mast").pan_T_tilt == FIXED


def test_a_sharing_of_the_users_counts_in_place_of_it() -> None:
    chosen = Sharing(calibration=Freedom(scope="eye", free=("focal",)))
    by_option = solve(drive().traverse, SolveOptions(rig="estimated", sharing=chosen))
    by_file = solve(replace(drive().traverse, sharing=chosen), SolveOptions(rig="estimated"))
    assert [r.entry for r in by_option.refined] == [r.entry for r in by_file.refined] == ["focal", "focal"]


def test_what_cannot_be_considered_is_refused() -> None:
    with pytest.raises(InputError, match="rig: expected estimated or held with the model circle"):
        SolveOptions(rig="considered", model="circle")
    with pytest.raises(InputError, match="rig: expected one of estimated, held, considered; found 'exact'"):
        SolveOptions(rig="exact")  # type: ignore[arg-type]  # what is tested
    chosen = Sharing(calibration=Freedom(scope="eye", free=("focal",)))
    with pytest.raises(InputError, match="rig: expected estimated or held where a sharing says what is free"):
        solve(drive().traverse, SolveOptions(rig="considered", sharing=chosen))


# --- estimated ---


def test_without_noise_an_estimated_rig_is_exact() -> None:
    exact = drive(noise_px=0.0, prior="truth")
    solution = solve(exact.traverse, replace(TO_THE_END, rig="estimated"))
    assert np.abs(wrap_angle(solution.final.pan_tilt_rad - exact.truth.pan_tilt_rad)).max() < 1e-9
    assert max(abs(r.change) for r in solution.refined) < 1e-7
    assert len(solution.refined) == 2 * (5 + 6) + 6


def test_what_images_cannot_tell_stays_at_the_prior_quietly() -> None:
    solution = solved("estimated")
    assert solution.passed
    assert not solution.warnings
    assert not named(solution, "rig uncertainty").is_note
    assert all(r.sigma <= 1.0001 * r.prior_sigma for r in solution.refined)
    # A shift of the tilt axis upwards is one with a shift of the mast, and of all points.
    height = next(r for r in solution.refined if (r.quantity, r.entry) == ("pan_T_tilt", "z_m"))
    assert height.sigma == pytest.approx(height.prior_sigma, rel=1e-3)


def test_a_wrong_rig_is_found_where_its_uncertainty_allows_it() -> None:
    traverse = with_rig(drive().traverse, with_focal(mer_navcam(), 0.05, sigma=0.05))
    solution = solve(traverse, SolveOptions(rig="estimated"))
    assert solution.passed
    focal = [r.change for r in solution.refined if r.entry == "focal"]
    np.testing.assert_allclose(focal, 1 / 1.05 - 1, atol=1e-3)


def test_a_narrow_prior_that_images_contradict_fails() -> None:
    traverse = with_rig(drive().traverse, with_focal(mer_navcam(), 0.05, sigma=0.001))
    solution = solve(traverse, SolveOptions(rig="estimated"))
    assert not solution.passed
    assert not named(solution, "rig").passed
    note = named(solution, "rig uncertainty")
    assert note.is_note
    assert "state a larger one" in note.says


def test_stop_by_stop_an_estimated_rig_is_that_of_the_whole_drive() -> None:
    traverse = drive(rig_error="drawn").traverse
    whole = solve(traverse, replace(TO_THE_END, rig="estimated"))
    steps = solve_incrementally(traverse, SolveOptions(loss="none", rig="estimated"))
    for a, b in zip(whole.refined, steps.refined, strict=True):
        assert abs(a.change - b.change) < 0.05 * a.sigma


@pytest.mark.slow
@pytest.mark.parametrize("eyes", [2, 1])
def test_errors_of_drawn_rigs_agree_with_their_sigmas(eyes: int) -> None:
    """Squared error over variance of pans, tilts, stops and of the rig's own numbers, over seeds."""
    angles, stops, rigs = list[float](), list[float](), list[float]()
    rig = mer_navcam()
    rig = replace(rig, eyes=rig.eyes[:eyes])
    options = SimulationOptions(stops=2, pans=9, points_per_image=20, rig_error="drawn")
    for seed in range(300, 330):
        made = simulate(rig, options, seed=seed)
        found = solve(made.traverse, SolveOptions(rig="estimated"))
        off = wrap_angle(found.final.pan_tilt_rad - made.truth.pan_tilt_rad) / found.angle_sigma_rad
        pose = made.truth.world_T_mast[1].localCoordinates(found.final.world_T_mast[1])
        angles.append(float(np.mean(off**2)))
        stops.append(float(np.mean(pose**2 / np.diag(found.stop_covariance[1]))))
        rigs.append(float(np.mean([(r.change / r.prior_sigma) ** 2 for r in found.refined])))
    assert np.mean(angles) == pytest.approx(1.0, abs=0.3)
    assert np.mean(stops) == pytest.approx(1.0, abs=0.3)
    assert np.mean(rigs) < 1.0  # an estimate varies less than its prior


# --- held and considered ---


def test_a_held_rig_is_that_of_a_sharing_of_nothing() -> None:
    held = solved("held")
    chosen = solve(drive().traverse, SolveOptions(rig="estimated", sharing=Sharing()))
    np.testing.assert_array_equal(held.residual_final_px, chosen.residual_final_px)
    np.testing.assert_array_equal(held.stop_covariance, chosen.stop_covariance)
    assert not held.refined


def test_a_considered_rig_moves_nothing() -> None:
    stiff = replace(mer_navcam(), uncertainty=replace(mer_navcam().uncertainty, flex_rad=0.0))
    held, considered = (
        solve(with_rig(drive().traverse, stiff), SolveOptions(rig=rig)) for rig in ("held", "considered")
    )
    np.testing.assert_array_equal(held.residual_final_px, considered.residual_final_px)
    assert not considered.refined
    assert np.all(considered.angle_sigma_rad > held.angle_sigma_rad)
    assert considered.mast_covariance is not None
    np.testing.assert_allclose(
        considered.mast_covariance.of(0, 1)[6:, 6:], considered.stop_covariance[1], rtol=1e-6
    )


def test_a_considered_rig_adds_what_its_errors_do_to_the_solution() -> None:
    """C - C_held is the sum of squares of what one sigma of each number does, by solving again."""
    exact = drive(noise_px=0.0, prior="truth")
    few = replace(EXACT, focal=1e-4, tilt_axis_m=1e-4)
    t = with_rig(exact.traverse, replace(mer_navcam(), uncertainty=few))
    fit = fitted(t, replace(TO_THE_END, rig="considered", landmark_covariances=True))
    judged = judge(fit)
    base = judged.state
    angle = np.zeros((len(t.frames), 2))
    stop, points = np.zeros((6, 6)), np.zeros((len(base.landmarks_m), 3, 3))
    rigs = []
    for i in range(2):
        K = t.rig.eyes[i].camera.pinhole.calibration_matrix
        K[:2, :2] *= 1 + few.focal
        eyes = list(t.rig.eyes)
        eyes[i] = replace(eyes[i], camera=eyes[i].camera.with_calibration(K))
        rigs.append(replace(t.rig, eyes=tuple(eyes)))
    for k in range(3):
        pose = t.rig.pan_T_tilt
        shift = type(pose)(pose.rotation(), pose.translation() + few.tilt_axis_m * np.eye(3)[k])
        rigs.append(replace(t.rig, pan_T_tilt=shift))
    for rig in rigs:
        other = judge(fitted(with_rig(t, rig), replace(TO_THE_END, rig="held"))).state
        angle += (other.pan_tilt_rad - base.pan_tilt_rad) ** 2
        step = base.world_T_mast[1].localCoordinates(other.world_T_mast[1])
        stop += np.outer(step, step)
        moved = other.landmarks_m - base.landmarks_m
        points += moved[:, :, None] * moved[:, None, :]
    held, stated = judged.uncertainty, judged.stated
    np.testing.assert_allclose(stated.angle_sigma_rad**2 - held.angle_sigma_rad**2, angle, rtol=0.02)
    more = stated.stop_covariance[1] - held.stop_covariance[1]
    np.testing.assert_allclose(more, stop, atol=0.02 * np.abs(stop).max())
    assert stated.landmark_covariance_m2 is not None
    assert held.landmark_covariance_m2 is not None
    near = np.linalg.norm(base.landmarks_m, axis=1) < 15
    more_points = (stated.landmark_covariance_m2 - held.landmark_covariance_m2)[near]
    size = np.sqrt(np.einsum("nii,njj->n", points[near], points[near]))
    assert np.all(np.abs(more_points - points[near]).max(axis=(1, 2)) < 0.05 * size)


@pytest.mark.slow
def test_the_flex_of_frames_is_estimated_where_the_rig_is_considered() -> None:
    """It is no number of the rig: where nothing else is uncertain, considered and estimated are the same."""
    bends = with_rig(drive().traverse, replace(mer_navcam(), uncertainty=replace(EXACT, flex_rad=1e-3)))
    estimated, considered = (solve(bends, SolveOptions(rig=rig)) for rig in ("estimated", "considered"))
    np.testing.assert_array_equal(estimated.final.pan_tilt_rad, considered.final.pan_tilt_rad)
    np.testing.assert_array_equal(estimated.angle_sigma_rad, considered.angle_sigma_rad)
    held = solve(bends, SolveOptions(rig="held"))
    assert np.all(considered.angle_sigma_rad > 1.01 * held.angle_sigma_rad)
    by_steps = solve_incrementally(bends, SolveOptions(rig="considered"))
    np.testing.assert_allclose(by_steps.angle_sigma_rad, considered.angle_sigma_rad, rtol=1e-3)
    off = by_steps.final.pan_tilt_rad - considered.final.pan_tilt_rad
    assert np.abs(off / considered.angle_sigma_rad).max() < 0.05


@pytest.mark.slow
def test_errors_of_drawn_rigs_that_are_considered_agree_with_their_sigmas() -> None:
    """Squared error over variance of neighbours' pans and tilts and of the second stop, over seeds."""
    squares = list[tuple[float, float]]()
    options = SimulationOptions(stops=2, pans=9, points_per_image=20, rig_error="drawn")
    for seed in range(400, 430):
        made = simulate(mer_navcam(), options, seed=seed)
        # Without screening: residuals of a rig that is not moved are not noise.
        found = solve(made.traverse, SolveOptions(rig="considered", loss="none"))
        off = wrap_angle(found.final.pan_tilt_rad - made.truth.pan_tilt_rad) / found.angle_sigma_rad
        pose = made.truth.world_T_mast[1].localCoordinates(found.final.world_T_mast[1])
        squares.append((float(np.mean(off**2)), float(np.mean(pose**2 / np.diag(found.stop_covariance[1])))))
    np.testing.assert_allclose(np.mean(squares, axis=0), 1.0, atol=0.35)


def test_an_exact_rig_that_is_considered_is_held() -> None:
    traverse = with_rig(drive().traverse, replace(mer_navcam(), uncertainty=EXACT))
    considered = solve(traverse, SolveOptions(rig="considered"))
    held = solve(traverse, SolveOptions(rig="held"))
    np.testing.assert_array_equal(considered.angle_sigma_rad, held.angle_sigma_rad)
