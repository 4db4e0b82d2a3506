"""When iterations end: each criterion does so on its own, says so, and holds where it ended, not before."""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from itertools import product
from typing import cast

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, StopRule, Traverse, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.graph import ExplicitLandmarks, Flex, SoftTemplate, read_variable
from pancam_graph.initialise import Start
from pancam_graph.rigs import mer_navcam
from pancam_graph.solve import Fitted, InOrder, OnGraph, Problem, judge
from pancam_graph.solve._optimise import Optimiser, _is_settled
from pancam_graph.solve._stopping import criteria, sigmas_left
from support.parameters import slow_but_for, slow_for
from support.solving import fitted, solution_from

SMALL = SimulationOptions(stops=2, pans=2, sweep_rad=0.8, points_per_image=12)
BARE = SolveOptions(rig="held", loss="none", relative_decrease=0.0, residual_sigmas=0.0)
FIRM = Flex(rotation_rad=1e-4, translation_m=1e-3)
SOLVERS = {
    "eliminated": BARE,
    "circle": replace(BARE, model="circle"),
    "explicit": replace(BARE, landmarks="explicit", tie="soft", flex=FIRM),
}


@cache
def traverse() -> Traverse:
    """Two stops, the second with its rotation held, and a frame of it with its pan held, at the truth."""
    simulation = simulate(mer_navcam(), SMALL, seed=2)
    t, truth = simulation.traverse, simulation.truth
    pan_rad = float(truth.pan_tilt_rad[-1, 0])
    frames = (*t.frames[:-1], replace(t.frames[-1], pan_rad=pan_rad, sigma_pan_rad=0.0))
    pose = gtsam.Pose3(truth.world_T_mast[1].rotation(), t.stops[1].world_T_mast.translation())
    stops = (t.stops[0], replace(t.stops[1], world_T_mast=pose, sigma_rotation_rad=0.0))
    return replace(t, stops=stops, frames=frames)


@cache
def ended(options: SolveOptions) -> Fitted:
    return fitted(traverse(), options)


def shortened(options: SolveOptions) -> Fitted:
    """The same solve, of which the last iteration is left out."""
    limit = last_run(ended(options)) - 1
    return ended(replace(options, max_iterations=limit))


def last_run(adjustment: Fitted) -> int:
    """Iterations of the final least squares alone, told by how many it needs at least."""
    options, full = adjustment.screened.prepared.options, adjustment.outcome
    for limit in range(1, 200):
        outcome = ended(replace(options, max_iterations=limit)).outcome
        if outcome.converged:
            assert outcome.costs == full.costs
            return limit
    raise AssertionError("it never ended")


CRITERIA = {
    "residual_sigmas": (1.6, "residuals below 1.6 sigma"),
    "max_gradient": (100.0, "gradient below 100"),
    "relative_step": (1e-4, "relative step below 0.0001"),
    "relative_decrease": (1e-9, "relative decrease below 1e-09"),
}


@pytest.mark.parametrize(
    ("solver", "name"),
    slow_for([("explicit", name) for name in CRITERIA], product(SOLVERS, CRITERIA)),
)
def test_each_criterion_alone_ends_a_solve_and_says_so(solver: str, name: str) -> None:
    bound, reason = CRITERIA[name]
    options = replace(SOLVERS[solver], **{name: bound})  # type: ignore[arg-type]  # options by name
    outcome = ended(options).outcome
    assert outcome.converged
    assert outcome.reason == reason
    assert len(outcome.costs) < len(ended(SOLVERS[solver]).outcome.costs)


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_iteration_limit_ends_a_solve_and_is_not_convergence(solver: str) -> None:
    outcome = ended(replace(SOLVERS[solver], max_iterations=2)).outcome
    assert not outcome.converged
    assert outcome.reason == "iteration limit of 2"


@pytest.mark.parametrize("solver", slow_for("explicit", SOLVERS))
def test_without_any_criterion_only_the_lack_of_a_better_step_ends_it(solver: str) -> None:
    outcome = ended(SOLVERS[solver]).outcome
    assert outcome.converged
    assert outcome.reason == "no step lowers the cost"
    tight = ended(replace(SOLVERS[solver], relative_decrease=1e-13)).outcome
    assert outcome.costs[-1] <= tight.costs[-1] * (1 + 1e-12)


def test_what_is_left_at_its_default_ends_nothing_early() -> None:
    """Of the five only the limit and the relative decrease end a solve that has noise."""
    default = fitted(traverse(), SolveOptions(rig="held", loss="none"))
    assert default.outcome.reason == "relative decrease below 1e-07"
    assert default.outcome.costs == ended(replace(BARE, relative_decrease=1e-7)).outcome.costs


# --- the criterion holds where it ended, and did not one iteration before ---


