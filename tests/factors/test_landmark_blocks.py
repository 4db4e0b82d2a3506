"""Landmark blocks: exactly what dense least squares with all landmarks gives, and the true cost elsewhere."""

from dataclasses import replace
from functools import cache
from itertools import product

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, simulate
from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import LandmarkSystem, Posture
from pancam_graph.factors import LandmarkBlocks
from pancam_graph.graph import Flex, read_variable
from pancam_graph.landmarks import CameraViews, Loss, LossName, loss_of
from pancam_graph.rigs import exomars_pancam
from pancam_graph.simulate import Simulation
from pancam_graph.solve import EliminatedSolver, Problem, StopRule, prepare
from pancam_graph.solve._joint import JointSystem
from pancam_graph.solve._problem import system_of
from support.elimination_reference import Dense, assert_systems_agree, dense_of, true_cost, whole
from support.parameters import slow_but_for, slow_for

TINY = SimulationOptions(stops=2, pans=2, sweep_rad=0.7, tilts_rad=(-0.2,), points_per_image=5)
MODELS = {
    "hard": SolveOptions(loss="none", rig="held"),
    "soft": SolveOptions(loss="none", tie="soft", flex=Flex(rotation_rad=1e-4, translation_m=1e-3)),
    "circle": SolveOptions(loss="none", model="circle"),
}

RULE = StopRule(max_iterations=50, relative_decrease=1e-13)


@cache
def tiny(noise_px: float = 0.3) -> Simulation:
    """Two stops of two frames; the first stop is a variable too."""
    simulation = simulate(exomars_pancam(), replace(TINY, noise_px=noise_px, prior="truth"), seed=1)
    t = simulation.traverse
    stops = tuple(replace(s, sigma_rotation_rad=0.01, sigma_translation_m=0.1) for s in t.stops)
    return replace(simulation, traverse=replace(t, stops=stops))


def problem_of(model: str, *, off: float = 0.0, noise_px: float = 0.3, seed: int = 0) -> Problem:
    """Cameras at the truth and landmarks where they fit, both moved by random numbers of the size `off`."""
    problem = prepare(tiny(noise_px).traverse, MODELS[model]).problem
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


def dense(problem: Problem, loss: Loss) -> Dense:
    link = problem.template.linkage
    variables = np.flatnonzero(link.touched)
    ends = np.cumsum(link.dim[variables])

    def views_after(step: FloatArray) -> CameraViews:
        steps = gtsam.VectorValues()
        for v, end in zip(variables, ends, strict=True):
            steps.insert(link.key[v], step[end - link.dim[v] : end])
        return problem.template.views(problem.values.retract(steps))

    return dense_of(views_after, int(ends[-1]), problem.measurements, problem.landmarks, loss)


def blocks_of(problem: Problem, loss: Loss) -> tuple[LandmarkBlocks, gtsam.NonlinearFactorGraph]:
    system, _ = system_of(problem, loss)
    assert isinstance(system, LandmarkSystem)
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


@pytest.mark.parametrize(
    ("model", "off", "loss"),
    slow_but_for(
        [
            *(("hard", off, loss) for off in (0.0, 0.03) for loss in ("none", "huber", "cauchy")),
            ("hard", 1e-3, "cauchy"),
            ("soft", 0.0, "none"),
            ("soft", 1e-3, "huber"),
            ("soft", 0.03, "cauchy"),
        ],
        product(["hard", "soft"], [0.0, 1e-3, 0.03], ["none", "huber", "cauchy"]),
    ),
)
def test_factors_are_the_dense_system_without_its_landmarks(model: str, off: float, loss: LossName) -> None:
    problem, chosen = problem_of(model, off=off), loss_of(loss)
    expected = dense(problem, chosen)
    _, graph = blocks_of(problem, chosen)
    linear = graph.linearize(problem.values)
    augmented = linear.augmentedHessian(touched_ordering(problem))
    assert_systems_agree(augmented[:-1, :-1], -augmented[:-1, -1], expected)
    cost = true_cost(problem.landmarks, problem.measurements, problem.views, chosen)
    assert augmented[-1, -1] == pytest.approx(2 * cost, rel=1e-12)


@pytest.mark.parametrize(
    ("model", "off"),
    slow_but_for(
        [("hard", 0.0), ("hard", 0.03), ("soft", 0.0), ("circle", 0.03)], product(MODELS, [0.0, 0.03])
    ),
)
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
@pytest.mark.parametrize("model", ["hard", "soft"])
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
@pytest.mark.parametrize(
    ("model", "loss"),
    slow_for([("soft", "none"), ("soft", "cauchy")], product(["hard", "soft"], ["none", "huber", "cauchy"])),
)
def test_error_elsewhere_is_the_true_cost_of_the_landmarks_that_followed(
    model: str, loss: LossName, size: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pancam_graph.elimination._strays._STRAY", np.inf)  # nothing is refined after it
    monkeypatch.setattr("pancam_graph.graph.SoftTemplate.refines_landmarks", False)
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
    assert blocks.settle(values)
    assert not blocks.settle(values)
    assert graph.error(values) == pytest.approx(error, rel=1e-13)
    assert blocks.system.landmarks().vector == pytest.approx(followed.vector, abs=1e-9)


@pytest.mark.parametrize("loss", ["none", "cauchy"])
@pytest.mark.parametrize("size", [0.01, 0.1, 1.0])
def test_error_far_off_is_that_of_landmarks_held_back_or_placed_anew(size: float, loss: LossName) -> None:
    problem, chosen = problem_of("hard"), loss_of(loss)
    blocks, graph = blocks_of(problem, chosen)
    graph.linearize(problem.values)
    values = problem.values.retract(random_step(problem, np.random.default_rng(2), size))
    error = graph.error(values)
    assert blocks.settle(values)
    assert not blocks.settle(values)
    assert graph.error(values) == pytest.approx(error, rel=1e-13)
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
    assert isinstance(system, LandmarkSystem)
    calls = []

    def posture(values: gtsam.Values) -> Posture:
        calls.append(values)
        if len(calls) > 1:
            raise LookupError("no such posture: 4711")
        return problem.template.posture(values)

    graph = gtsam.NonlinearFactorGraph(problem.factors.graph)
    for factor in LandmarkBlocks(system, read_variable, posture).factors():
        graph.push_back(factor)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, problem.values)
    with pytest.raises(LookupError, match="no such posture: 4711"):
        optimiser.optimize()


@pytest.mark.parametrize("model", MODELS)
def test_the_gain_ahead_is_what_the_iterations_to_come_gain(model: str) -> None:
    """By it the solver ends: near the optimum the linearised system tells how far off it is."""
    problem = EliminatedSolver(None).adjust(problem_of(model), RULE)[0]
    nudge = random_step(problem, np.random.default_rng(4), 1e-6)
    nudged = replace(problem, values=problem.values.retract(nudge))
    system, _ = system_of(nudged)
    ahead = JointSystem(nudged, system).root().gain() + system.gain_alone
    assert ahead == pytest.approx(nudged.cost() - problem.cost(), rel=1e-3)
