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
from pancam_graph.solve._stopping import StopRule

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
"""No step is sought with more."""
_INDETERMINATE = "ndeterminate"
"""Part of GTSAM's message for a system without a unique solution."""
_FAR = 100.0
"""While gains shrink and will end this many times above the limit, the next gain need not be worked out."""


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """What a progress display may show."""

    stage: str
    """"screening" while outliers are sought, "approach" from afar, "solve" for the final least squares."""
    number: int
    cost: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """Where the iterations ended."""

    values: gtsam.Values
    converged: bool
    reason: str
    costs: tuple[float, ...]
    """After each iteration, the start first."""


class Optimiser(Protocol):
    """GTSAM's Levenberg-Marquardt on the variables of some graph."""

    def iterate(self) -> None:
        """Take the next step that lowers the cost."""

    def error(self) -> float:
        """The cost where it stands."""

    def damping(self) -> float:
        """Lambda of the next step."""

    def values(self) -> gtsam.Values:
        """Where it stands; gone once it has moved on."""

    def gradient(self) -> float:
        """Largest component of the gradient there, but for what telemetry holds."""


class OnGraph:
    """Optimises the variables of a graph as they are."""

    def __init__(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        parameters: gtsam.LevenbergMarquardtParams,
        held: Mapping[int, IntArray],
    ) -> None:
        """`held` are, by key, tangent components that the graph's factors hold."""
        self._graph, self._held = graph, held
        self._optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)

    def iterate(self) -> None:
        """Take the next step that lowers the cost."""
        self._optimizer.iterate()

    def error(self) -> float:
        """The cost where it stands."""
        return float(self._optimizer.error())

    def damping(self) -> float:
        """Lambda of the next step."""
        return float(self._optimizer.lambda_())

    def values(self) -> gtsam.Values:
        """Where it stands; gone once it has moved on."""
        return self._optimizer.values()

    def gradient(self) -> float:
        """Landmark blocks linearise here as they would in the next step, and not again then.

        What this costs is handing their rows over a second time.
        """
        values = self.values()
        gradient = self._graph.linearize(values).gradientAtZero()
        largest = 0.0
        for key in values.keys():  # noqa: SIM118  gtsam.Values is not a dictionary
            free = np.delete(gradient.at(key), self._held.get(key, []))
            largest = max(largest, float(np.abs(free).max(initial=0.0)))
        return largest


def parameters_of(rule: StopRule, elimination: "Elimination | InOrder") -> gtsam.LevenbergMarquardtParams:
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
) -> Outcome:
    """Iterate until a rule says so. `start` makes the optimiser, with `parameters_of` the rule.

    `gain_ahead` may tell by how much the next step from some values would lower the cost; None: not known,
    and judged by the gains so far.

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
            # A copy: what the optimiser shows is gone once it has moved on.
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
            elif rule.relative_decrease and _is_settled(costs, rule.relative_decrease, gain_ahead, optimiser):
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
    """Whether a step is no longer than a share of the parameters before it, if given; see StopRule."""
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
) -> bool:
    """Whether the iterations to come would lower the cost by no more than a share of it.

    Gains that shrink may do so because a landmark is stuck, which a later step sets free. So where the gain
    of the next step can be told, it must be small too. It is no work lost: covariances want that system.
    """
    least = share * costs[-1]
    gain, shrinking = _still_to_gain(costs)
    if gain_ahead is None or costs[-2] - costs[-1] <= least:
        return gain <= least
    if shrinking and gain > _FAR * least:
        return False
    ahead = gain_ahead(optimiser.values())
    return ahead is not None and ahead <= least


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
    range of a far landmark, or a camera pose that a tight tie holds once its angles are eliminated. So all
    variables but cameras and landmarks come last. QR bears more, and is three times slower.
    """

    def __init__(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, *, by_qr: bool = False
    ) -> None:
        first = {Kind.CAMERA, Kind.LANDMARK}
        last = [key for key in values.keys() if kind_of(key) not in first]  # noqa: SIM118  gtsam.Values
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
