"""The model `projective` solved: exact without noise, honest with it, as `free` where its K is firm."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph import SimulationOptions, SolveOptions, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, pan_tilt_from_rotation, pose_arrays
from pancam_graph.data import ENTRIES, Freedom, Sharing
from pancam_graph.graph import Flex
from pancam_graph.initialise import FreeCameras, Start, extract_free, start_from_cameras
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import Simulation
from support.parameters import slow_but_for

SMALL = SimulationOptions(stops=2, pans=3, sweep_rad=1.5, points_per_image=15)
TO_THE_END = SolveOptions(rig="held", model="projective", loss="none", relative_decrease=1e-12)


@cache
def small(seed: int = 2) -> Simulation:
    return simulate(mer_navcam(), SMALL, seed=seed)


def telemetry(simulation: Simulation, cameras: FreeCameras | None = None) -> Start:
    start = simulation.telemetry_start
    return Start(world_T_mast=start.world_T_mast, pan_tilt_rad=start.pan_tilt_rad, cameras=cameras)


def cameras_of(
    simulation: Simulation, seed: int = 0, *, turn_rad: float = 0, shift_m: float = 0, focal: float = 0
) -> FreeCameras:
    """The true cameras, disturbed: rotation, centre and the five numbers of K in focal lengths."""
    t, rng = simulation.traverse, np.random.default_rng(seed)
    R, centre = t.camera_poses(simulation.truth.world_T_mast, simulation.truth.pan_tilt_rad)
    n, f = len(R), t.calibration[:, 0, 0]
    turn = Rotation.from_rotvec(rng.normal(0, 1, (n, 3)) * turn_rad).as_matrix()
    K = t.calibration.copy()
    for row, column in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2)):
        K[:, row, column] += focal * f * rng.normal(0, 1, n)
    centre = centre + shift_m * rng.normal(0, 1, (n, 3))
    return FreeCameras(calibration=K, world_R_camera=R @ turn, centre_m=centre)


def test_without_noise_the_truth_comes_back() -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, noise_px=0.0, prior="truth"), seed=3)
    disturbed = cameras_of(simulation, turn_rad=2e-3, shift_m=0.01, focal=3e-3)
    solution = solve(simulation.traverse, TO_THE_END, start=telemetry(simulation, disturbed))
    true = cameras_of(simulation)
    assert solution.cost_initial > 1e3
    assert solution.cost_final < 1e-12
    assert solution.projections == pytest.approx(true.projections, rel=1e-7, abs=1e-6)
    assert solution.calibration == pytest.approx(true.calibration, abs=1e-5)
    assert solution.final.world_t_camera == pytest.approx(true.centre_m, abs=1e-8)
    assert solution.final.pan_tilt_rad == pytest.approx(simulation.truth.pan_tilt_rad, abs=1e-8)
    for found, expected in zip(solution.final.world_T_mast, simulation.truth.world_T_mast, strict=True):
        assert np.abs(expected.localCoordinates(found)).max() < 1e-8
    truth = simulation.truth.landmarks_m[solution.landmark_track]
    assert solution.final.landmarks_m == pytest.approx(truth, rel=1e-4, abs=1e-4)


def test_images_are_reproduced_by_the_matrices_of_a_solution() -> None:
    """Residuals by P and the points alone, nothing of the solver between."""
    solution = solve(small().traverse, TO_THE_END)
    obs = solution.traverse.observations
    assert obs is not None
    row = np.full(obs.track.max() + 1, -1)
    row[solution.landmark_track] = np.arange(len(solution.landmark_track))
    near = np.linalg.norm(solution.final.landmarks_m, axis=1) < 500.0  # further ones are drawn nearer
    shown = solution.used & near[row[obs.track]]
    points = np.column_stack([solution.final.landmarks_m, np.ones(len(near))])[row[obs.track[shown]]]
    h = np.einsum("nij,nj->ni", solution.projections[obs.image[shown]], points)
    assert h[:, :2] / h[:, 2:] - obs.uv_px[shown] == pytest.approx(
        solution.residual_final_px[shown], abs=1e-6
    )
    assert shown.sum() > 500


@pytest.mark.slow
def test_it_fits_no_worse_than_free_and_meets_it_as_the_calibration_gets_firm() -> None:
    """What K gains shrinks with the square of its sigma, once that is small against what images know."""
    free = solve(small().traverse, replace(TO_THE_END, model="free"))
    assert free.converged
    gains, moved = [], []
    for share in (0.05, 1e-4, 1e-5):
        flex = Flex(rotation_rad=0.02, translation_m=0.02, calibration=share)
        found = solve(small().traverse, replace(TO_THE_END, flex=flex))
        assert found.converged
        gains.append((free.cost_final - found.cost_final) / free.cost_final)
        moved.append(np.abs(found.final.world_t_camera - free.final.world_t_camera).max())
    assert gains[0] > 0.02
    assert gains[1] / gains[2] == pytest.approx(100, rel=0.1)
    assert 0 < gains[2] < 2e-5
    assert moved[2] < 5e-6
    assert found.final.pan_tilt_rad == pytest.approx(free.final.pan_tilt_rad, abs=1e-6)
    assert found.angle_sigma_rad == pytest.approx(free.angle_sigma_rad, rel=1e-4)
    assert found.stop_covariance[1] == pytest.approx(free.stop_covariance[1], rel=1e-3, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 1e-3])
def test_it_is_free_with_a_calibration_for_every_image_in_other_numbers(share: float) -> None:
    """The same tie: the same optimum, the same sigmas; poses and K as variables on one side."""
    t = small().traverse
    focal = dict(zip(ENTRIES["calibration"], t.calibration[0][[0, 1, 0, 0, 1], [0, 1, 0, 0, 1]], strict=True))
    freedom = Freedom(scope="image", sigma={name: share * f for name, f in focal.items()})
    flex = Flex(rotation_rad=0.02, translation_m=0.02, calibration=share)
    options = replace(TO_THE_END, flex=flex, model="free", sharing=Sharing(calibration=freedom))
    ours, free = solve(t, replace(options, model="projective", sharing=None)), solve(t, options)
    assert ours.converged
    assert free.converged
    assert ours.cost_final == pytest.approx(free.cost_final, rel=1e-9)
    assert ours.calibration == pytest.approx(free.calibration, abs=1e-2 * share * focal["fx_px"] + 1e-3)
    assert ours.angle_sigma_rad == pytest.approx(free.angle_sigma_rad, rel=1e-3)
    assert ours.stop_covariance[1] == pytest.approx(free.stop_covariance[1], rel=1e-2, abs=1e-8)
    assert len(ours.refined) == len(free.refined) == 5 * len(t.images)
    for a, b in zip(ours.refined, free.refined, strict=True):
        assert (a.quantity, a.entry, a.image, a.camera, a.stop) == (
            b.quantity,
            b.entry,
            b.image,
            b.camera,
            b.stop,
        )
        assert a.nominal == b.nominal
        assert a.prior_sigma == pytest.approx(b.prior_sigma)
        assert a.sigma == pytest.approx(b.sigma, rel=1e-3)
        assert a.change == pytest.approx(b.change, abs=1e-2 * b.sigma)


# --- normalisation ---


def elsewhere(simulation: Simulation, offset_m: FloatArray) -> Simulation:
    """The same in a world whose origin is elsewhere."""

    def shifted(poses: tuple[gtsam.Pose3, ...]) -> tuple[gtsam.Pose3, ...]:
        return tuple(gtsam.Pose3(p.rotation(), p.translation() + offset_m) for p in poses)

    t, truth, start = simulation.traverse, simulation.truth, simulation.telemetry_start
    masts = shifted(tuple(s.world_T_mast for s in t.stops))
    stops = tuple(replace(s, world_T_mast=m) for s, m in zip(t.stops, masts, strict=True))
    return replace(
        simulation,
        traverse=replace(t, stops=stops),
        truth=replace(truth, world_T_mast=shifted(truth.world_T_mast)),
        telemetry_start=replace(start, world_T_mast=shifted(start.world_T_mast)),
    )


@pytest.mark.slow
def test_conditioned_or_not_the_optimum_is_the_same() -> None:
    ours, raw = (solve(small().traverse, replace(TO_THE_END, normalise=n)) for n in (True, False))
    assert ours.converged
    assert raw.converged
    assert raw.cost_final == pytest.approx(ours.cost_final, rel=1e-9)
    assert raw.final.world_t_camera == pytest.approx(ours.final.world_t_camera, abs=1e-5)
    assert raw.stop_covariance[1] == pytest.approx(ours.stop_covariance[1], rel=1e-4, abs=1e-8)
    assert raw.angle_sigma_rad == pytest.approx(ours.angle_sigma_rad, rel=1e-4)


def disturbed(simulation: Simulation) -> FreeCameras:
    return cameras_of(simulation, turn_rad=2e-3, shift_m=0.01, focal=3e-3)


def test_the_worlds_origin_does_not_matter() -> None:
    """A kilometre away the column of P that places the camera is far larger than the others.

    Without conditioning, Cholesky fails on that and QR goes on, with fewer digits.
    """
    here, away = small(), elsewhere(small(), np.array([1000.0, -1000.0, 100.0]))
    options = SolveOptions(rig="held", model="projective", loss="none", max_iterations=30)
    found = [
        solve(s.traverse, replace(options, normalise=n), start=telemetry(s, disturbed(s)))
        for s, n in ((here, True), (away, True), (away, False))
    ]
    assert [s.converged for s in found] == [True, True, True]
    assert found[1].iterations == found[0].iterations
    assert found[1].cost_final == pytest.approx(found[0].cost_final, rel=1e-6)
    assert found[2].cost_final == pytest.approx(found[0].cost_final, rel=1e-5)


# --- starts ---


@pytest.mark.parametrize("model", slow_but_for("free", ["free", "projective"]))
def test_given_cameras_are_where_the_solve_starts(model: str) -> None:
    simulation = small()
    given = cameras_of(simulation, turn_rad=1e-3, shift_m=5e-3, focal=2e-3 if model == "projective" else 0.0)
    options = replace(TO_THE_END, model=model)  # type: ignore[arg-type]  # a model by name
    solution = solve(simulation.traverse, options, start=telemetry(simulation, given))
    initial = solution.initial
    assert initial.world_R_camera == pytest.approx(given.world_R_camera, abs=1e-12)
    assert initial.world_t_camera == pytest.approx(given.centre_m, abs=1e-12)
    if model == "projective":
        assert initial.rig is not None
        assert initial.rig.calibration(simulation.traverse) == pytest.approx(given.calibration, rel=1e-12)
    assert solution.cost_history[0] == pytest.approx(solution.cost_initial)
    assert solution.cost_final == pytest.approx(solve(simulation.traverse, options).cost_final, rel=1e-7)


def test_a_mast_starts_on_its_chain_whatever_cameras_are_given() -> None:
    simulation = small()
    given = start_from_cameras(simulation.traverse, cameras_of(simulation, shift_m=0.01).projections)
    assert given.cameras is not None
    with_cameras, without = (
        solve(simulation.traverse, SolveOptions(rig="held", loss="none"), start=start)
        for start in (given, replace(given, cameras=None))
    )
    assert with_cameras.cost_history == without.cost_history


def test_start_from_camera_matrices_has_the_cameras_themselves() -> None:
    simulation = small()
    given = cameras_of(simulation, turn_rad=1e-3, shift_m=1e-3, focal=1e-3)
    start = start_from_cameras(simulation.traverse, -3 * given.projections)
    assert start.cameras is not None
    assert start.cameras.projections == pytest.approx(given.projections, rel=1e-9, abs=1e-9)
    options = SolveOptions(rig="held", model="projective", loss="none")
    assert solve(simulation.traverse, options, start=start).converged


def test_a_start_with_cameras_of_other_images_is_refused() -> None:
    simulation = small()
    few = extract_free(cameras_of(simulation).projections[:3])
    with pytest.raises(InputError, match="start: cameras: expected 24, one for each image, found 3"):
        solve(simulation.traverse, TO_THE_END, start=telemetry(simulation, few))


# --- what it says of itself ---


def true_angles(simulation: Simulation, cameras: FreeCameras) -> FloatArray:
    """(frames, 2) mean pan and tilt of a frame's cameras as seen from the mast; heads without twist."""
    t = simulation.traverse
    masts_R, _ = pose_arrays(simulation.truth.world_T_mast)
    mounts_R, _ = pose_arrays([e.head_T_camera for e in t.rig.eyes])
    head = (
        masts_R[t.image_stop].transpose(0, 2, 1)
        @ cameras.world_R_camera
        @ mounts_R[t.image_eye].transpose(0, 2, 1)
    )
    angles = np.column_stack(pan_tilt_from_rotation(head))
    return np.array([angles[t.image_frame == f].mean(axis=0) for f in range(len(t.frames))])


