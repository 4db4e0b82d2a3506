"""Eliminated landmarks: optimum and covariances of explicit ones, and landmarks that are hard to place."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, Solution, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray
from pancam_graph.elimination import _strays
from pancam_graph.graph import ExplicitLandmarks, Flex, SoftTemplate
from pancam_graph.initialise import Start
from pancam_graph.landmarks import LossName
from pancam_graph.rigs import Eye, Rig, mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.solve import Problem, fit, prepare, screen
from support.parameters import slow_but_for, slow_for
from support.solving import fitted, solution_from

SMALL = SimulationOptions(stops=2, pans=3, sweep_rad=1.5, points_per_image=15)
NEAR_M = 20.0
MODELS = {
    "mast": SolveOptions(rig="held", tie="soft", flex=Flex(rotation_rad=1e-4, translation_m=1e-3)),
    "circle": SolveOptions(rig="held", model="circle"),
    "free": SolveOptions(rig="held", model="free"),
}


@cache
def small(seed: int = 5) -> Simulation:
    return simulate(mer_navcam(), SMALL, seed=seed)


def start_of(simulation: Simulation) -> Start:
    telemetry = simulation.telemetry_start
    return Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)


def near(simulation: Simulation) -> Traverse:
    """Without landmarks that are too far for GTSAM's Cholesky of explicit ones."""
    t = simulation.traverse
    assert t.observations is not None
    distance = np.linalg.norm(simulation.truth.landmarks_m, axis=1)
    return t.with_observations(t.observations.select((distance < NEAR_M)[t.observations.track]))


def to_the_end(model: str, **changes: object) -> SolveOptions:
    return replace(MODELS[model], loss="none", relative_decrease=1e-12, **changes)  # type: ignore[arg-type]  # options by name


def masts_apart(a: Solution, b: Solution) -> float:
    pairs = zip(a.final.world_T_mast, b.final.world_T_mast, strict=True)
    return max(float(np.abs(p.localCoordinates(q)).max()) for p, q in pairs)


# --- the same as explicit landmarks ---


@pytest.mark.parametrize("model", slow_but_for("free", MODELS))
def test_near_landmarks_eliminated_or_explicit_give_one_optimum(model: str) -> None:
    traverse = near(small(2))
    ours, theirs = (solve(traverse, to_the_end(model, landmarks=way)) for way in ("eliminated", "explicit"))
    assert ours.converged
    assert ours.cost_final == pytest.approx(theirs.cost_final, rel=1e-9)
    assert masts_apart(ours, theirs) < 1e-6
    assert ours.final.pan_tilt_rad == pytest.approx(theirs.final.pan_tilt_rad, abs=1e-7)
    assert ours.final.world_t_camera == pytest.approx(theirs.final.world_t_camera, abs=1e-6)


@pytest.mark.slow
def test_with_landmarks_on_the_horizon_the_optimum_is_no_worse_than_the_explicit_one() -> None:
    """Explicit ones end at infinity; unit 4-vectors follow their noise beyond it."""
    ours, theirs = (
        solve(small(3).traverse, to_the_end("mast", landmarks=way)) for way in ("eliminated", "explicit")
    )
    assert ours.converged
    assert 0.99 * theirs.cost_final < ours.cost_final < theirs.cost_final


@pytest.mark.parametrize("model", [*MODELS, "hard"])
def test_without_noise_the_truth_comes_back(model: str) -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, noise_px=0.0, prior="truth"), seed=3)
    options = (
        SolveOptions(rig="held", loss="none", relative_decrease=1e-12)
        if model == "hard"
        else to_the_end(model)
    )
    solution = solve(simulation.traverse, options, start=start_of(simulation))
    assert solution.cost_initial > 1e3
    assert solution.cost_final < 1e-12
    for found, true in zip(solution.final.world_T_mast, simulation.truth.world_T_mast, strict=True):
        assert np.abs(true.localCoordinates(found)).max() < 1e-8
    assert solution.final.pan_tilt_rad == pytest.approx(simulation.truth.pan_tilt_rad, abs=1e-9)


