"""When the iterations of a solve end."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from pancam_graph.base.errors import InputError

__all__ = ["StopRule", "criteria"]

_WHOLE = "max_iterations"


@dataclass(frozen=True, kw_only=True)
class StopRule:
    """The five criteria of Levenberg-Marquardt in bundle adjustment; the first that is met ends it.

    f is the cost: half the squares of all whitened residuals, priors and ties included. x are the variables
    of the graph: those of the cameras, and landmarks only where they are explicit. A criterion of 0 is not
    used. Whatever is used, it also ends where no step lowers the cost, however much it is damped.

    Source: thesis 3.8; Lourakis and Argyros, SBA, ACM Transactions on Mathematical Software 36, 2009. Theirs
    bounds the length of all residuals; here it is per observation, so that one number fits drives of all
    lengths. Their decrease is that of the last step; here it is what is still to come.

    Raises InputError naming the criterion for a negative number or one that is not finite.
    """

    max_iterations: int = 100
    """So many steps and no more; reaching it means not converged."""
    relative_decrease: float = 1e-7
    """Further steps would lower f by no more than this share: the last one did, or the linearised system says
    so of the next. Explicit landmarks: if the gains to come shrink as the last one did."""
    relative_step: float = 0.0
    """The last step was no longer than this share of x before it: |dx| <= relative_step |x|.

    Euclidean norms over all variables. Of a pose, dx is its tangent in the body frame (radians, metres), and
    x its rotation vector (radians) and translation (metres); of everything else the numbers themselves."""
    max_gradient: float = 0.0
    """No component of f's gradient is larger, per radian and per metre of tangents; held ones do not count.

    Where landmarks are eliminated it is that of f with each landmark at its best for the cameras, to first
    order: the right-hand side s of the reduced system, and priors and ties. The start is judged, too."""
    residual_sigmas: float = 1.4e-8
    """The RMS of whitened residuals, sqrt(2 f / observations), is no larger: nothing is left but rounding."""

    def __post_init__(self) -> None:
        """Check ranges."""
        limit = self.max_iterations
        if not isinstance(limit, int | np.integer) or limit < 1:
            raise InputError(f"{_WHOLE}: expected a whole number of 1 or more, found {limit}")
        for field in fields(StopRule):
            value = getattr(self, field.name)
            if not 0 <= value < np.inf:
                raise InputError(f"{field.name}: expected 0 (not used) or a positive number, found {value}")


def criteria(texts: Sequence[str]) -> dict[str, float]:
    """Criteria by name from texts NAME=NUMBER, as a command line has them.

    Raises InputError for another form or name, for a name that stands twice, and for what is no number.
    """
    names = [field.name for field in fields(StopRule)]
    found: dict[str, float] = {}
    for text in texts:
        name, equals, number = text.partition("=")
        if not equals or name not in names:
            raise InputError(f"stop: expected NAME=NUMBER with one of {', '.join(names)}; found {text!r}")
        if name in found:
            raise InputError(f"stop: {name}: expected each criterion once, found it twice")
        try:
            found[name] = int(number) if name == _WHOLE else float(number)
        except ValueError as error:
            kind = "a whole number" if name == _WHOLE else "a number"
            raise InputError(f"stop: {name}: expected {kind}, found {number!r}") from error
    return found
