"""Landmark blocks: exactly what dense least squares with all landmarks gives, and the true cost elsewhere."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import gtsam
import landmark_reference as reference
import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, simulate
from pancam_graph._adjustment import Adjustment
from pancam_graph._problem import Problem, system_of
from pancam_graph.elimination import Panels, Posture
from pancam_graph.factors import LandmarkBlocks
from pancam_graph.geometry import BoolArray, FloatArray
from pancam_graph.graph import Flex, read_variable
from pancam_graph.landmarks import CameraViews, Landmarks, Measurements
from pancam_graph.losses import Loss, LossName, loss_of
from pancam_graph.rigs import exomars_pancam
from pancam_graph.simulate import Simulation

TINY = SimulationOptions(stops=2, pans=2, sweep_rad=0.7, tilts_rad=(-0.2,), points_per_image=5)
MODELS = {
    "hard": SolveOptions(loss="none"),
    "soft": SolveOptions(loss="none", tie="soft", flex=Flex(rotation_rad=1e-4, translation_m=1e-3)),
    "circle": SolveOptions(loss="none", model="circle"),
}


@cache
def tiny(noise_px: float = 0.3) -> Simulation:
    """Two stops of two frames; the first stop is a variable too."""
    simulation = simulate(exomars_pancam(), replace(TINY, noise_px=noise_px, prior="truth"), seed=1)
    t = simulation.traverse
    stops = tuple(replace(s, sigma_rotation_rad=0.01, sigma_translation_m=0.1) for s in t.stops)
    return replace(simulation, traverse=replace(t, stops=stops))


def problem_of(model: str, *, off: float = 0.0, noise_px: float = 0.3, seed: int = 0) -> Problem:
    """Cameras at the truth and landmarks where they fit, both moved by random numbers of the size `off`."""
    problem = Adjustment(tiny(noise_px).traverse, MODELS[model], None, None).problem
    rng = np.random.default_rng(seed)
    values = problem.values.retract(random_step(problem, rng, off))
    vector = problem.landmarks.vector + off * rng.normal(0, 0.3, problem.landmarks.vector.shape)
    vector /= np.linalg.norm(vector, axis=1, keepdims=True)
    return problem.at(values, replace(problem.landmarks, vector=vector))


def random_step(problem: Problem, rng: np.random.Generator, size: float) -> gtsam.VectorValues:
    step = gtsam.VectorValues()
    link = problem.template.linkage
    for key, dim in zip(link.key, link.dim, strict=True):
        step.insert(key, size * rng.standard_normal(int(dim)))
    return step


def whitened(
    landmarks: Landmarks, m: Measurements, views: CameraViews
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Residuals (n, 2), their derivatives (n, 2, 4) by the landmark's vector, what is in front."""
    i, j = m.image, m.landmark
    to_pixel = views.calibration[i] @ views.world_R_camera[i].transpose(0, 2, 1)
    offset = (landmarks.origin_m[j] - views.world_t_camera[i])[:, :, None]
    projection = to_pixel @ np.concatenate([np.broadcast_to(np.eye(3), (len(i), 3, 3)), offset], axis=2)
    h = np.einsum("nij,nj->ni", projection, landmarks.vector[j])
    uv = h[:, :2] / h[:, 2:]
    d_vector = (projection[:, :2] - uv[:, :, None] * projection[:, 2:]) / h[:, 2:, None]
    return np.einsum("nij,nj->ni", m.whitening, uv - m.uv_px), m.whitening @ d_vector, h[:, 2] > 0


@dataclass(frozen=True)
class Dense:
    """The whole least-squares system, cameras (columns of A) and landmarks (columns of B)."""

    A: FloatArray
    B: FloatArray
    r: FloatArray
    landmarks: Landmarks
    tangents: FloatArray

    @property
    def inverse(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.B.T @ self.B))

    @property
    def reduced(self) -> tuple[FloatArray, FloatArray]:
        """S = A'A - E V^-1 E', s = A'r - E V^-1 g."""
        cross = self.A.T @ self.B @ self.inverse
        return self.A.T @ self.A - cross @ self.B.T @ self.A, self.A.T @ self.r - cross @ self.B.T @ self.r

    def followed(self, dx: FloatArray) -> Landmarks:
        """Landmarks after the joint step whose part of the cameras is dx."""
        dp = -self.inverse @ self.B.T @ (self.r + self.A @ dx)
        vector = self.landmarks.vector + np.einsum("jpk,jk->jp", self.tangents, dp.reshape(-1, 3))
        return replace(self.landmarks, vector=vector / np.linalg.norm(vector, axis=1, keepdims=True))