@cache
def solved(model: str) -> tuple[Problem, Solution, gtsam.Marginals]:
    """A solution with eliminated landmarks, and GTSAM's marginals of the explicit graph at it."""
    adjustment = fitted(near(small(2)), to_the_end(model, landmark_covariances=True))
    problem = adjustment.problem
    assert isinstance(problem.template, SoftTemplate)
    explicit = ExplicitLandmarks(problem.template, problem.measurements)
    graph = gtsam.NonlinearFactorGraph(problem.factors.graph)
    graph.push_back(explicit.factors(problem.kept))
    values = explicit.with_landmarks(problem.values, problem.points_m(), problem.present)
    return problem, solution_from(adjustment), gtsam.Marginals(graph, values)


@pytest.mark.parametrize("model", ["mast", "circle", "free"])
def test_covariance_of_a_stop_is_gtsams(model: str) -> None:
    _, solution, marginals = solved(model)
    assert not solution.stop_covariance[0].any()
    expected = marginals.marginalCovariance(gtsam.symbol("M", 1))
    assert solution.stop_covariance[1] == pytest.approx(expected, rel=1e-6, abs=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("model", slow_for("circle", MODELS))
def test_sigmas_of_pan_and_tilt_are_gtsams(model: str) -> None:
    """Of the angles themselves, or of what camera poses and mast say of them, by differences of the state."""
    problem, solution, marginals = solved(model)
    template, t, none = problem.template, problem.template.traverse, np.zeros((0, 3))
    for frame in range(len(t.frames)):
        if model == "mast":
            sigma = np.sqrt(np.diag(marginals.marginalCovariance(gtsam.symbol("A", frame))))
            assert solution.angle_sigma_rad[frame] == pytest.approx(sigma, rel=1e-6)
            continue
        keys = [gtsam.symbol("X", int(i)) for i in np.flatnonzero(t.image_frame == frame)]
        if t.frame_stop[frame] == 1:
            keys.append(gtsam.symbol("M", 1))
        columns = []
        for key in keys:
            for k in range(6):
                found = []
                for h in (1e-5, -1e-5):
                    step = gtsam.VectorValues()
                    step.insert(key, h * np.eye(6)[k])
                    values = problem.values.retract(step)
                    # The tie's own angles are another variable: what the poses add to them counts.
                    found.append(template.state(values, none).pan_tilt_rad[frame])
                columns.append((found[0] - found[1]) / 2e-5)
        joint = marginals.jointMarginalCovariance(keys)
        covariance = np.block([[joint.at(a, b) for b in keys] for a in keys])
        jacobian = np.array(columns).T
        sigma = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
        assert solution.angle_sigma_rad[frame] == pytest.approx(
            sigma, rel=1e-5
        )  # a twist of mrad is left out


@pytest.mark.parametrize("model", MODELS)
def test_covariance_of_a_landmark_is_gtsams(model: str) -> None:
    _, solution, marginals = solved(model)
    assert solution.landmark_covariance_m2 is not None
    for j in range(0, len(solution.landmark_track), 7):
        expected = marginals.marginalCovariance(gtsam.symbol("L", j))
        found = solution.landmark_covariance_m2[j]
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("sigma_m", [1.0, 100.0])
def test_what_telemetry_alone_holds_is_no_surer_than_telemetry(sigma_m: float) -> None:
    """Where two stops stand together no image tells: half the variance of either one."""
    t = small().traverse
    stops = tuple(replace(s, sigma_rotation_rad=0.1, sigma_translation_m=sigma_m) for s in t.stops)
    solution = solve(replace(t, stops=stops), SolveOptions(rig="held", loss="none"))
    for stop in range(2):
        variance = np.linalg.eigvalsh(solution.stop_covariance[stop][3:, 3:])
        assert np.sqrt(variance.min()) > 0.99 * sigma_m / np.sqrt(2)


def test_covariances_of_landmarks_are_there_only_where_asked_for() -> None:
    assert solve(small().traverse, SolveOptions(rig="held", loss="none")).landmark_covariance_m2 is None


# --- hard and soft ---


def test_a_soft_tie_meets_the_hard_one_as_its_sigma_goes_to_zero() -> None:
    """What flex gains shrinks with the square of its sigma, once that is small against what images know."""
    hard = solve(small().traverse, SolveOptions(rig="held", loss="none", relative_decrease=1e-12))
    gains, turns, shifts = [], [], []
    for sigma in (1e-4, 1e-5, 1e-6, 1e-7):
        flex = Flex(rotation_rad=sigma, translation_m=10 * sigma)
        soft = solve(
            small().traverse,
            SolveOptions(rig="held", loss="none", relative_decrease=1e-12, tie="soft", flex=flex),
        )
        gains.append((hard.cost_final - soft.cost_final) / hard.cost_final)
        turns.append(np.abs(soft.final.pan_tilt_rad - hard.final.pan_tilt_rad).max())
        shifts.append(np.abs(soft.final.world_t_camera - hard.final.world_t_camera).max())
    assert np.all(np.diff(gains) < 0)
    assert np.all(np.diff(turns) < 0)
    assert np.all(np.diff(shifts) < 0)
    assert gains[2] / gains[3] == pytest.approx(100, rel=0.05)
    assert turns[1] / turns[2] == pytest.approx(100, rel=0.3)
    assert 0 < gains[-1] < 2e-6
    assert turns[-1] < 1e-7
    assert shifts[-1] < 1e-6


# --- threads ---


@pytest.mark.parametrize("loss", slow_but_for("huber", ["none", "huber"]))
def test_the_number_of_threads_changes_no_bit(monkeypatch: pytest.MonkeyPatch, loss: LossName) -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, pans=4, points_per_image=80, outliers=0.01), seed=0)
    assert simulation.traverse.observations is not None
    assert len(simulation.traverse.observations) > 5000  # or else one thread does it all
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("PANCAM_GRAPH_THREADS", threads)
        found.append(
            solve(simulation.traverse, SolveOptions(rig="held", loss=loss, landmark_covariances=True))
        )
    one, three = found
    assert one.cost_history == three.cost_history
    assert one.cost_final == three.cost_final
    assert np.array_equal(one.final.pan_tilt_rad, three.final.pan_tilt_rad)
    for a, b in zip(one.final.world_T_mast, three.final.world_T_mast, strict=True):
        assert np.array_equal(a.matrix(), b.matrix())
    assert np.array_equal(one.final.landmarks_m, three.final.landmarks_m, equal_nan=True)
    assert np.array_equal(one.stop_covariance, three.stop_covariance)
    assert one.landmark_covariance_m2 is not None
    assert three.landmark_covariance_m2 is not None
    assert np.array_equal(one.landmark_covariance_m2, three.landmark_covariance_m2, equal_nan=True)


