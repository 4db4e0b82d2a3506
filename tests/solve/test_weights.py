"""Covariances of observations: how they weigh, that they arrive everywhere, what ignoring them costs."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.stats import kstest

from pancam_graph import Observations, SimulationOptions, Solution, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHVOR
from pancam_graph.data import mean_sigma_px
from pancam_graph.data._noise import PixelNoise
from pancam_graph.graph import Flex
from pancam_graph.initialise import Start
from pancam_graph.results._residuals import residual_columns
from pancam_graph.rigs import Eye, Rig, exomars_pancam, mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.smoother import solve_incrementally
from pancam_graph.solve import prepare
from pancam_graph.solve._screen import ScreeningRounds
from support.parameters import slow_but_for, slow_for
from support.truth import errors_in_sigmas

SMALL = SimulationOptions(stops=2, pans=3, sweep_rad=1.5, points_per_image=15, noise_stretch=5.0)
NEAR_M = 20.0
PLAIN = SolveOptions(rig="held", loss="none", relative_decrease=0.0)


def cahvor_navcam() -> Rig:
    """The Navcam's head with strongly distorted eyes."""
    eyes = []
    for eye in mer_navcam().eyes:
        p = eye.camera.pinhole
        camera = CAHVOR(
            width_px=p.width_px,
            height_px=p.height_px,
            C=np.zeros(3),
            A=np.array([0, 0, 1.0]),
            H=np.array([p.fx_px, 0, p.cx_px]),
            V=np.array([0, p.fy_px, p.cy_px]),
            O=np.array([0.01, 0.0, 1.0]) / np.hypot(1, 0.01),
            R=np.array([1e-4, -0.12, 0.05]),
        )
        eyes.append(Eye(name=eye.name, camera=camera, head_T_camera=eye.head_T_camera))
    return Rig(name="distorted", pan_T_tilt=mer_navcam().pan_T_tilt, eyes=tuple(eyes))


RIGS = {"pinhole": mer_navcam, "cahvor": cahvor_navcam}


@cache
def simulated(rig: str, seed: int = 5) -> Simulation:
    return simulate(RIGS[rig](), SMALL, seed=seed)


def observed(traverse: Traverse) -> Observations:
    assert traverse.observations is not None
    return traverse.observations


def near(simulation: Simulation) -> Traverse:
    """Without landmarks that are too far for GTSAM's Cholesky of explicit ones."""
    distance = np.linalg.norm(simulation.truth.landmarks_m, axis=1)
    obs = observed(simulation.traverse)
    return simulation.traverse.with_observations(obs.select((distance < NEAR_M)[obs.track]))


def random_covariances(rng: np.random.Generator, n: int) -> FloatArray:
    root = rng.normal(0, 1, (n, 2, 2)) * np.exp(rng.uniform(-3, 3, (n, 1, 1)))
    return np.asarray(root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(2))


def masts_apart(a: Solution, b: Solution) -> float:
    pairs = zip(a.final.world_T_mast, b.final.world_T_mast, strict=True)
    return max(float(np.abs(p.localCoordinates(q)).max()) for p, q in pairs)


# --- the noise itself ---


def noises(rng: np.random.Generator, n: int) -> dict[str, tuple[PixelNoise, FloatArray]]:
    """A noise of each kind, and its covariances."""
    covariance, sigma = random_covariances(rng, n), np.exp(rng.uniform(-3, 3, n))
    return {
        "covariance": (
            PixelNoise(sigma_px=mean_sigma_px(covariance), covariance_px2=covariance),
            covariance,
        ),
        "sigma": (PixelNoise(sigma_px=sigma, covariance_px2=None), sigma[:, None, None] ** 2 * np.eye(2)),
    }


@pytest.mark.parametrize("kind", ["covariance", "sigma"])
def test_whitened_residuals_have_the_square_that_the_inverse_covariance_gives(kind: str) -> None:
    rng = np.random.default_rng(0)
    noise, covariance = noises(rng, 200)[kind]
    residual = rng.normal(0, 1, (200, 2))
    whitened = noise.whiten(residual)
    expected = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual)
    assert np.sum(whitened**2, axis=1) == pytest.approx(expected, rel=1e-7)
    assert noise.to_pixels(whitened) == pytest.approx(residual, rel=1e-9, abs=1e-12)
    root = noise.to_pixels(np.tile(np.eye(2), (200, 1, 1)))
    assert root @ root.transpose(0, 2, 1) == pytest.approx(covariance, rel=1e-9, abs=1e-12)
    jacobian = rng.normal(0, 1, (200, 2, 3))
    assert noise.whiten(jacobian)[:, :, 1] == pytest.approx(noise.whiten(jacobian[:, :, 1]))


