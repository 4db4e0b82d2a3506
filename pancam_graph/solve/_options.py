"""How to solve."""

from dataclasses import dataclass
from typing import Literal, get_args

from pancam_graph.base.errors import InputError
from pancam_graph.data import Sharing
from pancam_graph.graph import DEFAULT_FLEX, Flex, Model, Tie
from pancam_graph.landmarks import LossName, loss_of
from pancam_graph.solve._stopping import StopRule

__all__ = ["Method", "SolveOptions"]

Method = Literal["joint", "alternation"]


@dataclass(frozen=True, kw_only=True)
class SolveOptions(StopRule):
    """How to solve, and when the final least squares ends (see StopRule).

    Where noise is rescaled or pixels are carried anew, a few such least squares follow each other, each with
    the whole number of iterations.
    """

    model: Model = "mast"
    landmarks: Literal["eliminated", "explicit"] = "eliminated"
    """How landmarks are treated: eliminated from every linearisation, or as variables of the graph, which is
    slow and serves for checking."""
    method: Method = "joint"
    """How the final least squares is solved: all at once, or what stops share and what they do not in turn
    (the thesis's own way; it needs eliminated landmarks and something shared that is free)."""
    loss: LossName = "huber"
    """Robust loss while outliers are sought. The final estimate is always least squares over the
    observations that were kept; "none" keeps all of them."""
    tie: Tie | None = None
    """"hard": camera poses are computed from mast, pan and tilt (model "mast" only); "soft": they are
    variables that a sigma holds near there. Default: hard for "mast", soft for the others."""
    flex: Flex | None = None
    """That sigma; default: the model's own (graph.DEFAULT_FLEX)."""
    sharing: Sharing | None = None
    """What of the rig is free, and who shares it; default: what the traverse says, or else nothing but the
    radii of the model "circle"."""
    normalise: bool = True
    """Whether model `projective` works on conditioned matrices (thesis 5.2). Without, on those of pixels and
    metres, to compare: the optimum is the same."""
    outlier_sigma: float = 4.0
    """An observation goes where noise would take it less often than a Gaussian beyond this many sigmas."""
    rescale_noise: bool | None = None
    """Whether observation sigmas are multiplied by what residuals say; default: where this package measured
    the observations itself and their sigmas are guesses."""
    landmark_covariances: bool = False
    """Whether the solution gets the covariance of each terrain point."""

    def __post_init__(self) -> None:
        """Check the choices."""
        super().__post_init__()
        loss_of(self.loss)
        for name, value, choices in (
            ("model", self.model, tuple(DEFAULT_FLEX)),
            ("landmarks", self.landmarks, ("eliminated", "explicit")),
            ("method", self.method, get_args(Method)),
            ("tie", self.tie or "soft", ("hard", "soft")),
        ):
            if value not in choices:
                raise InputError(f"{name}: expected one of {', '.join(choices)}; found {value!r}")
        if self.method == "alternation" and self.landmarks == "explicit":
            raise InputError("method: expected joint with explicit landmarks, found alternation")
        if self.tie == "hard" and self.model != "mast":
            raise InputError(
                f"tie: expected soft for the model {self.model}, found hard: its cameras are variables"
            )
        if self.model == "projective" and self.landmarks == "explicit":
            raise InputError(
                "landmarks: expected eliminated for the model projective, found explicit: GTSAM has no "
                "projection factor for matrices"
            )
        if not self.normalise and self.model != "projective":
            raise InputError(
                f"normalise: expected True for the model {self.model}, whose variables need no conditioning"
            )
        if self.sharing is not None:
            self.sharing.for_model(self.model)
        if self.flex is not None and self.firm_tie == "hard":
            raise InputError("flex: expected none with a hard tie, which has no sigma")
        if not self.outlier_sigma > 0:
            raise InputError(f"outlier_sigma: expected a number above 0, found {self.outlier_sigma}")

    @property
    def firm_tie(self) -> Tie:
        """The tie, the model's own where none was asked for."""
        return self.tie or ("hard" if self.model == "mast" else "soft")

    @property
    def firm_flex(self) -> Flex:
        """The flex of a soft tie."""
        return self.flex or DEFAULT_FLEX[self.model]
