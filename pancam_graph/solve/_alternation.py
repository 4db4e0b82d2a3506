"""Regular and shared parameters in turn, as in the thesis, for comparison with the joint step.

Regular parameters are landmarks and the variables of a stop, a frame or an image; shared parameters are
common to all stops (the last group of a Linkage). A regular step holds the shared parameters and eliminates
landmarks (Schur complement, thesis eq. 3.42, 3.43); a shared step holds all others and solves a small dense
system (eq. 4.10 to 4.13). Each is a Levenberg-Marquardt step with a damping of its own.
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import LandmarkSystem, Panels, Posture, Root
from pancam_graph.graph import FactorTemplate, graph_of
from pancam_graph.landmarks import Loss
from pancam_graph.solve._eliminated import EliminatedSolver
from pancam_graph.solve._joint import all_columns, retracted
from pancam_graph.solve._optimise import Iteration, Outcome, is_short
from pancam_graph.solve._problem import Problem, system_of
from pancam_graph.solve._reduced import add_factors
from pancam_graph.solve._stopping import LEFT_SIGMAS, StopRule

__all__ = ["AlternatingSolver"]

_LOG = logging.getLogger(__name__)
_FIRST = 1e-5
"""Initial damping, as a share of the diagonal of the normal equations."""
_LEAST, _MOST = 1e-12, 1e10
"""Range of the damping; GTSAM's joint search has the same upper limit."""
_ROUNDING = 1e-14
"""Expected decrease, as a share of the cost, below which it is rounding."""
_SLOWEST = 0.999
"""Largest ratio of successive gains assumed in extrapolation."""


class AlternatingSolver(EliminatedSolver):
    """The joint solver with alternation as its last stage.

    Screening and the fit of a rigid mast are those of the joint solver, so both end with the same
    observations.
    """

    def require(self, template: FactorTemplate) -> None:
        """Raise InputError where no free variable is shared by all stops."""
        if template.linkage.n_groups <= len(template.traverse.stops):
            raise InputError(
                f"method: expected joint with the model {template.model} as it is, found alternation: "
                "nothing is free that all stops share"
            )

    def _from_near(
        self, problem: Problem, rule: StopRule, loss: Loss, stage: str, left_sigmas: float
    ) -> tuple[Problem, Outcome]:
        """Minimise by alternation; in screening, by the joint solver."""
        if stage != "solve":
            return super()._from_near(problem, rule, loss, stage, left_sigmas)
        point = _Point(problem, loss)
        outcome, joint = _alternate(point, rule, stage, self.on_iteration)
        return self._ended(problem, outcome, point.system, point.rows, joint), outcome


class _Point:
    """The current values of a problem, and its system there."""

    def __init__(self, problem: Problem, loss: Loss) -> None:
        self.template, self.factors, self.values = problem.template, problem.factors, problem.values
        system, self.rows = system_of(problem, loss)
        assert isinstance(system, LandmarkSystem)  # the options have seen to it
        self.system = system
        self.n_observations = int(problem.kept.sum())
        self.held = self.template.held_by_group
        self.held_columns = all_columns(self.template.linkage, self.held)
        """The held columns among all columns"""
        self.cost = self.system.cost_at(self.posture(self.values)) + self.factors.error(self.values)
        self.n_steps = 0
        """Number of steps taken so far"""

    def posture(self, values: gtsam.Values) -> Posture:
        """Cameras at some values."""
        return self.template.posture(values)

    def panels(self) -> Panels:
        """The system at the current values, landmarks eliminated, all factors included; not a copy."""
        panels = self.system.linearise(self.posture(self.values))
        add_factors(panels, self.template.linkage, self.factors.linearize(self.values))
        return panels

    def moved(self, step: FloatArray) -> gtsam.Values:
        """Values after a step of all columns; held components stay exactly the same."""
        step[self.held_columns] = 0.0
        return retracted(self.template.linkage, self.values, step)


