"""Criteria that end the iterations of a solve."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from pancam_graph.base.errors import InputError

__all__ = ["LEFT_SIGMAS", "StopRule", "criteria", "sigmas_left"]

LEFT_SIGMAS = 0.1
"""Largest distance to the optimum, in sigmas of the solution, with which a small decrease ends a fit."""
_SLOWEST = 0.999
"""Largest ratio of successive gains assumed in extrapolation."""

_WHOLE = "max_iterations"


@dataclass(frozen=True, kw_only=True)
class StopRule:
    """Five criteria of Levenberg-Marquardt in bundle adjustment; the first one met ends it.

    The cost f is half the sum of squares of all whitened residuals, priors and ties included. The vector x
    holds the variables of the graph: those of the cameras, and landmarks only if they are explicit. A
    criterion of 0 is not used. Iterations also end if no step lowers the cost, however much it is damped.

    Source: thesis 3.8; Lourakis and Argyros, SBA, ACM Transactions on Mathematical Software 36, 2009. SBA
    bounds the length of all residuals together; here the bound is per observation, so that one number fits
    drives of all lengths. SBA judges the decrease of the last step; here the decrease still to come counts.

    Raises InputError naming the criterion for a negative number or one that is not finite.
    """

    max_iterations: int = 100
    """Largest number of steps; a solve that reaches it has not converged."""
    relative_decrease: float = 1e-7
    """Largest share of f that further steps may still gain: the last step gained no more, or the linearised
    system predicts no more of the next. With explicit landmarks, gains are extrapolated from the last two.
    What is left must also be less than 0.1 sigma of the solution: of a large f, a small share is many."""
    relative_step: float = 0.0
    """Largest length of the last step relative to x before it: |dx| <= relative_step |x|.

    Euclidean norms over all variables. Of a pose, dx is its tangent in the body frame (radians, metres), and
    x its rotation vector (radians) and translation (metres); of everything else the numbers themselves."""
    max_gradient: float = 0.0
    """Largest component of the gradient of f by tangents, per radian and per metre, without held components.

    With eliminated landmarks it is the gradient of f with each landmark at its best place for the cameras, to
    first order: the right-hand side s of the reduced system, plus priors and ties. The start is judged
    too."""
    residual_sigmas: float = 1.4e-8
    """Largest RMS of whitened residuals, sqrt(2 f / observations), at which only rounding is left."""

    def __post_init__(self) -> None:
        """Check ranges."""
        limit = self.max_iterations
        if not isinstance(limit, int | np.integer) or limit < 1:
            raise InputError(f"{_WHOLE}: expected a whole number of 1 or more, found {limit}")
        for field in fields(StopRule):
            value = getattr(self, field.name)
            if not 0 <= value < np.inf:
                raise InputError(f"{field.name}: expected 0 (not used) or a positive number, found {value}")


def sigmas_left(costs: Sequence[float], ahead: float | None) -> float:
    """Distance to the optimum, in the metric of the information: no number is further off in its sigmas.

    `costs` are those of the iterations; `ahead` is the gain that the linearised system predicts of the next
    step, or None where it is unknown. A step that gains g is sqrt(2 g) sigmas long. Gains of a slow crawl
    shrink by a constant factor, and all steps that are to come add up.
    """
    gains = -np.diff(costs[-3:])
    crawls = len(gains) == 2 and 0 < gains[1] < gains[0]
    rate = min(float(gains[1] / gains[0]), _SLOWEST) if crawls else 0.0
    if ahead is None:
        last = float(gains[-1]) if len(gains) else np.inf
        ahead = last * rate if crawls else max(last, 0.0)
    elif crawls and ahead > gains[1]:
        rate = 0.0
    return float(np.sqrt(2 * ahead) / (1 - np.sqrt(rate)))


def criteria(texts: Sequence[str]) -> dict[str, float]:
    """Criteria by name from texts NAME=NUMBER of a command line.

    Raises InputError for another form, an unknown name, a repeated name, and a value that is not a number.
    """
    names = [field.name for field in fields(StopRule)]
    numbers: dict[str, float] = {}
    for text in texts:
        name, equals, number = text.partition("=")
        if not equals or name not in names:
            raise InputError(f"stop: expected NAME=NUMBER with one of {', '.join(names)}; found {text!r}")
        if name in numbers:
            raise InputError(f"stop: {name}: expected each criterion once, found it twice")
        try:
            numbers[name] = int(number) if name == _WHOLE else float(number)
        except ValueError as error:
            kind = "a whole number" if name == _WHOLE else "a number"
            raise InputError(f"stop: {name}: expected {kind}, found {number!r}") from error
    return numbers