@pytest.mark.parametrize("kind", ["covariance", "sigma"])
def test_noise_scaled_widened_selected(kind: str) -> None:
    rng = np.random.default_rng(1)
    noise, covariance = noises(rng, 50)[kind]
    identity, added = np.tile(np.eye(2), (50, 1, 1)), rng.uniform(0, 2, 50)

    def square(n: PixelNoise) -> FloatArray:
        root = n.to_pixels(identity[: len(n.sigma_px)])
        assert n.sigma_px == pytest.approx(mean_sigma_px(root @ root.transpose(0, 2, 1)))
        return np.asarray(root @ root.transpose(0, 2, 1))

    assert square(noise.scaled(3.0)) == pytest.approx(9 * covariance)
    wider = covariance + added[:, None, None] ** 2 * np.eye(2)
    assert square(noise.widened(added)) == pytest.approx(wider)
    rows = np.array([3, 1, 40])
    assert square(noise.select(rows)) == pytest.approx(covariance[rows])


def test_observations_select_their_covariances() -> None:
    obs = observed(simulated("pinhole").traverse)
    assert obs.covariance_px2 is not None
    rows = np.arange(len(obs)) % 3 == 0
    part = obs.select(rows)
    assert part.covariance_px2 is not None
    np.testing.assert_array_equal(part.covariance_px2, obs.covariance_px2[rows])
    np.testing.assert_array_equal(part.sigma_px, obs.sigma_px[rows])


def test_covariances_that_do_not_fit_are_refused() -> None:
    traverse = simulated("pinhole").traverse
    obs = observed(traverse)
    assert obs.covariance_px2 is not None
    with pytest.raises(InputError, match=r"covariance_px2: expected shape \(.*, 2, 2\), found \(.*, 2, 2\)"):
        traverse.with_observations(replace(obs, covariance_px2=obs.covariance_px2[1:]))
    with pytest.raises(InputError, match=r"sigma_px, row 0: expected 0\.3, the root .*found 0\.6"):
        traverse.with_observations(replace(obs, sigma_px=2 * obs.sigma_px))


# --- in the simulation ---


def test_simulated_noise_has_its_covariances_and_moves_nothing_else() -> None:
    options = replace(SMALL, stops=3, noise_px=0.4, outliers=0.1)
    stretched = simulate(mer_navcam(), options, seed=5)
    obs, truth = observed(stretched.traverse), stretched.truth
    assert obs.covariance_px2 is not None
    axes = np.sqrt(np.linalg.eigvalsh(obs.covariance_px2))
    assert axes[:, 1] / axes[:, 0] == pytest.approx(5.0)
    assert obs.sigma_px == pytest.approx(0.4)
    noise = obs.noise.whiten(obs.uv_px - truth.uv_px)[~truth.outlier]
    assert kstest(noise.ravel(), "norm").pvalue > 1e-3
    assert abs(np.asarray(np.corrcoef(noise.T))[0, 1]) < 4 / np.sqrt(len(noise))
    direction = np.arctan2(
        2 * obs.covariance_px2[:, 0, 1], obs.covariance_px2[:, 0, 0] - obs.covariance_px2[:, 1, 1]
    )
    assert kstest((direction / (2 * np.pi)) % 1, "uniform").pvalue > 1e-3

    round_ = simulate(mer_navcam(), replace(options, noise_stretch=1.0), seed=5)
    assert observed(round_.traverse).covariance_px2 is None
    np.testing.assert_array_equal(round_.truth.uv_px, truth.uv_px)
    np.testing.assert_array_equal(round_.traverse.pan_tilt_rad, stretched.traverse.pan_tilt_rad)


def test_simulated_stretch_below_1_is_refused() -> None:
    with pytest.raises(InputError, match=r"noise_stretch: expected a number from 1 to 10000, found 0\.5"):
        SimulationOptions(noise_stretch=0.5)


# --- in the solve ---