@dataclass(kw_only=True)
class _Damping:
    """Nielsen's rule: the next damping follows from the gain ratio of the last step.

    Source: Nielsen, Damping parameter in Marquardt's method, 1999, as in SBA (thesis chapter 3); here the
    damping scales the diagonal, since radians, metres and pixels have no common unit.
    """

    share: float = _FIRST
    """Damping, as a share of the diagonal."""
    growth: float = 2.0
    """Factor on the damping after the next step that fails."""

    def relax(self, gain_ratio: float) -> None:
        """Reduce the damping after a step; `gain_ratio` is its actual over its expected decrease of cost."""
        self.share = max(self.share * max(1 / 3, 1 - (2 * gain_ratio - 1) ** 3), _LEAST)
        self.growth = 2.0

    def tighten(self) -> None:
        """Increase the damping after a step that did not lower the cost."""
        self.share *= self.growth
        self.growth *= 2


class _Set(ABC):
    """Parameters that move together while the others are held."""

    def __init__(self, point: _Point) -> None:
        self.point = point
        self.damping = _Damping()
        self.rests = False
        """Whether it is skipped, since it stalled"""
        self.stalled_at = -1
        """Number of steps of the point when it stalled last"""

    @abstractmethod
    def linearise(self, panels: Panels | None) -> None:
        """Prepare steps from the current values; `panels` are the system there, if known. Destroys them."""

    @abstractmethod
    def propose(self, damping: float) -> tuple[FloatArray, float]:
        """A step of all columns, and its expected decrease of the quadratic model."""

    @abstractmethod
    def cost_at(self, posture: Posture, step: FloatArray) -> float:
        """Cost of the observations after a step."""

    @abstractmethod
    def take(self) -> None:
        """Take the last step for the landmarks."""

    def advance(self, panels: Panels | None = None) -> None:
        """Take one step that lowers the cost, or stall."""
        point = self.point
        self.linearise(panels)
        while self.damping.share <= _MOST:
            step, promised = self.propose(self.damping.share)
            if promised <= _ROUNDING * point.cost:
                break
            values = point.moved(step)
            cost = self.cost_at(point.posture(values), step) + point.factors.error(values)
            if cost < point.cost:
                self.damping.relax((point.cost - cost) / promised)
                self.take()
                point.values, point.cost, point.n_steps = values, cost, point.n_steps + 1
                return
            self.damping.tighten()
        self.damping, self.rests, self.stalled_at = _Damping(), True, point.n_steps


class _Regular(_Set):
    """The regular set: landmarks, eliminated, and the variables of single stops."""

    def linearise(self, panels: Panels | None) -> None:
        """Linearise with the shared variables held."""
        link = self.point.template.linkage
        shared = link.n_groups - 1
        self._panels = panels or self.point.panels()
        self._panels.hold({**self.point.held, shared: np.arange(int(link.group_dim[shared]))})
        self._diagonal, self._right = self._panels.diagonal(), self._panels.right()

    def propose(self, damping: float) -> tuple[FloatArray, float]:
        """A step by the square root of the damped system; landmarks are not damped."""
        panels = self._panels.copy()
        panels.damp(damping)
        step = panels.root().step()
        promised = 0.5 * float(damping * step**2 @ self._diagonal - step @ self._right)
        return step, promised + self.point.system.gain_alone

    def cost_at(self, posture: Posture, step: FloatArray) -> float:
        """Cost with landmarks moved by back substitution."""
        return float(self.point.system.try_step(posture, step).sum())

    def take(self) -> None:
        """Adopt the moved landmarks."""
        self.point.system.adopt()


class _Shared(_Set):
    """The shared set: variables that all stops have in common."""

    def __init__(self, point: _Point) -> None:
        super().__init__(point)
        link = point.template.linkage
        self._group = link.n_groups - 1
        self._columns = slice(*link.group_column[self._group : self._group + 2].tolist())
        shared_keys = {key for key, group in zip(link.key, link.group, strict=True) if group == self._group}
        self._factors = graph_of(f for f in point.factors.all if not shared_keys.isdisjoint(f.keys()))
        """Factors on any of the shared variables"""
        self._is_seen = bool(link.touched[link.group == self._group].any())
        """Whether cameras depend on the shared variables; else only ties do"""

    def linearise(self, panels: Panels | None) -> None:
        """Linearise with landmarks and all other variables held."""
        point = self.point
        system, link = point.system, point.template.linkage
        if panels is None:
            panels = (
                system.linearise(point.posture(point.values)) if self._is_seen else Panels(system.structure)
            )
            add_factors(panels, link, self._factors.linearize(point.values))
        S, s = system.put_back(panels, self._group)
        # Columns are scaled by their information, since pixels, radians and metres differ by much.
        unit = np.sqrt(np.diag(S))
        self._unit = np.where(unit > 0, unit, 1.0)
        self._S, self._s = S / np.outer(self._unit, self._unit), s / self._unit

    def propose(self, damping: float) -> tuple[FloatArray, float]:
        """A step by dense normal equations."""
        x = -np.linalg.solve(self._S + damping * np.eye(len(self._s)), self._s)
        step = np.zeros(int(self.point.template.linkage.group_column[-1]))
        step[self._columns] = x / self._unit
        return step, 0.5 * float(damping * x @ x - x @ self._s)

    def cost_at(self, posture: Posture, step: FloatArray) -> float:
        """Cost with landmarks held."""
        return self.point.system.cost_at(posture)

    def take(self) -> None:
        """Nothing to do: landmarks are held."""


