"""How to solve."""

from dataclasses import dataclass
from typing import Literal

from pancam_graph.errors import InputError
from pancam_graph.graph import DEFAULT_TIES, Model, Tie
from pancam_graph.losses import LossName, loss_of

__all__ = ["SolveOptions"]


@dataclass(frozen=True, kw_only=True)
class SolveOptions:
    """How to solve."""

    model: Model = "mast"
    landmarks: Literal["explicit"] = "explicit"
    """How landmarks are treated: as variables of the graph."""
    loss: LossName = "huber"
    """Robust loss while outliers are sought. The final estimate is always least squares over the
    observations that were kept; "none" keeps all of them."""
    tie: Tie | None = None
    """How firmly camera poses are tied to the mast; default: the model's own (graph.DEFAULT_TIES)."""
    outlier_sigma: float = 4.0
    """An observation goes where noise would take it less often than a Gaussian beyond this many sigmas."""
    rescale_noise: bool | None = None
    """Whether observation sigmas are multiplied by what residuals say; default: where this package measured
    the observations itself and their sigmas are guesses."""
    max_iterations: int = 100
    """Of the final least squares; reaching it means not converged."""
    relative_decrease: float = 1e-7
    """The final least squares stops where an iteration lowers the cost by a smaller share."""

    def __post_init__(self) -> None:
        """Check the choices."""
        loss_of(self.loss)
        for name, value, choices in (
            ("model", self.model, tuple(DEFAULT_TIES)),
            ("landmarks", self.landmarks, ("explicit",)),
        ):
            if value not in choices:
                raise InputError(f"{name}: expected one of {', '.join(choices)}; found {value!r}")
        if self.max_iterations < 1:
            raise InputError(f"max_iterations: expected 1 or more, found {self.max_iterations}")
        if not self.outlier_sigma > 0:
            raise InputError(f"outlier_sigma: expected a number above 0, found {self.outlier_sigma}")
