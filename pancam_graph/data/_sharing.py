"""Numbers of the rig that are estimated, and images that share them (thesis 4.3, 5.4: parameter mask).

Each quantity of a rig is fixed, or free with a prior whose mean is the rig's own value. One correction is
shared by all images, by the images of an eye, by those of a stop, or belongs to a single image. Single
entries of a quantity can be held while others are free.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from pancam_graph.base.errors import InputError
from pancam_graph.rigs import ASPECT, FOCAL, POSE_ENTRIES, RigCovariance

__all__ = [
    "ENTRIES",
    "QUANTITIES",
    "Freedom",
    "Quantity",
    "Scope",
    "Sharing",
    "default_sigma",
    "parse_sharing",
]

Scope = Literal["fixed", "all", "eye", "stop", "image", "frame"]
"""Images that share one correction: "fixed" none (there is no correction), "all" all images, "eye" the images
of an eye, "stop" the images of an eye at a stop, "image" each image alone. `pan_T_tilt` belongs to no eye:
"all" is one for the traverse, "stop" one per stop. `flex` has one for each "frame"."""

Quantity = Literal["calibration", "mounts", "pan_T_tilt", "radius", "flex", "encoders", "field"]

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
ENTRIES: Mapping[Quantity, tuple[str, ...]] = {
    "calibration": ("fx_px", "fy_px", "skew_px", "cx_px", "cy_px"),
    "mounts": POSE_ENTRIES,
    "pan_T_tilt": POSE_ENTRIES,
    "radius": ("radius_m",),
    "flex": ("twist_rad", "forward_m", "left_m", "up_m"),
    "encoders": ("pan_scale", "tilt_scale"),
    "field": ("field_px",),
}
"""Names of the entries of each quantity. `calibration` has two more: `focal`, a common factor on fx and fy,
and `aspect`, a factor on fy alone, so that priors of the two are independent. Entries of a pose are a
rotation vector and a shift in the pose's own frame (geometry.corrected_poses). Those of `encoders` are what
angles exceed their readings by, as shares. `field_px` is what a whole field of coefficients is at a pixel
(cameras.Fields)."""

_SCOPES: Mapping[Quantity, tuple[Scope, ...]] = {
    "calibration": ("fixed", "all", "eye", "stop", "image"),
    "mounts": ("fixed", "eye", "stop", "image"),
    "pan_T_tilt": ("fixed", "all", "stop"),
    "radius": ("fixed", "all", "eye", "stop", "image"),
    "flex": ("fixed", "frame"),
    "encoders": ("fixed", "all"),
    "field": ("fixed", "eye"),
}
_JOINT: Mapping[Quantity, tuple[Scope, ...]] = {
    "calibration": ("fixed", "eye"),
    "mounts": ("fixed", "eye"),
    "pan_T_tilt": ("fixed", "all"),
    "radius": _SCOPES["radius"],
    "flex": _SCOPES["flex"],
    "encoders": _SCOPES["encoders"],
    "field": _SCOPES["field"],
}
"""Scopes with which a covariance of the rig says what its entries are about."""
_WHY_NOT: Mapping[tuple[str, str], str] = {
    ("mounts", "all"): "each eye has its own mount",
    ("pan_T_tilt", "eye"): "the eyes have one tilt axis",
    ("pan_T_tilt", "image"): "the eyes have one tilt axis, and a frame's angles could not be told from it",
}
_MODELS: Mapping[Quantity, tuple[str, ...]] = {
    "calibration": ("mast", "circle", "free"),
    "mounts": ("mast",),
    "pan_T_tilt": ("mast",),
    "radius": ("circle",),
    "flex": ("mast",),
    "encoders": ("mast",),
    "field": ("mast",),
}
_OTHERWISE: Mapping[tuple[str, str], str] = {
    ("mounts", "circle"): "whose cameras turn freely and whose centres hang on circles",
    ("mounts", "free"): "whose cameras hang on no mount",
    ("pan_T_tilt", "circle"): "whose cameras turn freely and whose centres hang on circles",
    ("pan_T_tilt", "free"): "whose cameras hang on no axis",
    **{("encoders", model): "whose cameras turn freely" for model in ("circle", "free", "projective")},
    ("radius", "mast"): "whose circles follow from its mounts",
    ("radius", "free"): "whose cameras run on no circle",
    ("flex", "circle"): "whose cameras turn freely",
    ("flex", "free"): "whose cameras turn freely",
    ("flex", "projective"): "whose cameras turn freely",
    ("field", "circle"): "whose cameras turn freely",
    ("field", "free"): "whose cameras turn freely",
    ("field", "projective"): "whose cameras turn freely",
    ("calibration", "projective"): "whose matrices have calibrations of their own",
    ("mounts", "projective"): "whose cameras hang on no mount",
    ("pan_T_tilt", "projective"): "whose cameras hang on no axis",
    ("radius", "projective"): "whose cameras run on no circle",
}

_DEFAULT_SIGMA = {
    # Published focal lengths of one MER Pancam: 3571 to 3583 px.
    FOCAL: 3e-3,
    # fx and fy of published CAHV models differ by up to this share.
    ASPECT: 5e-4,
    # A CAHV label's image axes are off a right angle by up to 0.012 degrees.
    "skew_px": 2e-4,
    # Principal points of the two Mars 2020 Navcams, and of the two Mastcam-Z, differ by 0.2 to 0.7 %.
    "cx_px": 5e-3,
    "cy_px": 5e-3,
    # Two sources give MSL Mastcam's left eye a yaw of 1.48 and of 1.77 degrees.
    **dict.fromkeys(POSE_ENTRIES[:3], 5e-3),
    # The left Navcams of Opportunity and of Spirit sit 2 mm apart.
    **dict.fromkeys(POSE_ENTRIES[3:], 2e-3),
    # The circle of Opportunity's five Navcam centres misses them by up to a millimetre.
    "radius_m": 1e-3,
    # Our stated assumption for a mast that stands on its rover.
    "twist_rad": 2e-4,
    **dict.fromkeys(("forward_m", "left_m", "up_m"), 1e-4),
    # Our stated assumption for servos and potentiometers.
    **dict.fromkeys(("pan_scale", "tilt_scale"), 1e-2),
    # The fields of Navcams of Opportunity and Curiosity: docs/accuracy.md.
    "field_px": 2.9e-5,
}
"""Standard deviations of the priors; entries in pixels as shares of the focal length, factors as shares."""


def default_sigma(entry: str, focal_px: float) -> float:
    """Default standard deviation of an entry's prior; `focal_px` scales entries in pixels."""
    if entry in {"fx_px", "fy_px"}:
        return _DEFAULT_SIGMA[FOCAL] * focal_px
    return _DEFAULT_SIGMA[entry] * (focal_px if entry.endswith("_px") else 1.0)