# --- landmarks that are hard to place ---

FIRST_ADDED = 10**6
"""Tracks that a test adds count from here."""


def with_tracks(traverse: Traverse, tracks: Sequence[Sequence[tuple[int, FloatArray]]]) -> Traverse:
    """The traverse and more tracks, each by the images that see it and where; these come last."""
    obs = traverse.observations
    assert obs is not None
    rows = [(image, FIRST_ADDED + k, uv) for k, seen in enumerate(tracks) for image, uv in seen]
    return traverse.with_observations(
        replace(
            obs,
            image=np.append(obs.image, [r[0] for r in rows]),
            track=np.append(obs.track, [r[1] for r in rows]),
            uv_px=np.vstack([obs.uv_px, [r[2] for r in rows]]),
            sigma_px=np.append(obs.sigma_px, np.full(len(rows), 0.3)),
        )
    )


class Cameras:
    """The true cameras of a simulation."""

    def __init__(self, simulation: Simulation) -> None:
        t = simulation.traverse
        self.traverse = t
        self.R, self.t = t.camera_poses(simulation.truth.world_T_mast, simulation.truth.pan_tilt_rad)
        self.K = np.array([p.calibration_matrix for p in t.rig.pinholes])[t.image_eye]

    def ray(self, image: int, uv: FloatArray) -> FloatArray:
        ray = self.R[image] @ np.linalg.solve(self.K[image], [*uv, 1.0])
        return np.asarray(ray / np.linalg.norm(ray))

    def pixel(self, image: int, point: FloatArray) -> tuple[FloatArray, bool]:
        """Pixel on the line through the point, and whether the camera sees it there."""
        h = self.K[image] @ self.R[image].T @ (point - self.t[image])
        uv = h[:2] / h[2]
        return uv, bool(h[2] > 0.5 and np.all((uv >= 0) & (uv <= 1023)))

    def false_matches(self, n: int) -> list[list[tuple[int, FloatArray]]]:
        """Points that two or more cameras see, and one whose line of sight meets them behind it: the last."""
        rng = np.random.default_rng(0)
        first, second = (np.flatnonzero(self.traverse.image_stop == stop) for stop in (0, 1))
        found: list[list[tuple[int, FloatArray]]] = []
        while len(found) < n:
            b, uv = int(rng.choice(second)), rng.uniform(0, 1023, 2)
            point = self.t[b] - rng.uniform(0.5, 3.0) * self.ray(b, uv)
            seen = [(i, self.pixel(i, point)[0]) for i in first.tolist() if self.pixel(i, point)[1]]
            if len(seen) >= 2:
                found.append([*seen, (b, uv)])
        return found


