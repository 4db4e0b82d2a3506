"""GTSAM's Levenberg-Marquardt, iteration by iteration, with a reason for stopping."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import IntArray
from pancam_graph.graph import Kind, kind_of, read_variable
from pancam_graph.solve._stopping import StopRule, sigmas_left

__all__ = [
    "MOST_DAMPING",
    "Elimination",
    "InOrder",
    "Iteration",
    "OnGraph",
    "Optimiser",
    "Outcome",
    "is_short",
    "optimise",
    "parameters_of",
]

_LOG = logging.getLogger(__name__)
MOST_DAMPING = 1e10
"""Largest damping (lambda) tried for a step."""
_INDETERMINATE = "ndeterminate"
"""Part of GTSAM's message for a system without a unique solution."""
_ROUNDING = 1e-13
"""Share of the cost below which a gain is rounding."""
_FAR = 100.0
"""While the expected remaining gain exceeds the limit this many times, the next gain is not computed."""


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """State of an iteration, for progress displays."""

    stage: str
    """"screening" while outliers are sought, "approach" from afar, "solve" for the final least squares."""
    number: int
    """Number of the iteration in its stage, from 1."""
    cost: float
    """Cost after the iteration."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """Result of the iterations."""

    values: gtsam.Values
    """Values of the variables after the last iteration."""
    converged: bool
    """Whether a rule of convergence ended the iterations."""
    reason: str
    """Why they ended, in words."""
    costs: tuple[float, ...]
    """Cost after each iteration, preceded by the initial cost."""


class Optimiser(Protocol):
    """GTSAM's Levenberg-Marquardt on the variables of some graph."""

    def iterate(self) -> None:
        """Take the next step that lowers the cost."""

    def error(self) -> float:
        """Cost at the current values."""

    def damping(self) -> float:
        """Damping (lambda) of the next step."""

    def values(self) -> gtsam.Values:
        """Current values, valid until the next iteration."""

    def gradient(self) -> float:
        """Largest component of the gradient at the current values, except held ones."""


class OnGraph:
    """Optimises the variables of a graph as they are; by QR once Cholesky has failed without need."""

    def __init__(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        rule: StopRule,
        elimination: "InOrder",
        held: Mapping[int, IntArray],
    ) -> None:
        """`held` are tangent components, by key, that constraints of the graph hold."""
        self._graph, self._held, self._rule, self._elimination = graph, held, rule, elimination
        self._optimizer = self._begun(values)

    def _begun(self, values: gtsam.Values) -> gtsam.LevenbergMarquardtOptimizer:
        parameters = parameters_of(self._rule, self._elimination)
        return gtsam.LevenbergMarquardtOptimizer(self._graph, values, parameters)

    def iterate(self) -> None:
        """Take the next step that lowers the cost.

        Where Cholesky fails, GTSAM raises the damping until it does not. Steps of a system that is determined
        but unevenly scaled would then be far too short.
        """
        before, damping = gtsam.Values(self.values()), self.damping()
        self._optimizer.iterate()
        if self.damping() > damping and self._elimination.turns_to_qr(self._graph, before, damping):
            self._optimizer = self._begun(before)
            self._optimizer.iterate()

    def error(self) -> float:
        """Cost at the current values."""
        return float(self._optimizer.error())

    def damping(self) -> float:
        """Damping (lambda) of the next step."""
        return float(self._optimizer.lambda_())

    def values(self) -> gtsam.Values:
        """Current values, valid until the next iteration."""
        return self._optimizer.values()

    def gradient(self) -> float:
        """Largest component of the gradient at the current values, except held ones.

        Landmark blocks linearise for it, and the next step uses that linearisation again.
        """
        values = self.values()
        gradient = self._graph.linearize(values).gradientAtZero()
        largest = 0.0
        for key in values.keys():  # noqa: SIM118  gtsam.Values is not a dictionary
            free = np.delete(gradient.at(key), self._held.get(key, []))
            largest = max(largest, float(np.abs(free).max(initial=0.0)))
        return largest