def _alternate(
    point: _Point, rule: StopRule, stage: str, on_iteration: Callable[[Iteration], None] | None
) -> tuple[Outcome, Root]:
    """Both sets in turn until neither lowers the cost or the rule ends it; one round is one iteration.

    A set that stalls is skipped while the other continues; it is tried again when the other converges or
    stalls too. The second result is the square root of the whole system at the end.
    """
    regular, shared = sets = (_Regular(point), _Shared(point))
    costs = [point.cost]
    no_cost = point.n_observations * rule.residual_sigmas**2 / 2
    reason: str | None = None
    is_settled = False
    while True:
        panels, joint = point.panels(), None
        if reason is None and is_settled:
            joint = _whole(panels, point)
            ahead = joint.gain() + point.system.gain_alone
            if ahead <= min(rule.relative_decrease * costs[-1], LEFT_SIGMAS**2 / 2):
                reason = f"relative decrease below {rule.relative_decrease:g}"
        if reason is None and rule.residual_sigmas and costs[-1] <= no_cost:
            reason = f"residuals below {rule.residual_sigmas:g} sigma"
        if reason is None and rule.max_gradient:
            gradient = np.abs(np.delete(panels.right(), point.held_columns)).max(initial=0.0)
            if gradient <= rule.max_gradient:
                reason = f"gradient below {rule.max_gradient:g}"
        if reason is not None or len(costs) > rule.max_iterations:
            break

        before, is_whole = point.values, not any(s.rests for s in sets)
        if regular.rests:
            shared.advance(panels)
        else:
            regular.advance(panels)
            if not shared.rests:
                shared.advance()
        costs.append(point.cost)
        number = len(costs) - 1
        _LOG.debug(
            "iteration %d: cost %.9g, dampings %.1e, %.1e",
            number,
            costs[-1],
            regular.damping.share,
            shared.damping.share,
        )
        if on_iteration is not None:
            on_iteration(Iteration(stage=stage, number=number, cost=costs[-1]))

        is_settled = _still_to_gain(costs) <= rule.relative_decrease * costs[-1] > 0
        if all(s.stalled_at == point.n_steps for s in sets):
            reason = "no step lowers the cost"
        elif is_whole and costs[-1] < costs[-2] and is_short(before, point.values, rule.relative_step):
            reason = f"relative step below {rule.relative_step:g}"
        elif not is_whole:
            if is_settled or all(s.rests for s in sets):
                for s in sets:
                    s.rests = s.stalled_at == point.n_steps
            is_settled = False
    return Outcome(
        values=point.values,
        converged=reason is not None,
        reason=reason or f"iteration limit of {rule.max_iterations}",
        costs=tuple(costs),
    ), joint or _whole(panels, point)


def _whole(panels: Panels, point: _Point) -> Root:
    """Square root of the whole system of both sets."""
    panels = panels.copy()
    panels.hold(point.held)
    return panels.root()


def _still_to_gain(costs: list[float]) -> float:
    """Expected decrease of cost by further rounds, with gains that shrink as the last one did.

    Alternation converges linearly, and slowly where the sets depend on each other.
    """
    gain = costs[-2] - costs[-1]
    if len(costs) < 3 or gain <= 0:
        return gain
    rate = min(gain / max(costs[-3] - costs[-2], 1e-300), _SLOWEST)
    return gain * rate / (1 - rate)