def moved(a: Solution, b: Solution) -> float:
    """How far pointing differs, in sigmas."""
    return float(np.abs((a.final.pan_tilt_rad - b.final.pan_tilt_rad) / b.angle_sigma_rad).max())


@pytest.mark.parametrize(
    ("loss", "reason"),
    slow_for([("cauchy", "outlier")], [("none", "behind"), ("huber", "outlier"), ("cauchy", "outlier")]),
)
def test_what_matches_behind_a_camera_is_named_and_harms_nobody(loss: LossName, reason: str) -> None:
    traverse, options = small().traverse, SolveOptions(rig="held", loss=loss)
    tracks = Cameras(small()).false_matches(5)
    last = np.cumsum([len(track) for track in tracks]) - 1
    without, solution = solve(traverse, options), solve(with_tracks(traverse, tracks), options)
    assert solution.converged
    assert traverse.observations is not None
    added = solution.reason[len(traverse.observations) :]
    assert [added[i] for i in last] == [reason] * 5
    assert sum(r == "" for r in added) == len(added) - 5
    assert any("5 observations of landmarks behind a camera" in w for w in solution.warnings) == (
        loss == "none"
    )
    assert moved(solution, without) < 0.02


def test_a_pair_whose_rays_diverge_goes_and_harms_nobody() -> None:
    """The pixels of two eyes exchanged: the rays meet as far behind as they should in front."""
    traverse = small().traverse
    obs = traverse.observations
    assert obs is not None
    distance = np.linalg.norm(small().truth.landmarks_m, axis=1)
    frame = traverse.image_frame[obs.image]
    pairs = [
        rows
        for track in np.flatnonzero((np.bincount(obs.track) == 2) & (distance < 8.0))
        for rows in [np.flatnonzero(obs.track == track)]
        if frame[rows[0]] == frame[rows[1]]
    ][:6]
    uv = obs.uv_px.copy()
    for rows in pairs:
        uv[rows] = uv[rows[::-1]]
    spoilt = np.isin(np.arange(len(obs)), pairs)
    options = SolveOptions(rig="held", relative_decrease=1e-10)
    without = solve(traverse.with_observations(obs.select(~spoilt)), options)
    solution = solve(traverse.with_observations(replace(obs, uv_px=uv)), options)
    assert spoilt.sum() == 12
    assert {solution.reason[i] for i in np.flatnonzero(spoilt)} <= {"outlier", "behind"}
    assert solution.used[~spoilt].tolist() == without.used.tolist()
    assert moved(solution, without) < 1e-6
    kept = solve(traverse.with_observations(replace(obs, uv_px=uv)), SolveOptions(rig="held", loss="none"))
    named = next(w for w in kept.warnings if "diverge" in w)
    assert str(obs.track[pairs[0][0]]) in named


@pytest.mark.parametrize("loss", ["none", "huber"])
def test_a_horizon_that_one_stop_sees_keeps_its_place(loss: LossName) -> None:
    """Two rays 0.1 to 0.04 mrad apart, noise of 0.3 mrad on each: many end beyond infinity, none is lost."""
    cameras, rng = Cameras(small()), np.random.default_rng(1)
    t = small().traverse
    tracks = []
    for frame in range(len(t.frames)):
        a, b = (int(i) for i in np.flatnonzero(t.image_frame == frame))
        for distance in (2000.0, 5000.0, 5000.0, 5000.0):
            point = cameras.t[a] + distance * cameras.ray(a, rng.uniform(100, 900, 2))
            tracks.append([(i, cameras.pixel(i, point)[0] + rng.normal(0, 0.3, 2)) for i in (a, b)])
    traverse = with_tracks(t, tracks)
    solution = solve(traverse, SolveOptions(rig="held", loss=loss))
    assert solution.converged
    assert solution.iterations <= 8
    assert t.observations is not None
    assert solution.used[len(t.observations) :].all()
    points = solution.final.landmarks_m[solution.landmark_track >= FIRST_ADDED]
    assert np.isfinite(points).all()
    assert np.linalg.norm(points, axis=1).min() > 100


