"""GTSAM's Levenberg-Marquardt, iteration by iteration, with a reason for stopping."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam

from pancam_graph.errors import SolveError

__all__ = ["Elimination", "InOrder", "Iteration", "Outcome", "StopRule", "optimise"]

_LOG = logging.getLogger(__name__)
_INDETERMINATE = "ndeterminate"
"""Part of GTSAM's message for a system without a unique solution."""
_FAR = 100.0
"""Gains that shrink, and will end so many times above the limit, need no closer look at the one ahead."""


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """What a progress display may show."""

    stage: str
    """"screening" while outliers are sought, "approach" from afar, "solve" for the final least squares."""
    number: int
    cost: float


@dataclass(frozen=True, kw_only=True)
class StopRule:
    """When to stop (thesis 3.8)."""

    max_iterations: int
    relative_decrease: float
    """The iterations end where those to come would lower the cost by less than this share of it."""
    absolute_cost: float = 0.0
    """A cost below this is as good as none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """Where the iterations ended."""

    values: gtsam.Values
    converged: bool
    reason: str
    costs: tuple[float, ...]
    """After each iteration, the start first."""


def optimise(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    rule: StopRule,
    elimination: "Elimination | InOrder",
    *,
    stage: str = "solve",
    on_iteration: Callable[[Iteration], None] | None = None,
    gain_ahead: Callable[[gtsam.Values], float | None] | None = None,
) -> Outcome:
    """Minimise the graph's error from the given values.

    `gain_ahead` may tell by how much the next step from some values would lower the cost; None: not known.
    Without it, that is judged by the gains so far.

    Raises SolveError where the linear system cannot be factorised however much it is damped; an exception
    from inside a custom factor reaches the caller as it is.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaUpperBound(1e10)
    elimination.set_up(parameters)
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        costs = [optimizer.error()]
        converged, reason = False, f"iteration limit of {rule.max_iterations}"
        for number in range(1, rule.max_iterations + 1):
            if costs[-1] <= rule.absolute_cost:
                converged, reason = True, "residuals vanish"
                break
            optimizer.iterate()
            costs.append(optimizer.error())
            _LOG.debug("iteration %d: cost %.9g, lambda %.1e", number, costs[-1], optimizer.lambda_())
            if on_iteration is not None:
                on_iteration(Iteration(stage=stage, number=number, cost=costs[-1]))
            if optimizer.lambda_() >= parameters.getlambdaUpperBound():
                converged, reason = True, "no step lowers the cost"
                break
            least = rule.relative_decrease * costs[-1]
            gain, shrinking = _still_to_gain(costs)
            if gain_ahead is not None and gain > least and not (shrinking and gain > _FAR * least):
                ahead = gain_ahead(optimizer.values())
                gain = gain if ahead is None else ahead
            if gain <= least:
                converged, reason = True, f"relative decrease below {rule.relative_decrease:g}"
                break
    except RuntimeError as error:
        raise _explained(error) from error
    return Outcome(values=optimizer.values(), converged=converged, reason=reason, costs=tuple(costs))


def _still_to_gain(costs: list[float]) -> tuple[float, bool]:
    """By how much further iterations would lower the cost, if their gains shrink as the last one did.

    Gauss-Newton converges linearly where residuals are not zero, so gains shrink geometrically. Where the
    last gain did not shrink (the second value), or there is but one, it stands for all to come.
    """
    gain = costs[-2] - costs[-1]
    if len(costs) < 3 or gain <= 0:
        return max(gain, 0.0), False
    rate = gain / max(costs[-3] - costs[-2], 1e-300)
    return (gain * rate / (1 - rate), True) if rate < 0.1 else (gain, False)


class InOrder:
    """Cholesky in a given order of elimination."""

    def __init__(self, keys: Sequence[int]) -> None:
        self.ordering = gtsam.Ordering()
        for key in keys:
            self.ordering.push_back(key)

    def set_up(self, parameters: gtsam.NonlinearOptimizerParams) -> None:
        """Make an optimiser use it."""
        parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
        parameters.setOrdering(self.ordering)


class Elimination:
    """Factorisation and order of elimination for graphs of one structure.

    GTSAM's Cholesky refuses a variable of which one direction is known 4096 times better than another: the
    range of a far landmark, or a camera pose that a tight tie holds once its angles are eliminated. So angles
    and masts come last; and QR, three times slower, minds less.
    """

    def __init__(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, *, by_qr: bool = False
    ) -> None:
        last = [key for key in values.keys() if chr(gtsam.symbolChr(key)) in "AMR"]  # noqa: SIM118  gtsam.Values
        self.ordering = gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, last, False)
        self.by_qr = by_qr

    def set_up(self, parameters: gtsam.NonlinearOptimizerParams) -> None:
        """Make an optimiser use it."""
        parameters.setLinearSolverType("MULTIFRONTAL_QR" if self.by_qr else "MULTIFRONTAL_CHOLESKY")
        parameters.setOrdering(self.ordering)

    def step(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.VectorValues:
        """The Gauss-Newton step of the graph at the values; by QR from where Cholesky first fails.

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
    """GTSAM's word that a system is indeterminate, as our own; any other exception as it is."""
    text = str(error).strip().replace("\n", " ")
    if _INDETERMINATE not in text:
        return error
    return SolveError(f"nothing holds a direction of the solution: {text.split('.')[0]}")