def dense_of(
    keys: list[int],
    dims: list[int],
    views_at: Callable[[gtsam.Values], CameraViews],
    values: gtsam.Values,
    m: Measurements,
    landmarks: Landmarks,
    loss: Loss,
) -> Dense:
    """By differences of the residuals where the variables are retracted, fourth order."""

    def residual(step: gtsam.VectorValues) -> FloatArray:
        return whitened(landmarks, m, views_at(values.retract(step)))[0].ravel()

    h, columns = 1e-4, []
    for key, dim in zip(keys, dims, strict=True):
        for k in range(dim):
            found = {}
            for share in (-2, -1, 1, 2):
                step = gtsam.VectorValues()
                step.insert(key, share * h * np.eye(dim)[k])
                found[share] = residual(step)
            columns.append((8 * (found[1] - found[-1]) - (found[2] - found[-2])) / (12 * h))
    r, d_vector, front = whitened(landmarks, m, views_at(values))
    tangents = np.array([reference.tangents(v) for v in landmarks.vector])
    B = np.zeros((2 * len(r), 3 * len(tangents)))
    for n, j in enumerate(m.landmark):
        B[2 * n : 2 * n + 2, 3 * j : 3 * j + 3] = d_vector[n] @ tangents[j]
    weight = reference.loss_weight(loss.name, loss.width, np.sum(r**2, axis=1)) * front
    root = np.repeat(np.sqrt(weight), 2)
    A = np.column_stack(columns)
    return Dense(A * root[:, None], B * root[:, None], r.ravel() * root, landmarks, tangents)


def dense(problem: Problem, loss: Loss) -> Dense:
    link = problem.template.linkage
    keys = [link.key[v] for v in np.flatnonzero(link.touched)]
    dims = link.dim[link.touched].tolist()
    return dense_of(
        keys, dims, problem.template.views, problem.values, problem.measurements, problem.landmarks, loss
    )


def true_cost(landmarks: Landmarks, m: Measurements, views: CameraViews, loss: Loss) -> float:
    r, _, front = whitened(landmarks, m, views)
    cost = reference.loss_cost(loss.name, loss.width, np.sum(r**2, axis=1))
    return float(np.where(front, cost, 0.5 * 1000.0**2).sum())


def blocks_of(problem: Problem, loss: Loss) -> tuple[LandmarkBlocks, gtsam.NonlinearFactorGraph]:
    system, _ = system_of(problem, loss)
    blocks = LandmarkBlocks(system, read_variable, problem.template.posture)
    graph = gtsam.NonlinearFactorGraph()
    for factor in blocks.factors():
        graph.push_back(factor)
    return blocks, graph


def touched_ordering(problem: Problem) -> gtsam.Ordering:
    link = problem.template.linkage
    ordering = gtsam.Ordering()
    for v in np.flatnonzero(link.touched):
        ordering.push_back(link.key[v])
    return ordering


def whole(panels: Panels) -> tuple[FloatArray, FloatArray]:
    """Dense (S, s) of panels, columns by group."""
    st = panels.structure
    begin = np.concatenate([[0], np.cumsum(st.dim)])
    S, s = np.zeros((begin[-1], begin[-1])), np.zeros(begin[-1])
    for g, panel in enumerate(panels.panel):
        rows = slice(begin[g], begin[g + 1])
        s[rows] = panel[:, -1]
        for h, first, last in zip(st.after[g], st.begin[g][:-1], st.begin[g][1:], strict=True):
            block = panel[:, first:last]
            S[rows, begin[h] : begin[h + 1]] = np.triu(block) if h == g else block
    return np.triu(S + S.T - np.diag(np.diag(S))) + np.triu(S + S.T, 1).T, s