@pytest.mark.slow
def test_errors_are_as_large_as_the_sigmas_say() -> None:
    """Cameras off the mast, and K off the rig's, by what the tie says; over drives that differ in all."""
    flex = Flex(rotation_rad=1e-3, translation_m=2e-3, calibration=1e-3)
    options = SolveOptions(rig="held", model="projective", loss="none", flex=flex)
    angles, stops = [], []
    for seed in range(40):
        simulation = simulate(mer_navcam(), SMALL, seed=seed)
        t, rng = simulation.traverse, np.random.default_rng(seed + 1000)
        obs = t.observations
        assert obs is not None
        cameras = cameras_of(simulation, seed, turn_rad=1e-3, shift_m=2e-3, focal=1e-3)
        points = np.column_stack([simulation.truth.landmarks_m, np.ones(len(simulation.truth.landmarks_m))])
        h = np.einsum("nij,nj->ni", cameras.projections[obs.image], points[obs.track])
        uv = h[:, :2] / h[:, 2:] + rng.normal(0, SMALL.noise_px, (len(h), 2))
        solution = solve(t.with_observations(replace(obs, uv_px=uv)), options)
        assert solution.converged
        error = solution.final.pan_tilt_rad - true_angles(simulation, cameras)
        angles.append((error / solution.angle_sigma_rad) ** 2)
        off = simulation.truth.world_T_mast[1].localCoordinates(solution.final.world_T_mast[1])
        stops.append(off @ np.linalg.solve(solution.stop_covariance[1], off))
    assert np.mean(angles) == pytest.approx(1, abs=0.25)
    assert np.mean(stops) == pytest.approx(6, abs=1.7)  # 3 of its sigmas


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["none", "huber"])
def test_the_number_of_threads_changes_no_bit(monkeypatch: pytest.MonkeyPatch, loss: str) -> None:
    outliers = 0.01 if loss == "huber" else 0.0
    simulation = simulate(
        mer_navcam(), replace(SMALL, pans=4, points_per_image=80, outliers=outliers), seed=0
    )
    assert simulation.traverse.observations is not None
    assert len(simulation.traverse.observations) > 5000  # or else one thread does it all
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)
        found.append(solve(simulation.traverse, SolveOptions(rig="held", model="projective", loss=loss)))  # type: ignore[arg-type]  # a loss by name
    one, three = found
    assert one.cost_history == three.cost_history
    assert np.array_equal(one.calibration, three.calibration)
    assert np.array_equal(one.final.world_t_camera, three.final.world_t_camera)
    assert np.array_equal(one.final.landmarks_m, three.final.landmarks_m, equal_nan=True)
    assert np.array_equal(one.stop_covariance, three.stop_covariance)