@pytest.mark.parametrize("loss", slow_but_for("none", ["none", "huber"]))
def test_round_covariances_are_sigmas(loss: str) -> None:
    options = replace(SMALL, noise_stretch=1.0, outliers=0.05 if loss == "huber" else 0.0)
    t = simulate(mer_navcam(), options, seed=3).traverse
    sigma = np.random.default_rng(0).uniform(0.2, 0.4, len(observed(t)))
    by_sigma = replace(observed(t), sigma_px=sigma)
    by_covariance = by_sigma.with_covariance(sigma[:, None, None] ** 2 * np.eye(2))
    a, b = (
        solve(t.with_observations(obs), SolveOptions(rig="held", loss=loss, relative_decrease=1e-12))  # type: ignore[arg-type]  # parametrised
        for obs in (by_sigma, by_covariance)
    )
    assert a.used.tolist() == b.used.tolist()
    assert b.cost_final == pytest.approx(a.cost_final, rel=1e-12)
    assert b.final.pan_tilt_rad == pytest.approx(a.final.pan_tilt_rad, abs=1e-12)
    assert masts_apart(a, b) < 1e-12
    assert b.residual_final_px[b.used] == pytest.approx(a.residual_final_px[a.used], abs=1e-10)
    assert b.sigma_px == pytest.approx(a.sigma_px, rel=1e-12)


MODELS = {
    "mast": replace(PLAIN, tie="soft", flex=Flex(rotation_rad=1e-4, translation_m=1e-3)),
    "circle": replace(PLAIN, model="circle"),
    "free": replace(PLAIN, model="free"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "model"), [*(("pinhole", m) for m in MODELS), ("cahvor", "mast")])
def test_eliminated_and_explicit_landmarks_weigh_alike(rig: str, model: str) -> None:
    """GTSAM takes a lower triangular square root for a diagonal one, if it may; then correlation is lost."""
    traverse = near(simulated(rig))
    ours, theirs = (
        solve(traverse, replace(MODELS[model], landmarks=way)) for way in ("eliminated", "explicit")
    )
    assert ours.cost_final == pytest.approx(theirs.cost_final, rel=1e-10)
    assert masts_apart(ours, theirs) < 1e-8
    assert ours.final.pan_tilt_rad == pytest.approx(theirs.final.pan_tilt_rad, abs=1e-8)
    assert ours.residual_final_px == pytest.approx(theirs.residual_final_px, abs=1e-6)


def projected(traverse: Traverse, solution: Solution) -> FloatArray:
    """Pixels (n, 2) where the eyes themselves see the solution's points."""
    obs, final = observed(traverse), solution.final
    point = final.landmarks_m[np.searchsorted(solution.landmark_track, obs.track)]
    uv = np.empty_like(obs.uv_px)
    for row, (i, p) in enumerate(zip(obs.image, point, strict=True)):
        in_camera = final.world_R_camera[i].T @ (p - final.world_t_camera[i])
        uv[row] = traverse.rig.eyes[traverse.image_eye[i]].camera.project(in_camera[None])[0][0]
    return uv


@pytest.mark.parametrize("rig", slow_for("cahvor", ["pinhole", "cahvor"]))
def test_cost_and_residuals_are_those_of_the_formula(rig: str) -> None:
    """Half of r' C^-1 r over pixels as the cameras see them, and of the priors."""
    traverse = near(simulated(rig))
    obs, solution = observed(traverse), solve(traverse, PLAIN)
    assert obs.covariance_px2 is not None
    residual = projected(traverse, solution) - obs.uv_px
    assert solution.residual_final_px == pytest.approx(residual, abs=1e-8)
    cost = 0.5 * np.einsum("ni,nij,nj->", residual, np.linalg.inv(obs.covariance_px2), residual)
    for stop, pose in list(zip(traverse.stops, solution.final.world_T_mast, strict=True))[1:]:
        sigma = np.repeat([stop.sigma_rotation_rad, stop.sigma_translation_m], 3)
        cost += 0.5 * np.sum((gtsam.Pose3.Logmap(stop.world_T_mast.between(pose)) / sigma) ** 2)
    sigmas = np.array([[f.sigma_pan_rad, f.sigma_tilt_rad] for f in traverse.frames])
    cost += 0.5 * np.sum((solution.correction_rad / sigmas) ** 2)
    assert solution.cost_final == pytest.approx(cost, rel=1e-7)


@pytest.mark.parametrize("rig", RIGS)
def test_without_noise_the_truth_comes_back(rig: str) -> None:
    simulation = simulate(RIGS[rig](), replace(SMALL, noise_px=0.0, prior="truth"), seed=3)
    telemetry = simulation.telemetry_start
    start = Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)
    solution = solve(simulation.traverse, SolveOptions(rig="held", loss="none"), start=start)
    assert observed(simulation.traverse).covariance_px2 is not None
    assert solution.cost_initial > 1e3
    assert solution.cost_final < 1e-12
    assert solution.final.pan_tilt_rad == pytest.approx(simulation.truth.pan_tilt_rad, abs=1e-9)
    for found, true in zip(solution.final.world_T_mast, simulation.truth.world_T_mast, strict=True):
        assert np.abs(true.localCoordinates(found)).max() < 1e-8