def nudged(values: gtsam.Values, key: int, dim: int, component: int, by: float) -> gtsam.Values:
    step = gtsam.VectorValues()
    step.insert(key, by * (np.arange(dim) == component))
    return values.retract(step)


def largest_slope(
    cost: Callable[[gtsam.Values], float], values: gtsam.Values, held: dict[int, IntArray], by: float
) -> float:
    """Largest component of the gradient of a cost by central differences, but for held components."""
    largest, dims = 0.0, values.localCoordinates(values)
    for key in values.keys():  # noqa: SIM118  gtsam.Values is not a dictionary
        dim = len(dims.at(key))
        for c in np.setdiff1d(np.arange(dim), held.get(key, [])):
            high, low = (cost(nudged(values, key, dim, int(c), d)) for d in (by, -by))
            largest = max(largest, abs(high - low) / (2 * by))
    return largest


def profile_gradient(problem: Problem) -> float:
    """The same of the cost over cameras, landmarks where they then fit best."""
    placed = problem.placed()

    def cost(values: gtsam.Values) -> float:
        return placed.at(values, placed.landmarks).placed().cost()

    return largest_slope(cost, problem.values, problem.template.held_columns(), 1e-7)


@pytest.mark.parametrize("solver", slow_but_for("eliminated", ["eliminated", "circle"]))
def test_the_gradient_is_that_of_the_cost_where_landmarks_fit_best(solver: str) -> None:
    options = replace(SOLVERS[solver], max_gradient=100.0)
    assert profile_gradient(ended(options).problem) < 110
    assert profile_gradient(shortened(options).problem) > 90


@pytest.mark.slow
def test_the_gradient_of_explicit_landmarks_is_that_of_gtsams_error() -> None:
    """Landmarks are among the components. Held ones are not: forces push there."""
    t = traverse()
    assert t.observations is not None
    few = t.with_observations(t.observations.select(t.observations.track % 6 == 0))
    adjustment = fitted(few, replace(SOLVERS["explicit"], max_iterations=1))
    problem = adjustment.problem
    assert isinstance(problem.template, SoftTemplate)
    explicit = ExplicitLandmarks(problem.template, problem.measurements)
    graph = gtsam.NonlinearFactorGraph(problem.factors.graph)
    graph.push_back(explicit.factors(problem.kept))
    values = explicit.with_landmarks(problem.values, problem.points_m(), problem.present)
    held = problem.template.held_columns()
    rule, order = StopRule(), InOrder(list(values.keys()))
    found = OnGraph(graph, values, rule, order, held).gradient()
    assert found == pytest.approx(largest_slope(graph.error, values, held, 1e-6), rel=1e-3)
    assert OnGraph(graph, values, rule, order, {}).gradient() > 1.1 * found


def numbers(values: gtsam.Values, key: int) -> FloatArray:
    value = read_variable(values, key)
    if isinstance(value, gtsam.Pose3):
        return np.concatenate([gtsam.Rot3.Logmap(value.rotation()), value.translation()])
    return np.atleast_1d(np.asarray(value, dtype=float))


def test_the_step_is_relative_to_the_parameters_before_it() -> None:
    options = replace(BARE, relative_step=1e-4)
    n = last_run(ended(options))
    sizes = []
    for limit in (n - 1, n):
        x, y = (ended(replace(options, max_iterations=i)).problem.values for i in (limit - 1, limit))
        keys = list(x.keys())
        step = np.concatenate([x.localCoordinates(y).at(key) for key in keys])
        size = np.linalg.norm(np.concatenate([numbers(x, key) for key in keys]))
        sizes.append(np.linalg.norm(step) / size)
    assert sizes[1] <= 1e-4 < sizes[0]


def test_residuals_are_those_per_observation() -> None:
    options = replace(BARE, residual_sigmas=1.6)
    n = int(ended(options).problem.kept.sum())
    last, before = (np.sqrt(2 * np.array(ended(options).outcome.costs[:-3:-1]) / n)).tolist()
    assert last <= 1.6 < before


def test_at_the_optimum_the_gradient_ends_it_before_the_first_step() -> None:
    optimum = ended(BARE)
    state = judge(optimum).state
    start = Start(world_T_mast=state.world_T_mast, pan_tilt_rad=state.pan_tilt_rad)
    again = fitted(traverse(), replace(BARE, max_gradient=1.0), start)
    assert len(again.outcome.costs) == 1
    assert solution_from(again).converged
    assert solution_from(again).cost_final == pytest.approx(optimum.outcome.costs[-1], rel=1e-12)


