"""Regular and shared parameters in turn, as in the thesis, for comparison with the joint step.

Regular are landmarks and what belongs to a stop, a frame or an image; shared is what all stops have in
common (the last group of a Linkage). A regular step holds what is shared and eliminates landmarks (Schur
complement, thesis eq. 3.42, 3.43); a shared step holds everything else and is small and dense (eq. 4.10 to
4.13). Each is a Levenberg-Marquardt step with a damping of its own.
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import Panels, Posture, Root
from pancam_graph.graph import FactorTemplate, graph_of
from pancam_graph.landmarks import Loss
from pancam_graph.solve._eliminated import EliminatedSolver
from pancam_graph.solve._joint import all_columns, retracted
from pancam_graph.solve._optimise import Iteration, Outcome, is_short
from pancam_graph.solve._problem import Problem, system_of
from pancam_graph.solve._reduced import add_factors, held_columns
from pancam_graph.solve._stopping import StopRule

__all__ = ["AlternatingSolver"]

_LOG = logging.getLogger(__name__)
_FIRST = 1e-5
"""First damping, as a share of the diagonal of the normal equations."""
_LEAST, _MOST = 1e-12, 1e10
"""Damping within which a step is sought; GTSAM's joint search ends at the same."""
_ROUNDING = 1e-14
"""A step that promises no more than this share of the cost promises nothing."""
_SLOWEST = 0.999
"""Gains are expected to shrink at least as much from round to round."""


