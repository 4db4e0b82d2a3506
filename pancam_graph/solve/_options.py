"""Options of a solve."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.data import RigTreatment, Sharing
from pancam_graph.graph import DEFAULT_FLEX, Flex, Model, Tie
from pancam_graph.landmarks import LossName, loss_of
from pancam_graph.solve._stopping import StopRule

__all__ = ["Method", "SolveOptions"]

Method = Literal["joint", "alternation"]


@dataclass(frozen=True, kw_only=True)
class SolveOptions(StopRule):
    """Options of a solve, with the criteria that end its final least squares (StopRule).

    If noise is rescaled, several least-squares fits follow each other, and each may take `max_iterations`.
    """

    model: Model = "mast"
    landmarks: Literal["eliminated", "explicit"] = "eliminated"
    """Treatment of landmarks: "eliminated" from every linearisation, or "explicit" variables of the graph,
    which is slow and serves as a check."""
    method: Method = "joint"
    """Method of the final least squares: "joint" solves for everything at once; "alternation" solves in turn
    for quantities that stops share and for the others (the thesis's own way; it needs eliminated landmarks
    and a free quantity that stops share)."""
    loss: LossName = "huber"
    """Robust loss of the search for outliers; "none" skips the search and keeps all observations. The final
    estimate is always least squares over the kept observations."""
    tie: Tie | None = None
    """"hard": camera poses are computed from mast, pan and tilt (model "mast" only); "soft": they are
    variables that a sigma holds near there. Default: hard for "mast", soft for the others."""
    flex: Flex | None = None
    """Sigma of a soft tie; default: the model's own (graph.DEFAULT_FLEX)."""
    rig: RigTreatment = "estimated"
    """What becomes of the rig's uncertainty (`Rig.uncertainty`): "estimated": what images say of the rig's
    numbers is estimated, with these sigmas as priors; "held": the rig counts as exact; "considered": it is
    not moved, but its uncertainty is in every sigma of the solution (model "mast" only). A frame's flex is
    estimated with its pan and tilt where the rig is estimated or considered."""
    field: bool | None = None
    """Whether the final least squares also estimates a smooth distortion field of each eye, beside its lens
    (model "mast" with a hard tie); default: where the rig is estimated, no sharing is given, and this package
    measured the observations. Its prior is `RigUncertainty.field_px`."""
    sharing: Sharing | None = None
    """Free numbers of the rig, and images that share them, in place of those that `rig` makes free; default:
    the traverse's own."""
    normalise: bool = True
    """Whether the model "projective" uses conditioned matrices (thesis 5.2); False serves as a comparison,
    with the same optimum."""
    outlier_sigma: float = 4.0
    """Threshold for outliers: a residual is rejected if noise exceeds it as rarely as a Gaussian exceeds this
    many sigmas."""
    rescale_noise: bool | None = None
    """Whether residuals rescale the sigmas of observations; default: only for observations that this package
    measured, since their sigmas are guesses."""
    landmark_covariances: bool = False
    """Whether the solution has the covariance of each terrain point."""
    stereo_covariances: bool = False
    """Whether the solution has covariances of places that stereo pairs see (`Solution.stereo_covariance`)."""
    stretches: int = 1
    """In how many stretches of successive stops the drive is eliminated: landmarks of one are in memory at
    a time, those of the others on disk (in TMPDIR). The result is the same but for rounding. 1: all are in
    memory. More need a rigid mast with a hard tie, eliminated landmarks and the method joint."""

    def __post_init__(self) -> None:
        """Check the choices."""
        super().__post_init__()
        loss_of(self.loss)
        for name, value, choices in (
            ("model", self.model, tuple(DEFAULT_FLEX)),
            ("landmarks", self.landmarks, ("eliminated", "explicit")),
            ("method", self.method, get_args(Method)),
            ("tie", self.tie or "soft", ("hard", "soft")),
            ("rig", self.rig, get_args(RigTreatment)),
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
        if self.rig == "considered" and self.model != "mast":
            raise InputError(
                f"rig: expected estimated or held with the model {self.model}, found considered: only the "
                "cameras of the model mast hang on the rig alone"
            )
        if self.flex is not None and self.firm_tie == "hard":
            raise InputError("flex: expected none with a hard tie, which has no sigma")
        if self.field and not self.takes_field:
            raise InputError(
                "field: expected none but with the model mast, a hard tie, eliminated landmarks, the joint "
                "method and a rig that is not considered"
            )
        if not isinstance(self.stretches, int | np.integer) or self.stretches < 1:
            raise InputError(f"stretches: expected a whole number of 1 or more, found {self.stretches}")
        if self.stretches > 1 and not self.is_usual:
            raise InputError(
                "stretches: expected 1 but with the model mast, a hard tie, eliminated landmarks and the "
                f"joint method; found {self.stretches}"
            )
        if not self.outlier_sigma > 0:
            raise InputError(f"outlier_sigma: expected a number above 0, found {self.outlier_sigma}")

    @property
    def firm_tie(self) -> Tie:
        """The tie that is used: the given one, or the model's own."""
        return self.tie or ("hard" if self.model == "mast" else "soft")

    @property
    def takes_field(self) -> bool:
        """Whether such a solve can estimate smooth distortion fields."""
        return self.is_usual and self.rig != "considered"

    @property
    def is_usual(self) -> bool:
        """Whether landmarks are eliminated from the rigid mast, and all else is adjusted jointly."""
        usual = (self.model, self.landmarks, self.method) == ("mast", "eliminated", "joint")
        return usual and self.firm_tie == "hard"

    @property
    def firm_flex(self) -> Flex:
        """The flex that is used for a soft tie: the given one, or the model's own."""
        return self.flex or DEFAULT_FLEX[self.model]