@dataclass(frozen=True, kw_only=True)
class Freedom:
    """Freedom of one quantity of the rig: who shares a correction, its entries, and their priors."""

    scope: Scope = "fixed"
    free: tuple[str, ...] | None = None
    """Free entries; None means all. Other entries keep the value of the rig, bit for bit."""
    sigma: Mapping[str, float] = field(default_factory=dict, hash=False)
    """Standard deviations of priors by entry; infinite means no prior. Entries that are not named get
    `default_sigma`, the amount by which real rigs differ."""

    def __post_init__(self) -> None:
        """Copy mutable arguments."""
        if self.free is not None:
            object.__setattr__(self, "free", tuple(self.free))
        object.__setattr__(self, "sigma", {name: float(value) for name, value in self.sigma.items()})

    def entries(self, quantity: Quantity) -> tuple[str, ...]:
        """Free entries in the order of `ENTRIES`; empty for the scope "fixed"."""
        if self.scope == "fixed":
            return ()
        if self.free is None:
            return ENTRIES[quantity]
        return tuple(e for e in _known(quantity) if e in self.free)

    def sigma_of(self, entry: str, focal_px: float = 1.0) -> float:
        """Standard deviation of an entry's prior, stated or `default_sigma`, which takes `focal_px`."""
        stated = self.sigma.get(entry)
        return default_sigma(entry, focal_px) if stated is None else stated


FIXED = Freedom()


@dataclass(frozen=True, kw_only=True)
class Sharing:
    """Freedom of each quantity of a rig.

    Raises InputError for scopes and entries that a quantity does not have, and for contradictions.
    """

    calibration: Freedom = FIXED
    mounts: Freedom = FIXED
    """`head_T_camera`, in the camera's frame; model `mast`."""
    pan_T_tilt: Freedom = FIXED
    """Pose of the tilt axis on the pan axis, corrected in the tilt frame; model `mast`."""
    radius: Freedom | None = None
    """Radius of the circles of model `circle`; None means free per eye there, with the default prior."""
    flex: Freedom = FIXED
    """How each frame's head stands off the rigid mast: turned about its forward axis (`twist_rad`), and
    shifted along its own axes; model `mast` with a hard tie. Its pan and tilt are those of the head as it
    stood, whose priors are widened by the sigma of the twist."""
    encoders: Freedom = FIXED
    """Scale of the pans and tilts that telemetry reads, one for the traverse; model `mast`."""
    field: Freedom = FIXED
    """Smooth distortion field of each eye (cameras.Fields), beside its lens; model `mast` with a hard tie."""
    covariance: RigCovariance | None = None
    """Joint covariance of the priors of those entries that it names, in place of their sigmas; then
    calibrations and mounts are of an eye, the tilt axis of all. None: all are independent."""

    def __post_init__(self) -> None:
        """Check scopes, entries and sigmas."""
        for quantity, freedom in self._given():
            _check(quantity, freedom)
            if self.covariance is not None and freedom.scope not in _JOINT[quantity]:
                raise InputError(
                    f"sharing: {quantity}: expected {' or '.join(_JOINT[quantity])} with a covariance of "
                    f"the rig, found {freedom.scope}"
                )

    def _given(self) -> list[tuple[Quantity, Freedom]]:
        freedoms: list[tuple[Quantity, Freedom | None]] = [
            ("calibration", self.calibration),
            ("mounts", self.mounts),
            ("pan_T_tilt", self.pan_T_tilt),
            ("radius", self.radius),
            ("flex", self.flex),
            ("encoders", self.encoders),
            ("field", self.field),
        ]
        return [(quantity, freedom) for quantity, freedom in freedoms if freedom is not None]

    def for_model(self, model: str) -> "Sharing":
        """The same sharing with the radius that the model asks for, where none was given.

        Raises InputError for a free quantity that the model does not have.
        """
        for quantity, freedom in self._given():
            if freedom.scope != "fixed" and model not in _MODELS[quantity]:
                why = _OTHERWISE.get((quantity, model))
                raise InputError(
                    f"sharing: {quantity}: expected fixed with the model {model}"
                    f"{', ' + why if why else ''}; found {freedom.scope}"
                )
        if self.radius is not None:
            return self
        return replace(self, radius=Freedom(scope="eye") if model == "circle" else FIXED)

    @property
    def any_free(self) -> bool:
        """Whether any quantity is free."""
        return any(freedom.scope != "fixed" for _, freedom in self._given())