@pytest.mark.parametrize("loss", slow_but_for("huber", ["none", "huber"]))
def test_what_starts_beyond_infinity_comes_back(loss: LossName) -> None:
    """Telemetry three times as wrong as it says turns the rays of far landmarks apart."""
    options = replace(SMALL, noise_px=0.0, prior="truth", pointing_scale=3.0, reach_m=400.0)
    simulation = simulate(mer_navcam(), options, seed=3)
    prepared = prepare(simulation.traverse, SolveOptions(rig="held", loss=loss), start_of(simulation))
    assert (prepared.problem.landmarks.vector[:, 3] < 0).sum() > 3
    adjustment = fit(screen(prepared))
    solution = solution_from(adjustment)
    assert (adjustment.problem.landmarks.vector[:, 3] > 0).all()
    assert solution.used.all()
    assert solution.final.pan_tilt_rad == pytest.approx(simulation.truth.pan_tilt_rad, abs=1e-9)
    truth = simulation.truth.landmarks_m[solution.landmark_track]
    assert solution.final.landmarks_m == pytest.approx(truth, rel=1e-5, abs=1e-5)


def camera_on_the_axes() -> Rig:
    """One eye whose centre neither pan nor tilt moves."""
    mount = gtsam.Pose3(gtsam.Rot3(HEAD_R_FORWARD_CAMERA), np.zeros(3))
    eye = Eye(name="eye", camera=mer_navcam().eyes[0].camera, head_T_camera=mount)
    return Rig(name="point", pan_T_tilt=gtsam.Pose3(), eyes=(eye,))


@pytest.mark.parametrize("loss", slow_but_for("huber", ["none", "huber"]))
def test_rays_from_one_centre_tell_pointing_and_a_warning_names_their_tracks(loss: LossName) -> None:
    simulation = simulate(camera_on_the_axes(), replace(SMALL, stops=1, pans=5), seed=0)
    solution = solve(simulation.traverse, SolveOptions(rig="held", loss=loss))
    assert solution.converged
    assert solution.used.all()
    n = len(solution.landmark_track)
    [warning] = [w for w in solution.warnings if "leave the place of the point open" in w]
    assert warning.startswith(f"{n} tracks ({', '.join(str(k) for k in solution.landmark_track[:6])} and")
    error = (solution.final.pan_tilt_rad - simulation.truth.pan_tilt_rad) / solution.angle_sigma_rad
    assert np.abs(error).max() < 4
    assert np.all(solution.angle_sigma_rad < 1.3e-3)  # of telemetry: 1.34e-3


@pytest.mark.parametrize("loss", slow_but_for("none", ["none", "huber"]))
def test_where_telemetry_holds_everything_landmarks_are_placed(loss: LossName) -> None:
    held = replace(SMALL, sigma_stop_m=0.0, sigma_stop_rad=0.0, pointing_scale=0.0)
    simulation = simulate(mer_navcam(), held, seed=0)
    solution = solve(simulation.traverse, SolveOptions(rig="held", loss=loss, landmark_covariances=True))
    assert solution.converged
    assert solution.used.mean() > 0.99
    assert not solution.stop_covariance.any()
    assert not solution.angle_sigma_rad.any()
    assert np.array_equal(solution.final.pan_tilt_rad, simulation.traverse.pan_tilt_rad)
    assert solution.landmark_covariance_m2 is not None
    error = solution.final.landmarks_m - simulation.truth.landmarks_m[solution.landmark_track]
    close = np.linalg.norm(simulation.truth.landmarks_m[solution.landmark_track], axis=1) < NEAR_M
    close &= np.isfinite(error).all(axis=1)
    squared = np.einsum(
        "ni,ni->n", error, np.linalg.solve(solution.landmark_covariance_m2, error[:, :, None])[..., 0]
    )
    assert squared[close].mean() == pytest.approx(3, rel=0.3)


def test_landmarks_are_refined_halfway_to_the_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the third step leaves to gain is theirs: of second order in the step."""
    options = SimulationOptions(stops=6, pans=6, points_per_image=10)
    prepared = prepare(simulate(mer_navcam(), options, seed=1).traverse, SolveOptions(loss="none"))
    left = []
    for band in ((1.0, 0.0), _strays._HALFWAY):  # the first is empty
        monkeypatch.setattr(_strays, "_HALFWAY", band)
        costs = fit(screen(prepared)).outcome.costs
        left.append(costs[3] - costs[-1])
    assert left[0] > 1e-5
    assert 0 <= left[1] < 0.05 * left[0]