def test_the_narrow_axis_of_an_ellipse_bears_the_errors_of_telemetry_at_the_start() -> None:
    """Widened as the mean sigma is, it would not: a share of good observations would go at once."""
    simulation = simulate(mer_navcam(), replace(SMALL, noise_stretch=20.0, pointing_scale=3.0), seed=1)
    rounds = ScreeningRounds(prepare(simulation.traverse, SolveOptions(rig="held")))
    rounds.from_telemetry()
    assert rounds.problem.accepted.mean() > 0.999


@pytest.mark.parametrize("stretch", slow_but_for([20.0], [5.0, 20.0]))
def test_outliers_go_and_inliers_stay(stretch: float) -> None:
    options = SimulationOptions(
        stops=2, pans=4, sweep_rad=2.0, outliers=0.05, min_views=3, noise_stretch=stretch
    )
    simulation = simulate(mer_navcam(), options, seed=0)
    solution = solve(simulation.traverse)
    outlier = simulation.truth.outlier
    assert outlier.sum() > 50
    assert (outlier & ~solution.used).sum() >= 0.99 * outlier.sum()
    assert (~outlier & solution.used).sum() >= 0.99 * (~outlier).sum()


def test_noise_that_is_a_guess_is_rescaled_with_its_shape() -> None:
    """Covariances of a quarter of the true ones become the true ones, within what so many residuals tell."""
    simulation = simulated("pinhole")
    given = observed(simulation.traverse)
    assert given.covariance_px2 is not None
    guess = replace(given.with_covariance(given.covariance_px2 / 4), origin="images")
    solution = solve(simulation.traverse.with_observations(guess), SolveOptions(rig="held", loss="none"))
    assert solution.covariance_px2 is not None
    ratio = solution.covariance_px2 / given.covariance_px2
    assert ratio == pytest.approx(ratio[0, 0, 0])
    assert ratio[0, 0, 0] == pytest.approx(1.0, abs=4 * np.sqrt(2 / (2 * len(given))) + 0.02)
    assert solution.sigma_px == pytest.approx(mean_sigma_px(solution.covariance_px2))


def test_residuals_are_written_with_the_covariances() -> None:
    traverse = simulated("pinhole").traverse
    solution = solve(traverse, SolveOptions(rig="held", loss="none"))
    columns = residual_columns(solution)
    names = [*columns][-3:]
    assert names == ["cov_uu_px2", "cov_uv_px2", "cov_vv_px2"]
    covariance = observed(traverse).covariance_px2
    assert covariance is not None
    found = np.stack([np.asarray(columns[name]) for name in names], axis=1)
    expected = np.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]], axis=1)
    assert found == pytest.approx(expected, rel=1e-9)
    assert columns["sigma_px"] == pytest.approx(np.full(len(covariance), 0.3))


# --- what it is good for ---

WEIGHTS: dict[str, Callable[[Observations, FloatArray], Observations]] = {
    "covariance": lambda obs, c: obs,
    "variances": lambda obs, c: obs.with_covariance(c * np.eye(2)),
    "sigma": lambda obs, c: replace(obs, covariance_px2=None),
}