class AlternatingSolver(EliminatedSolver):
    """Outliers are sought, and a rigid mast is fitted first, as in the joint solve; the end is alternation.

    So both end over the same observations.
    """

    def require(self, template: FactorTemplate) -> None:
        """Raise InputError where all stops share nothing that is free."""
        if template.linkage.n_groups <= len(template.traverse.stops):
            raise InputError(
                f"method: expected joint with the model {template.model} as it is, found alternation: "
                "nothing is free that all stops share"
            )

    def _from_near(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> tuple[Problem, Outcome]:
        """Alternation, but for the search for outliers."""
        if stage != "solve":
            return super()._from_near(problem, rule, loss, stage)
        point = _Point(problem, loss)
        outcome, joint = _alternate(point, rule, stage, self.on_iteration)
        return self._ended(problem, outcome, point.system, point.rows, joint), outcome


class _Point:
    """Values of a problem on the way to its optimum, and the system there."""

    def __init__(self, problem: Problem, loss: Loss) -> None:
        self.template, self.factors, self.values = problem.template, problem.factors, problem.values
        self.system, self.rows = system_of(problem, loss)
        self.n_observations = int(problem.kept.sum())
        self.held = held_columns(self.template)
        self.held_columns = all_columns(self.template.linkage, self.held)
        """The same among all columns"""
        self.cost = self.system.cost_at(self.posture(self.values)) + self.factors.error(self.values)
        self.n_steps = 0
        """How many were taken to come here"""

    def posture(self, values: gtsam.Values) -> Posture:
        """Cameras at some values."""
        return self.template.posture(values)

    def panels(self) -> Panels:
        """The system here, landmarks eliminated, priors and ties included; the landmark system's own."""
        panels = self.system.linearise(self.posture(self.values))
        add_factors(panels, self.template.linkage, self.factors.linearize(self.values))
        return panels

    def moved(self, step: FloatArray) -> gtsam.Values:
        """Values after a step of all columns; what telemetry holds stays as it is, bit for bit."""
        step[self.held_columns] = 0.0
        return retracted(self.template.linkage, self.values, step)


@dataclass(kw_only=True)
class _Damping:
    """Nielsen's rule: the next damping follows from how well the last step kept its promise.

    Source: Nielsen, Damping parameter in Marquardt's method, 1999, as in SBA (thesis chapter 3); here it is a
    share of the diagonal, since radians, metres and pixels have no unit in common.
    """

    share: float = _FIRST
    growth: float = 2.0

    def relax(self, gain_ratio: float) -> None:
        """After a step that lowered the cost by so many times what it promised."""
        self.share = max(self.share * max(1 / 3, 1 - (2 * gain_ratio - 1) ** 3), _LEAST)
        self.growth = 2.0

    def tighten(self) -> None:
        """After one that did not lower it."""
        self.share *= self.growth
        self.growth *= 2


class _Set(ABC):
    """Parameters that move together while the others are held."""

    def __init__(self, point: _Point) -> None:
        self.point = point
        self.damping = _Damping()
        self.rests = False
        """Whether it is not tried, since it stalled"""
        self.stalled_at = -1
        """The point's number of steps where it stalled last"""

    @abstractmethod
    def linearise(self, panels: Panels | None) -> None:
        """Prepare for steps from here; `panels` are the system here, if it is at hand. Destroys them."""

    @abstractmethod
    def propose(self, damping: float) -> tuple[FloatArray, float]:
        """A step of all columns, and by how much it would lower the cost if that were quadratic."""

    @abstractmethod
    def cost_at(self, posture: Posture, step: FloatArray) -> float:
        """Cost of the landmarks where a step leads."""

    @abstractmethod
    def take(self) -> None:
        """Go where the last step led, with the landmarks."""

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
    """Landmarks, eliminated, and the variables of single stops."""

    def linearise(self, panels: Panels | None) -> None:
        """Hold what is shared."""
        link = self.point.template.linkage
        shared = link.n_groups - 1
        self._panels = panels or self.point.panels()
        self._panels.hold({**self.point.held, shared: np.arange(int(link.group_dim[shared]))})
        self._diagonal, self._right = self._panels.diagonal(), self._panels.right()

    def propose(self, damping: float) -> tuple[FloatArray, float]:
        """By the square root of the damped system; landmarks are not damped."""
        panels = self._panels.copy()
        panels.damp(damping)
        step = panels.root().step()
        promised = 0.5 * float(damping * step**2 @ self._diagonal - step @ self._right)
        return step, promised + self.point.system.gain_alone

    def cost_at(self, posture: Posture, step: FloatArray) -> float:
        """Landmarks follow."""
        return float(self.point.system.try_step(posture, step).sum())

    def take(self) -> None:
        """Landmarks go where they were led."""
        self.point.system.adopt()


class _Shared(_Set):
    """What all stops have in common."""

    def __init__(self, point: _Point) -> None:
        super().__init__(point)
        link = point.template.linkage
        self._group = link.n_groups - 1
        self._columns = slice(*link.group_column[self._group : self._group + 2].tolist())
        own = {key for key, group in zip(link.key, link.group, strict=True) if group == self._group}
        self._factors = graph_of(f for f in point.factors.all if not own.isdisjoint(f.keys()))
        """Factors on any of these variables"""
        self._is_seen = bool(link.touched[link.group == self._group].any())
        """Whether cameras hang on it; else ties alone do"""

    def linearise(self, panels: Panels | None) -> None:
        """Landmarks and all other variables are held."""
        point = self.point
        system, link = point.system, point.template.linkage
        if panels is None:
            panels = (
                system.linearise(point.posture(point.values)) if self._is_seen else Panels(system.structure)
            )
            add_factors(panels, link, self._factors.linearize(point.values))
        S, s = system.put_back(panels, self._group)
        # In units of each column's own information: pixels, radians and metres differ by much.
        unit = np.sqrt(np.diag(S))
        self._unit = np.where(unit > 0, unit, 1.0)
        self._S, self._s = S / np.outer(self._unit, self._unit), s / self._unit

    def propose(self, damping: float) -> tuple[FloatArray, float]:
        """By dense normal equations."""
        x = -np.linalg.solve(self._S + damping * np.eye(len(self._s)), self._s)
        step = np.zeros(int(self.point.template.linkage.group_column[-1]))
        step[self._columns] = x / self._unit
        return step, 0.5 * float(damping * x @ x - x @ self._s)

    def cost_at(self, posture: Posture, step: FloatArray) -> float:
        """Landmarks stay."""
        return self.point.system.cost_at(posture)

    def take(self) -> None:
        """Landmarks stay."""


def _alternate(
    point: _Point, rule: StopRule, stage: str, on_iteration: Callable[[Iteration], None] | None
) -> tuple[Outcome, Root]:
    """Both sets in turn until neither lowers the cost or the rule ends it; one round is one iteration.

    A set that stalls rests while the other goes on; it is tried again where that settles or stalls, too. The
    second result is the square root of the whole system where it ended.
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
            if joint.gain() + point.system.gain_alone <= rule.relative_decrease * costs[-1]:
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
    """Square root of the whole system, both sets together."""
    panels = panels.copy()
    panels.hold(point.held)
    return panels.root()


def _still_to_gain(costs: list[float]) -> float:
    """By how much further rounds would lower the cost if their gains shrink as the last one did.

    Alternation converges linearly, and slowly where the sets depend on each other.
    """
    gain = costs[-2] - costs[-1]
    if len(costs) < 3 or gain <= 0:
        return gain
    rate = min(gain / max(costs[-3] - costs[-2], 1e-300), _SLOWEST)
    return gain * rate / (1 - rate)