@pytest.mark.slow
def test_outliers_are_left_out() -> None:
    """But for some of two or three rays, which move along their lines of sight and fit all the same."""
    simulation = simulate(mer_navcam(), replace(SMALL, outliers=0.03), seed=1)
    solution = solve(simulation.traverse, SolveOptions(rig="held", model="projective"))
    assert solution.converged
    outlier = simulation.truth.outlier
    obs = simulation.traverse.observations
    assert obs is not None
    left = np.flatnonzero(solution.used & outlier)
    assert len(left) <= 0.15 * outlier.sum()
    assert np.bincount(obs.track)[obs.track[left]].max(initial=0) <= 3
    assert solution.used[~outlier].mean() > 0.97


def test_held_telemetry_stays_bit_for_bit() -> None:
    t = small().traverse
    frames = tuple(replace(f, sigma_pan_rad=0.0, sigma_tilt_rad=0.0) for f in t.frames)
    solution = solve(replace(t, frames=frames), SolveOptions(rig="held", model="projective", loss="none"))
    assert solution.converged
    first, given = solution.final.world_T_mast[0], t.stops[0].world_T_mast
    assert first.matrix().tolist() == given.matrix().tolist()


# --- bad input ---


def test_refusals() -> None:
    with pytest.raises(InputError, match="landmarks: expected eliminated for the model projective"):
        SolveOptions(rig="held", model="projective", landmarks="explicit")
    with pytest.raises(InputError, match="tie: expected soft for the model projective, found hard"):
        SolveOptions(rig="held", model="projective", tie="hard")
    with pytest.raises(InputError, match="normalise: expected True for the model free"):
        SolveOptions(rig="held", model="free", normalise=False)
    with pytest.raises(InputError, match="projective, whose matrices have calibrations"):
        SolveOptions(rig="held", model="projective", sharing=Sharing(calibration=Freedom(scope="eye")))
    with pytest.raises(InputError, match="flex: calibration: expected a number above 0, found 0"):
        Flex(rotation_rad=0.02, translation_m=0.02, calibration=0.0)