def test_vanishing_residuals_end_it() -> None:
    exact = simulate(mer_navcam(), replace(SMALL, noise_px=0.0, prior="truth"), seed=3)
    telemetry = exact.telemetry_start
    start = Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)
    adjustment = fitted(exact.traverse, replace(BARE, residual_sigmas=1e-6), start)
    assert adjustment.outcome.reason == "residuals below 1e-06 sigma"
    n = len(adjustment.screened.prepared.observations)
    assert adjustment.outcome.costs[-1] <= n * 1e-12 / 2 < adjustment.outcome.costs[-2]


# --- what is refused ---


@pytest.mark.parametrize("name", [f.name for f in fields(StopRule)])
@pytest.mark.parametrize("value", [-1, float("nan"), float("inf")])
def test_refused_numbers(name: str, value: float) -> None:
    for kind in (StopRule, SolveOptions):
        with pytest.raises(InputError, match=f"^{name}: expected .*, found {value}"):
            kind(**{name: value})  # type: ignore[arg-type]  # options by name


@pytest.mark.parametrize("limit", [0, 2.5])
def test_a_limit_is_a_whole_number_above_0(limit: float) -> None:
    with pytest.raises(InputError, match=rf"^max_iterations: expected a whole number .*found {limit}"):
        StopRule(max_iterations=limit)  # type: ignore[arg-type]  # the mistake under test


def test_criteria_as_a_command_line_has_them() -> None:
    assert criteria([]) == {}
    found = criteria(["max_gradient=1e-3", "max_iterations=7", "relative_decrease=0"])
    assert found == {"max_gradient": 1e-3, "max_iterations": 7, "relative_decrease": 0.0}


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["gradient=1"], ("NAME=NUMBER", "max_gradient", "'gradient=1'")),
        (["max_gradient"], ("NAME=NUMBER", "'max_gradient'")),
        (["max_gradient="], ("max_gradient: expected a number", "''")),
        (["max_gradient=small"], ("max_gradient: expected a number", "'small'")),
        (["max_iterations=1e2"], ("max_iterations: expected a whole number", "'1e2'")),
        (["max_gradient=1", "max_gradient=1"], ("max_gradient", "once", "twice")),
    ],
)
def test_refused_criteria(texts: list[str], words: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as caught:
        criteria(texts)
    for word in ("stop: ", "expected", "found", *words):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("ahead", "settled"),
    [(154.0, False), (1e-5, True), (None, False)],
)
def test_gains_that_shrink_are_no_end_while_the_next_step_promises_more(
    ahead: float | None, settled: bool
) -> None:
    """As where a landmark is stuck: three costs of a real solve that went on to 3456.8."""
    costs = [12030.527, 3611.238, 3611.039]
    # Only its values are asked for, and here they are none.
    optimizer = cast(
        Optimiser, gtsam.LevenbergMarquardtOptimizer(gtsam.NonlinearFactorGraph(), gtsam.Values())
    )
    assert _is_settled(costs, 1e-7, lambda _: ahead, optimizer) == settled
    assert _is_settled(costs, 1e-7, None, optimizer)


@pytest.mark.slow
def test_a_small_share_of_a_large_cost_is_no_optimum() -> None:
    """Sigmas told 50 times too small make the cost 8 million: a ten-millionth of it is 1.3 sigma.

    The best cost is that of a solve without the criterion, which nothing but rounding ends.
    """
    options = SimulationOptions(
        stops=2,
        pans=4,
        sweep_rad=2.5,
        points_per_image=12,
        noise_px=0.5,
        spacing_m=0.3,
        sigma_stop_m=1.0,
        sigma_stop_rad=0.05,
    )
    t = simulate(mer_navcam(), options, seed=1).traverse
    assert t.observations is not None
    told = t.with_observations(replace(t.observations, sigma_px=0.01 * t.observations.sigma_px))
    solution = solve(told, SolveOptions(rig="held", model="free"))
    best = solve(told, SolveOptions(rig="held", model="free", relative_decrease=0.0))
    assert solution.stop_reason == "relative decrease below 1e-07"
    assert solution.cost_final - best.cost_final < 0.1**2 / 2
    assert solution.verdict is not None
    assert {test.name: test.passed for test in solution.verdict.tests}["optimum"]


def test_steps_of_a_crawl_add_up() -> None:
    """Each gains 0.81 of the one before, and is 0.9 times as long: ten of the next are left."""
    costs = [100.0 + 0.81**k for k in range(40)]
    ahead = 0.81**39 * (1 - 0.81)
    assert sigmas_left(costs, ahead) == pytest.approx(10 * np.sqrt(2 * ahead), rel=1e-6)
    assert sigmas_left(costs, None) == pytest.approx(10 * np.sqrt(2 * ahead), rel=1e-6)
    assert sigmas_left([2.0, 1.0], 0.5) == pytest.approx(1.0)
