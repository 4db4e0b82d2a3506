"""What a solve makes of a rig's uncertainty."""

from collections.abc import Mapping
from typing import Literal

from pancam_graph.data._sharing import ENTRIES, FIXED, Freedom, Quantity, Scope, Sharing
from pancam_graph.rigs import RIG_ENTRIES, Rig, RigUncertainty

__all__ = ["RigTreatment", "field_within", "sharing_for", "sharing_within"]

RigTreatment = Literal["estimated", "held", "considered"]
"""What becomes of a rig's uncertainty: "estimated": it is the prior of what is estimated; "held": the rig
counts as exact; "considered": the rig is not moved, but its uncertainty is in every sigma. A frame's flex is
no number of the rig: it is estimated with the frame's pan and tilt, unless the rig is held."""

_SCOPE: Mapping[Quantity, Scope] = {"pan_T_tilt": "all", "flex": "frame", "encoders": "all"}
"""Who shares a correction, where it is not the images of an eye."""


def sharing_within(uncertainty: RigUncertainty, model: str) -> Sharing:
    """All numbers of a rig that a model has, free about their values with the rig's own uncertainty.

    Fields of eyes are not among them (`field_within`). An entry whose sigma is 0 is held. The model
    `projective` has no number of the rig.
    """
    u, mast = uncertainty, model == "mast"
    shifts = dict.fromkeys(ENTRIES["flex"][1:], u.flex_m)
    scales = {"pan_scale": u.pan_scale, "tilt_scale": u.tilt_scale}
    return Sharing(
        encoders=_freedom("encoders", scales) if mast else FIXED,
        flex=_freedom("flex", {"twist_rad": u.flex_rad} | shifts) if mast else FIXED,
        calibration=FIXED if model == "projective" else _of_rig("calibration", u),
        mounts=_of_rig("mounts", u) if mast else FIXED,
        pan_T_tilt=_of_rig("pan_T_tilt", u) if mast else FIXED,
        covariance=u.covariance,
    )


def field_within(uncertainty: RigUncertainty) -> Freedom:
    """The freedom of the smooth distortion field of each eye, with the rig's own uncertainty."""
    return _freedom("field", {"field_px": uncertainty.field_px})


def sharing_for(rig: Rig, model: str, treatment: RigTreatment, given: Sharing | None) -> Sharing:
    """The sharing of a solve, as `Sharing.for_model` returns it.

    What is `given` counts; where nothing is, an estimated rig has `sharing_within`, one that is considered
    the flex of that alone, and a held one is fixed. Raises InputError as `Sharing.for_model` does.
    """
    if given is None and treatment != "held":
        within = sharing_within(rig.uncertainty, model)
        given = within if treatment == "estimated" else Sharing(flex=within.flex)
    return (given or Sharing()).for_model(model)


def _of_rig(quantity: Quantity, uncertainty: RigUncertainty) -> Freedom:
    return _freedom(quantity, {e: uncertainty.sigma_of(quantity, e) for e in RIG_ENTRIES[quantity]})


def _freedom(quantity: Quantity, sigma: Mapping[str, float]) -> Freedom:
    free = {entry: value for entry, value in sigma.items() if value > 0}
    if not free:
        return FIXED
    return Freedom(scope=_SCOPE.get(quantity, "eye"), free=tuple(free), sigma=free)