def assert_systems_agree(S: FloatArray, s: FloatArray, expected: Dense, *, tolerance: float = 1e-8) -> None:
    """In units of what the cameras' own columns weigh."""
    S_expected, s_expected = expected.reduced
    size = np.linalg.norm(expected.A, axis=0).clip(1.0)  # an image without observations has none
    assert np.abs((S - S_expected) / np.outer(size, size)).max() < tolerance
    length = np.linalg.norm(expected.r)
    assert np.abs((s - s_expected) / size).max() < tolerance * length + 1e-9


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("off", [0.0, 1e-3, 0.03])
@pytest.mark.parametrize("model", MODELS)
def test_factors_are_the_dense_system_without_its_landmarks(model: str, off: float, loss: LossName) -> None:
    problem, chosen = problem_of(model, off=off), loss_of(loss)
    expected = dense(problem, chosen)
    _, graph = blocks_of(problem, chosen)
    linear = graph.linearize(problem.values)
    augmented = linear.augmentedHessian(touched_ordering(problem))
    assert_systems_agree(augmented[:-1, :-1], -augmented[:-1, -1], expected)
    cost = true_cost(problem.landmarks, problem.measurements, problem.views, chosen)
    assert augmented[-1, -1] == pytest.approx(2 * cost, rel=1e-12)


@pytest.mark.parametrize("off", [0.0, 0.03])
@pytest.mark.parametrize("model", MODELS)
def test_panels_are_the_dense_system_without_its_landmarks(model: str, off: float) -> None:
    problem = problem_of(model, off=off)
    system, _ = system_of(problem, loss_of("huber"))
    S, s = whole(system.linearise(problem.template.posture(problem.values)))
    link = problem.template.linkage
    touched = np.repeat(link.touched, link.dim)
    assert_systems_agree(S[np.ix_(touched, touched)], s[touched], dense(problem, loss_of("huber")))
    assert not S[~touched].any()
    assert not s[~touched].any()


def test_what_is_behind_a_camera_pulls_nowhere_and_costs_a_constant() -> None:
    problem = problem_of("hard")
    vector = problem.landmarks.vector.copy()
    vector[3] *= -1
    problem = replace(problem, landmarks=replace(problem.landmarks, vector=vector))
    rows = int(np.sum(problem.measurements.landmark == 3))
    others = np.delete(np.arange(len(vector)), 3)
    expected = dense(problem, loss_of("none"))
    # B has no row for the third landmark: it leaves the system with all its columns.
    kept = np.repeat(others, 3) * 3 + np.tile(np.arange(3), len(others))
    expected = replace(expected, B=expected.B[:, kept])
    _, graph = blocks_of(problem, loss_of("none"))
    augmented = graph.linearize(problem.values).augmentedHessian(touched_ordering(problem))
    assert_systems_agree(augmented[:-1, :-1], -augmented[:-1, -1], expected)
    assert augmented[-1, -1] == pytest.approx(expected.r @ expected.r + rows * 1000.0**2, rel=1e-12)


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("model", MODELS)
def test_error_where_it_is_linearised_is_half_the_squares_of_the_linear_system(
    model: str, loss: LossName
) -> None:
    problem = problem_of(model, off=0.01)
    _, graph = blocks_of(problem, loss_of(loss))
    linear = graph.linearize(problem.values)
    assert linear.error(random_step(problem, np.random.default_rng(0), 0.0)) == pytest.approx(
        graph.error(problem.values), rel=1e-12
    )


@pytest.mark.parametrize("size", [1e-4])
@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("model", MODELS)
def test_error_elsewhere_is_the_true_cost_of_the_landmarks_that_followed(
    model: str, loss: LossName, size: float
) -> None:
    problem, chosen = problem_of(model), loss_of(loss)
    expected, link = dense(problem, chosen), problem.template.linkage
    blocks, graph = blocks_of(problem, chosen)
    graph.linearize(problem.values)
    step = random_step(problem, np.random.default_rng(1), size)
    values = problem.values.retract(step)
    error = graph.error(values)
    dx = np.concatenate([step.at(link.key[v]) for v in np.flatnonzero(link.touched)])
    followed, views = expected.followed(dx), problem.template.views(values)
    assert error == pytest.approx(true_cost(followed, problem.measurements, views, chosen), rel=1e-7)
    assert blocks.settle(values) == pytest.approx(error, rel=1e-13)
    assert blocks.system.landmarks().vector == pytest.approx(followed.vector, abs=1e-9)