def parameters_of(rule: StopRule, elimination: "InOrder") -> gtsam.LevenbergMarquardtParams:
    """GTSAM's options for a rule and an order of elimination."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaUpperBound(MOST_DAMPING)
    # A step that raises the cost by less than this share ends GTSAM's search for one that lowers it.
    parameters.setRelativeErrorTol(min(parameters.getRelativeErrorTol(), rule.relative_decrease))
    elimination.set_up(parameters)
    return parameters


def optimise(
    start: Callable[[], Optimiser],
    rule: StopRule,
    *,
    n_observations: int,
    stage: str = "solve",
    on_iteration: Callable[[Iteration], None] | None = None,
    gain_ahead: Callable[[gtsam.Values], float | None] | None = None,
    left_sigmas: float = np.inf,
) -> Outcome:
    """Iterate until the rule ends it. `start` makes the optimiser, with `parameters_of` the rule.

    `gain_ahead` gives the decrease of cost that the next step from some values promises; None: unknown, and
    extrapolated from the gains so far. `left_sigmas` is the largest distance to the optimum with which a
    small decrease ends the iterations, as long as steps gain more than rounding.

    Raises SolveError where the linear system cannot be factorised however much it is damped; an exception
    from inside a custom factor reaches the caller as it is.
    """
    no_cost = n_observations * rule.residual_sigmas**2 / 2
    try:
        optimiser = start()
        costs = [optimiser.error()]

        def vanished() -> str | None:
            if rule.residual_sigmas and costs[-1] <= no_cost:
                return f"residuals below {rule.residual_sigmas:g} sigma"
            if rule.max_gradient and optimiser.gradient() <= rule.max_gradient:
                return f"gradient below {rule.max_gradient:g}"
            return None

        reason = vanished()
        while reason is None and len(costs) <= rule.max_iterations:
            # A copy, since the optimiser's values are valid until the next iteration only.
            before = gtsam.Values(optimiser.values()) if rule.relative_step else None
            optimiser.iterate()
            costs.append(optimiser.error())
            number = len(costs) - 1
            _LOG.debug("iteration %d: cost %.9g, lambda %.1e", number, costs[-1], optimiser.damping())
            if on_iteration is not None:
                on_iteration(Iteration(stage=stage, number=number, cost=costs[-1]))
            if optimiser.damping() >= MOST_DAMPING:
                reason = "no step lowers the cost"
            elif costs[-1] < costs[-2] and is_short(before, optimiser.values(), rule.relative_step):
                reason = f"relative step below {rule.relative_step:g}"
            elif rule.relative_decrease and _is_settled(
                costs, rule.relative_decrease, gain_ahead, optimiser, left_sigmas
            ):
                reason = f"relative decrease below {rule.relative_decrease:g}"
            else:
                reason = vanished()
    except RuntimeError as error:
        raise _explained(error) from error
    return Outcome(
        values=optimiser.values(),
        converged=reason is not None,
        reason=reason or f"iteration limit of {rule.max_iterations}",
        costs=tuple(costs),
    )


def is_short(before: gtsam.Values | None, after: gtsam.Values, share: float) -> bool:
    """Whether a step is at most a share of the norm of the parameters `before`, if given; see StopRule."""
    if before is None:
        return False
    length2 = 0.0
    for key in before.keys():  # noqa: SIM118  gtsam.Values is not a dictionary
        value = read_variable(before, key)
        if isinstance(value, gtsam.Pose3):
            value = [*gtsam.Rot3.Logmap(value.rotation()), *value.translation()]
        length2 += float(np.sum(np.square(value)))
    return bool(before.localCoordinates(after).norm() <= share * np.sqrt(length2))


def _is_settled(
    costs: list[float],
    share: float,
    gain_ahead: Callable[[gtsam.Values], float | None] | None,
    optimiser: Optimiser,
    left_sigmas: float = np.inf,
) -> bool:
    """Whether all further iterations would lower the cost by at most a share of it, and be short.

    Gains may shrink because a landmark is stuck, which a later step frees. So the gain of the next step,
    where it can be computed, must be small too; covariances need the same linearised system.
    """
    least = share * costs[-1]
    gain, shrinking = _still_to_gain(costs)
    if gain_ahead is None or costs[-2] - costs[-1] <= least:
        if gain > least:
            return False
        if np.isinf(left_sigmas) or costs[-2] - costs[-1] <= _ROUNDING * costs[-1]:
            return True
        ahead = None if gain_ahead is None else gain_ahead(optimiser.values())
        return sigmas_left(costs, ahead) <= left_sigmas
    if shrinking and gain > _FAR * least:
        return False
    ahead = gain_ahead(optimiser.values())
    return ahead is not None and ahead <= least and sigmas_left(costs, ahead) <= left_sigmas


def _still_to_gain(costs: list[float]) -> tuple[float, bool]:
    """Expected decrease of cost by further iterations, with gains that shrink as the last one did.

    Gauss-Newton converges linearly where residuals are not zero, so gains shrink geometrically. A last gain
    that did not shrink (the second value is False), or the only one, is returned itself.
    """
    gain = costs[-2] - costs[-1]
    if len(costs) < 3 or gain <= 0:
        return max(gain, 0.0), False
    rate = gain / max(costs[-3] - costs[-2], 1e-300)
    return (gain * rate / (1 - rate), True) if rate < 0.1 else (gain, False)


class InOrder:
    """Factorisation in a given order of elimination: Cholesky, or QR where that fails.

    GTSAM's Cholesky fails on a variable of which one direction is known 4096 times better than another. QR is
    more robust, but three times slower.
    """

    def __init__(self, keys: Sequence[int]) -> None:
        self.ordering = gtsam.Ordering()
        for key in keys:
            self.ordering.push_back(key)
        self.by_qr = False

    def set_up(self, parameters: gtsam.NonlinearOptimizerParams) -> None:
        """Set the parameters of an optimiser to use it."""
        parameters.setLinearSolverType("MULTIFRONTAL_QR" if self.by_qr else "MULTIFRONTAL_CHOLESKY")
        parameters.setOrdering(self.ordering)

    def turns_to_qr(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, damping: float) -> bool:
        """Whether it turns from Cholesky to QR, since Cholesky fails at the values with this damping."""
        if self.by_qr:
            return False
        linear, zero = graph.linearize(values), values.zeroVectors()
        for key in values.keys():  # noqa: SIM118  gtsam.Values is not a dictionary
            n = len(zero.at(key))
            unit = gtsam.noiseModel.Unit.Create(n)
            linear.push_back(gtsam.JacobianFactor(key, np.sqrt(damping) * np.eye(n), np.zeros(n), unit))
        try:
            linear.optimize(self.ordering)
        except RuntimeError as error:
            if _INDETERMINATE not in str(error):
                raise
            self.by_qr = True
        return self.by_qr


class Elimination(InOrder):
    """Factorisation and order of elimination for graphs of one structure.

    GTSAM's Cholesky would fail on a far landmark with its range, or on a camera pose under a tight tie once
    its angles are eliminated. So all variables except cameras and landmarks are eliminated last.
    """

    def __init__(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, *, by_qr: bool = False
    ) -> None:
        first = {Kind.CAMERA, Kind.LANDMARK}
        last = [key for key in values.keys() if kind_of(key) not in first]  # noqa: SIM118  gtsam.Values
        self.ordering = gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, last, False)
        self.by_qr = by_qr

    def step(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.VectorValues:
        """The Gauss-Newton step of the graph at the values; by QR once Cholesky has failed.

        Raises SolveError where the step is not determined.
        """
        parameters = gtsam.GaussNewtonParams()
        self.set_up(parameters)
        try:
            optimizer = gtsam.GaussNewtonOptimizer(graph, values, parameters)
            optimizer.iterate()
        except RuntimeError as error:
            if self.by_qr or _INDETERMINATE not in str(error):
                raise _explained(error) from error
            self.by_qr = True
            return self.step(graph, values)
        return values.localCoordinates(optimizer.values())


def _explained(error: RuntimeError) -> Exception:
    """A SolveError for GTSAM's message of an indeterminate system; any other exception itself."""
    text = str(error).strip().replace("\n", " ")
    if _INDETERMINATE not in text:
        return error
    return SolveError(f"nothing holds a direction of the solution: {text.split('.')[0]}")