@pytest.mark.slow
def test_the_spread_is_as_the_covariance_says_and_larger_where_correlation_is_ignored() -> None:
    """Forty seeds. Where the second mast stands: RMS error 3.8 mm, without correlation 5.8, with sigmas 7.4.

    Ellipses of 5 to 1 in all directions carry ((5 + 1/5) / 2)^2 = 6.8 times the information of the round one
    of their mean variance; priors and landmarks leave a factor of 3.7 of that here.
    """
    seeds = 40
    error: dict[str, list[FloatArray]] = {name: [] for name in WEIGHTS}
    angles, stops = [], []
    for seed in range(seeds):
        simulation = simulate(mer_navcam(), replace(SMALL, noise_px=1.0), seed=seed)
        obs, truth = observed(simulation.traverse), simulation.truth
        assert obs.covariance_px2 is not None
        for name, weigh in WEIGHTS.items():
            t = simulation.traverse.with_observations(weigh(obs, obs.covariance_px2))
            solution = solve(t, SolveOptions(rig="held", loss="none"))
            shift = truth.world_T_mast[1].localCoordinates(solution.final.world_T_mast[1])
            error[name].append(shift[3:])
            if name == "covariance":
                off = (solution.final.pan_tilt_rad - truth.pan_tilt_rad) / solution.angle_sigma_rad
                angles.append(np.mean(off**2))
                stops.append(shift @ np.linalg.solve(solution.stop_covariance[1], shift))
    assert abs(np.mean(angles) - 1) < 1.96 * np.std(angles) / np.sqrt(seeds)
    assert abs(np.sum(stops) - 6 * seeds) < 1.96 * np.sqrt(2 * 6 * seeds)
    spread = {name: float(np.sqrt(np.mean(np.square(e)))) for name, e in error.items()}
    assert spread["variances"] > 1.3 * spread["covariance"]
    assert spread["sigma"] > 1.6 * spread["covariance"]


@pytest.mark.parametrize(
    ("rig", "options", "seed"),
    [
        (mer_navcam, SMALL, 0),
        # Weak priors of landmarks held what the long axes tell of ranges, and it ended at the limit of 100.
        (exomars_pancam, replace(SMALL, stops=1, pans=6, sweep_rad=2.5), 1),
    ],
)
def test_ellipses_10000_to_1_take_few_steps(
    rig: Callable[[], Rig], options: SimulationOptions, seed: int
) -> None:
    """GTSAM's Cholesky calls such a system indeterminate; damped until it does not, the solve crawled."""
    # Landmarks without a range may end behind a camera; a second fit does without these.
    simulation = simulate(rig(), replace(options, noise_stretch=1e4), seed=seed)
    solution = solve(simulation.traverse, SolveOptions(rig="held", loss="none"))
    angles, stops = errors_in_sigmas(simulation, solution)
    assert solution.converged
    assert solution.iterations <= 8
    assert np.abs(angles).max() < 5
    assert np.max(stops, initial=0.0) < 2.5


def told_and_true(sure_px: float, rough_px: float) -> Simulation:
    """A drive of which half of the observations are as sure as told, the others as rough."""
    exact = simulate(mer_navcam(), replace(SMALL, noise_px=0.0, noise_stretch=1.0), seed=0)
    o, rng = observed(exact.traverse), np.random.default_rng(0)
    sigma = np.where(rng.random(len(o)) < 0.5, sure_px, rough_px)
    uv = o.uv_px + rng.standard_normal(o.uv_px.shape) * sigma[:, None]
    return replace(exact, traverse=exact.traverse.with_observations(replace(o, uv_px=uv, sigma_px=sigma)))


@pytest.mark.parametrize(
    ("sure_px", "rough_px"), slow_but_for([(1e-5, 0.9)], [(1e-6, 1e-6), (1e-5, 0.9), (1e-3, 1.0)])
)
def test_sigmas_far_apart_and_far_below_a_pixel_are_borne(sure_px: float, rough_px: float) -> None:
    # A rig that is estimated moves along a valley as narrow as these sigmas, in hundreds of steps.
    simulation = told_and_true(sure_px, rough_px)
    solution = solve(simulation.traverse, SolveOptions(rig="held"))
    angles, _ = errors_in_sigmas(simulation, solution)
    error = simulation.truth.world_T_mast[1].localCoordinates(solution.final.world_T_mast[1])
    assert solution.converged
    assert np.abs(angles).max() < 5
    assert np.abs(error / np.sqrt(np.diag(solution.stop_covariance[1]))).max() < 4


@pytest.mark.parametrize("way", [solve, solve_incrementally])
def test_sigmas_a_million_apart_are_refused_in_a_sentence(way: Callable[[Traverse], Solution]) -> None:
    """They ended in "converged", or after 100 steps, 7 sigma from the optimum."""
    t = told_and_true(1e-6, 1.0).traverse
    with pytest.raises(InputError, match=r"sigma_px: expected .* a factor of 1e\+05 .*, found 1e-06 \(row"):
        way(t)


def test_axes_of_ellipses_are_those_of_their_covariances() -> None:
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    covariance = (turn @ np.diag([1e-4, 1.0]) ** 2 @ turn.T)[None]
    short, long = PixelNoise(sigma_px=mean_sigma_px(covariance), covariance_px2=covariance).axes_px
    assert short == pytest.approx(1e-4, rel=1e-6)
    assert long == pytest.approx(1.0)
