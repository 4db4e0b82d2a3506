"""All groups but one eliminated before GTSAM's step: it is the step of the whole system, damped alike."""

import gc
import weakref
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, StopRule, simulate, solve
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import Freedom, Sharing
from pancam_graph.elimination import LandmarkSystem, Panels
from pancam_graph.graph import Flex, Model
from pancam_graph.rigs import mer_navcam
from pancam_graph.solve import Problem, prepare
from pancam_graph.solve._joint import JointSystem, OnLastGroup
from pancam_graph.solve._problem import system_of
from support.parameters import slow_but_for, slow_for
from support.solving import fitted

OPTIONS = SimulationOptions(stops=3, spacing_m=4.0, pans=3, sweep_rad=0.9, points_per_image=15)
RULE = StopRule(relative_decrease=1e-12)
MODELS: tuple[Model, ...] = ("free", "circle", "projective")


def problem_of(model: Model, *, shared: bool = False) -> Problem:
    flex = None if model == "circle" else Flex(rotation_rad=0.02, translation_m=0.3)
    sharing = Sharing(calibration=Freedom(scope="eye", free=("focal",))) if shared else None
    options = SolveOptions(rig="held", model=model, loss="none", flex=flex, sharing=sharing)
    return prepare(simulate(mer_navcam(), OPTIONS, seed=3).traverse, options).problem


def joint_of(problem: Problem) -> JointSystem:
    return JointSystem(problem, system_of(problem)[0])


def dense(panels: Panels, begin: IntArray) -> tuple[FloatArray, FloatArray]:
    """(S, s) of all columns, group by group."""
    st, n = panels.structure, int(begin[-1])
    S = np.zeros((n, n))
    for g, panel in enumerate(panels.panel):
        rows = slice(begin[g], begin[g + 1])
        for h, a, b in zip(st.after[g], st.begin[g][:-1], st.begin[g][1:], strict=True):
            columns = slice(begin[h], begin[h + 1])
            if h == g:
                S[rows, columns] = np.triu(panel[:, a:b]) + np.triu(panel[:, a:b], 1).T
            else:
                S[rows, columns] = panel[:, a:b]
                S[columns, rows] = panel[:, a:b].T
    return S, panels.right()


def moved(problem: Problem, to: gtsam.Values) -> FloatArray:
    """The step (columns,) between values."""
    link, step = problem.template.linkage, problem.values.localCoordinates(to)
    out = np.zeros(int(link.group_column[-1]))
    for key, group in zip(link.key, link.group, strict=True):
        own, begin = link.columns_of(key), int(link.group_column[group])
        out[begin + own.start : begin + own.stop] = step.at(key)
    return out


@pytest.mark.parametrize(
    ("model", "shared"),
    slow_for(
        [("free", False), ("circle", True)],
        [("free", False), ("free", True), ("circle", False), ("circle", True), ("projective", False)],
    ),
)
def test_a_step_is_that_of_the_whole_system_damped_alike(model: Model, shared: bool) -> None:
    problem = problem_of(model, shared=shared)
    joint, panels = joint_of(problem), joint_of(problem).panels()
    S, s = dense(panels, problem.template.linkage.group_column)
    optimiser = OnLastGroup(joint, RULE)
    before, first = optimiser.error(), optimiser.damping()
    optimiser.iterate()
    assert optimiser.error() < before
    # GTSAM lowers the damping tenfold after a step; it was raised as often as steps were refused.
    damping = 10 * optimiser.damping()
    assert np.log10(damping / first) == pytest.approx(round(np.log10(damping / first)), abs=1e-9)
    expected = -np.linalg.solve(S + damping * np.eye(len(s)), s)
    step = moved(problem, optimiser.values())
    assert step == pytest.approx(expected, rel=1e-5, abs=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("model", slow_but_for("circle", MODELS))
def test_its_cost_is_the_true_one_wherever_it_stands(model: Model) -> None:
    problem = problem_of(model)
    system, rows = system_of(problem)
    joint = JointSystem(problem, system)
    optimiser = OnLastGroup(joint, RULE)
    assert optimiser.error() == pytest.approx(problem.cost(), rel=1e-12)
    for _ in range(3):
        optimiser.iterate()
        vector = problem.landmarks.vector.copy()
        vector[rows] = system.landmarks().vector
        there = problem.at(optimiser.values(), replace(problem.landmarks, vector=vector))
        assert optimiser.error() == pytest.approx(there.cost(), rel=1e-10)


def test_what_no_damping_lets_lower_the_cost_stays_where_it_is() -> None:
    """At an optimum; each bit of it."""
    adjustment = fitted(
        simulate(mer_navcam(), OPTIONS, seed=3).traverse,
        SolveOptions(rig="held", model="free", loss="none", relative_decrease=1e-14, max_iterations=100),
    )
    problem = adjustment.problem
    joint = joint_of(problem)
    optimiser = OnLastGroup(joint, RULE)
    before = optimiser.error()
    optimiser.iterate()
    assert optimiser.error() <= before
    assert optimiser.error() == pytest.approx(before, rel=1e-10)


@pytest.mark.parametrize(
    "options",
    [
        SolveOptions(rig="held"),
        pytest.param(SolveOptions(), marks=pytest.mark.slow),
        pytest.param(SolveOptions(model="free"), marks=pytest.mark.slow),
        pytest.param(
            SolveOptions(rig="held", method="alternation", sharing=Sharing(mounts=Freedom(scope="eye"))),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["held", "estimated", "free", "alternation"],
)
def test_what_a_solve_has_in_memory_is_given_back(
    options: SolveOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GTSAM's factors hold Python functions, which Python's collector does not see."""
    systems, begin = list[weakref.ref[LandmarkSystem]](), LandmarkSystem.__init__

    def noted(self: LandmarkSystem, *arguments: Any, **named: Any) -> None:
        begin(self, *arguments, **named)
        systems.append(weakref.ref(self))

    monkeypatch.setattr(LandmarkSystem, "__init__", noted)
    solve(simulate(mer_navcam(), replace(OPTIONS, stops=2), seed=3).traverse, options)
    gc.collect()
    assert systems
    assert not any(system() for system in systems)