@pytest.mark.parametrize("loss", ["none", "cauchy"])
@pytest.mark.parametrize("size", [0.01, 0.1, 1.0])
def test_error_far_off_is_that_of_landmarks_held_back_or_placed_anew(size: float, loss: LossName) -> None:
    problem, chosen = problem_of("hard"), loss_of(loss)
    blocks, graph = blocks_of(problem, chosen)
    graph.linearize(problem.values)
    values = problem.values.retract(random_step(problem, np.random.default_rng(2), size))
    error = graph.error(values)
    assert blocks.settle(values) == pytest.approx(error, rel=1e-13)
    views = problem.template.views(values)
    landmarks = blocks.system.landmarks()
    assert error == pytest.approx(true_cost(landmarks, problem.measurements, views, chosen), rel=1e-9)
    assert np.linalg.norm(landmarks.vector, axis=1) == pytest.approx(1.0, abs=1e-12)
    assert error <= true_cost(problem.landmarks, problem.measurements, views, chosen) * (1 + 1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_cost_drops_as_the_linear_system_says(model: str) -> None:
    """Where residuals vanish but for the cameras' step, the model of the cost errs by the step's cube."""
    problem = problem_of(model, noise_px=0.0)
    misses = []
    for size in (1e-5, 1e-6):
        _, graph = blocks_of(problem, loss_of("none"))
        linear = graph.linearize(problem.values)
        step = random_step(problem, np.random.default_rng(3), size)
        predicted, found = linear.error(step), graph.error(problem.values.retract(step))
        misses.append(abs(found - predicted) / predicted)
    assert misses[0] < 0.01
    assert misses[1] < 0.2 * misses[0]


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("model", MODELS)
def test_gradient_of_the_cost_is_that_of_the_linear_system_though_residuals_do_not_vanish(
    model: str, loss: LossName
) -> None:
    """With landmarks where they fit best, their following changes the cost in second order only."""
    chosen = loss_of(loss)
    problem = problem_of(model).placed(chosen).placed(chosen)
    rng = np.random.default_rng(4)
    for _ in range(3):
        step = random_step(problem, rng, 1e-7)
        back = gtsam.VectorValues()
        for key in problem.template.linkage.key:
            back.insert(key, -step.at(key))
        _, graph = blocks_of(problem, chosen)
        linear = graph.linearize(problem.values)
        found = graph.error(problem.values.retract(step)) - graph.error(problem.values.retract(back))
        assert found == pytest.approx(linear.error(step) - linear.error(back), rel=1e-3, abs=1e-7)


def test_a_trial_that_is_not_adopted_leaves_no_trace() -> None:
    """GTSAM rejects a step by never linearising there: the next one starts from the same landmarks."""
    problem, loss = problem_of("hard", off=1e-3), loss_of("none")
    rng = np.random.default_rng(5)
    rejected = problem.values.retract(random_step(problem, rng, 0.01))
    adopted = problem.values.retract(random_step(problem, rng, 1e-4))
    found = []
    for trials in ([rejected, adopted], [adopted]):
        blocks, graph = blocks_of(problem, loss)
        graph.linearize(problem.values)
        start = blocks.system.landmarks().vector.copy()
        errors = [graph.error(values) for values in trials]
        assert np.array_equal(blocks.system.landmarks().vector, start)
        found.append((errors[-1], graph.linearize(adopted).augmentedHessian(touched_ordering(problem))))
        assert not np.array_equal(blocks.system.landmarks().vector, start)
    assert found[0][0] == found[1][0]
    assert np.array_equal(found[0][1], found[1][1])
    moved = problem.at(adopted, blocks.system.landmarks())
    assert_systems_agree(found[0][1][:-1, :-1], -found[0][1][:-1, -1], dense(moved, loss))


def test_each_factor_holds_the_cost_of_its_own_stop_elsewhere() -> None:
    problem = problem_of("hard")
    _, graph = blocks_of(problem, loss_of("none"))
    graph.linearize(problem.values)
    values = problem.values.retract(random_step(problem, np.random.default_rng(6), 1e-4))
    costs = [graph.at(i).error(values) for i in range(graph.size())]
    assert sum(costs) == pytest.approx(graph.error(values), rel=1e-12)
    assert len(costs) == 2
    assert min(costs) > 0


def test_an_exception_of_the_posture_reaches_the_caller_of_the_optimiser() -> None:
    problem = problem_of("hard", off=1e-3)
    system, _ = system_of(problem)
    calls = []

    def posture(values: gtsam.Values) -> Posture:
        calls.append(values)
        if len(calls) > 1:
            raise LookupError("no such posture: 4711")
        return problem.template.posture(values)

    graph = gtsam.NonlinearFactorGraph(problem.factors)
    for factor in LandmarkBlocks(system, read_variable, posture).factors():
        graph.push_back(factor)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, problem.values)
    with pytest.raises(LookupError, match="no such posture: 4711"):
        optimiser.optimize()