def _known(quantity: Quantity) -> tuple[str, ...]:
    return (FOCAL, ASPECT, *ENTRIES[quantity]) if quantity == "calibration" else ENTRIES[quantity]


def _check(quantity: Quantity, freedom: Freedom) -> None:
    where = f"sharing: {quantity}"
    if freedom.scope not in _SCOPES[quantity]:
        why = _WHY_NOT.get((quantity, freedom.scope))
        raise InputError(
            f"{where}: scope: expected one of {', '.join(_SCOPES[quantity])}; "
            f"found {freedom.scope!r}{': ' + why if why else ''}"
        )
    if freedom.scope == "fixed":
        named = (*(freedom.free or ()), *freedom.sigma)
        if freedom.free is not None or named:
            found = ", ".join(dict.fromkeys(named)) or "an empty list"
            raise InputError(
                f"{where}: expected a scope other than fixed where entries are free, found fixed with {found}"
            )
        return
    known = _known(quantity)
    for kind, names in (("free", freedom.free or ()), ("sigma", tuple(freedom.sigma))):
        for name in names:
            if name not in known:
                raise InputError(f"{where}: {kind}: expected entries of {', '.join(known)}; found {name!r}")
            if names.count(name) > 1:
                raise InputError(f"{where}: {kind}: expected different entries, found {name} twice")
    entries = freedom.entries(quantity)
    if not entries:
        raise InputError(f"{where}: free: expected one entry or more, found none; fixed holds them all")
    for factor in (FOCAL, ASPECT):
        if factor in entries and not {"fx_px", "fy_px"}.isdisjoint(entries):
            raise InputError(f"{where}: free: expected either {factor} or fx_px and fy_px, found both")
    for name, sigma in freedom.sigma.items():
        if name not in entries:
            raise InputError(
                f"{where}: sigma: expected free entries ({', '.join(entries)}), found {name}, which is held"
            )
        if not sigma > 0:
            raise InputError(
                f"{where}: sigma: {name}: expected a number above 0, found {sigma}; to hold an entry, "
                "leave it out of those that are free"
            )


def parse_sharing(words: Sequence[str], base: Sharing | None = None) -> Sharing | None:
    """A sharing from words such as `calibration=eye:fx_px,fy_px~2` of a command line.

    Each word is QUANTITY=SCOPE[:ENTRY[~SIGMA],...]. Without entries all are free. SIGMA is the standard
    deviation of the prior, `inf` for none. A named quantity replaces that of `base`; without words the result
    is `base`. Raises InputError naming the wrong word.
    """
    if not words:
        return base
    given: dict[str, Any] = {}
    for word in words:
        quantity, equals, rest = word.partition("=")
        if not equals or quantity not in QUANTITIES:
            raise InputError(
                f"sharing: expected QUANTITY=SCOPE with one of {', '.join(QUANTITIES)}; found {word!r}"
            )
        if quantity in given:
            raise InputError(f"sharing: expected each quantity once, found {quantity} twice")
        scope, colon, names = rest.partition(":")
        given[quantity] = _freedom(word, scope, names.split(",") if colon else None)
    return replace(base or Sharing(), **given)


def _freedom(word: str, scope: str, names: Sequence[str] | None) -> Freedom:
    if scope not in get_args(Scope):
        raise InputError(f"sharing: {word}: expected one of {', '.join(get_args(Scope))}; found {scope!r}")
    sigma: dict[str, float] = {}
    entries = []
    for name in names or ():
        entry, tilde, number = name.partition("~")
        entries.append(entry)
        if tilde:
            try:
                sigma[entry] = float(number)
            except ValueError as error:
                raise InputError(
                    f"sharing: {word}: expected a number or inf after {entry}~, found {number!r}"
                ) from error
    return Freedom(scope=scope, free=None if names is None else tuple(entries), sigma=sigma)  # type: ignore[arg-type]  # checked above
