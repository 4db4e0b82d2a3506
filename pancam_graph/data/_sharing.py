"""Which numbers of the rig are estimated, and which images share them (thesis 4.3, 5.4: parameter mask).

Each quantity of a rig is fixed, or free with a prior about the rig's own value: one correction shared by
all, one per eye, per stop or per image. Single entries of a quantity can be held while others are free.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal, get_args

from pancam_graph.base.errors import InputError

__all__ = ["ENTRIES", "Freedom", "Quantity", "Scope", "Sharing", "default_sigma", "parse_sharing"]

Scope = Literal["fixed", "all", "eye", "stop", "image"]
"""Who shares a correction: nobody has one (fixed), all images, the images of an eye, those of an eye at a
stop, or each image has its own. `pan_T_tilt` belongs to no eye: one for all, or one per stop."""

Quantity = Literal["calibration", "mounts", "pan_T_tilt", "radius"]

_POSE = ("rx_rad", "ry_rad", "rz_rad", "x_m", "y_m", "z_m")
ENTRIES: Mapping[Quantity, tuple[str, ...]] = {
    "calibration": ("fx_px", "fy_px", "skew_px", "cx_px", "cy_px"),
    "mounts": _POSE,
    "pan_T_tilt": _POSE,
    "radius": ("radius_m",),
}
"""Entries of each quantity; all are free unless said otherwise. `calibration` knows one more, `focal`: a
factor on fx and fy in common. Those of a pose turn and shift it in its own frame
(geometry.corrected_poses)."""

FOCAL = "focal"

_SCOPES: Mapping[Quantity, tuple[Scope, ...]] = {
    "calibration": ("fixed", "all", "eye", "stop", "image"),
    "mounts": ("fixed", "eye", "stop", "image"),
    "pan_T_tilt": ("fixed", "all", "stop"),
    "radius": ("fixed", "all", "eye", "stop", "image"),
}
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
}
_OTHERWISE: Mapping[tuple[str, str], str] = {
    ("mounts", "circle"): "whose cameras turn freely and whose centres hang on circles",
    ("mounts", "free"): "whose cameras hang on no mount",
    ("pan_T_tilt", "circle"): "whose cameras turn freely and whose centres hang on circles",
    ("pan_T_tilt", "free"): "whose cameras hang on no axis",
    ("radius", "mast"): "whose circles follow from its mounts",
    ("radius", "free"): "whose cameras run on no circle",
    ("calibration", "projective"): "whose matrices have calibrations of their own",
    ("mounts", "projective"): "whose cameras hang on no mount",
    ("pan_T_tilt", "projective"): "whose cameras hang on no axis",
    ("radius", "projective"): "whose cameras run on no circle",
}

_DEFAULT_SIGMA = {
    # Published focal lengths of one MER Pancam: 3571 to 3583 px.
    FOCAL: 3e-3,
    # A CAHV label's image axes are off a right angle by up to 0.012 degrees.
    "skew_px": 2e-4,
    # Principal points of the two Mars 2020 Navcams, and of the two Mastcam-Z, differ by 0.2 to 0.7 %.
    "cx_px": 5e-3,
    "cy_px": 5e-3,
    # Two sources give MSL Mastcam's left eye a yaw of 1.48 and of 1.77 degrees.
    **dict.fromkeys(_POSE[:3], 5e-3),
    # The left Navcams of Opportunity and of Spirit sit 2 mm apart.
    **dict.fromkeys(_POSE[3:], 2e-3),
    # The circle of Opportunity's five Navcam centres misses them by up to a millimetre.
    "radius_m": 1e-3,
}
"""Standard deviations of the priors; those in pixels as shares of the focal length."""


def default_sigma(entry: str, focal_px: float) -> float:
    """Standard deviation of an entry's prior where none is given, for a focal length in pixels."""
    if entry in {"fx_px", "fy_px"}:
        return _DEFAULT_SIGMA[FOCAL] * focal_px
    return _DEFAULT_SIGMA[entry] * (focal_px if entry.endswith("_px") else 1.0)


@dataclass(frozen=True, kw_only=True)
class Freedom:
    """How free one quantity is, and who shares it."""

    scope: Scope = "fixed"
    free: tuple[str, ...] | None = None
    """Entries that are free; None: all. The others are held: they stay what the rig says, bit for bit."""
    sigma: Mapping[str, float] = field(default_factory=dict, hash=False)
    """Standard deviation of the prior of some free entries, about the rig's value; infinite: none. Default:
    what real rigs differ by (`default_sigma`)."""

    def __post_init__(self) -> None:
        """Take copies: what was given may change."""
        if self.free is not None:
            object.__setattr__(self, "free", tuple(self.free))
        object.__setattr__(self, "sigma", {name: float(value) for name, value in self.sigma.items()})

    def entries(self, quantity: Quantity) -> tuple[str, ...]:
        """The free entries, in their own order; none where the scope is fixed."""
        if self.scope == "fixed":
            return ()
        if self.free is None:
            return ENTRIES[quantity]
        return tuple(e for e in _known(quantity) if e in self.free)


FIXED = Freedom()


@dataclass(frozen=True, kw_only=True)
class Sharing:
    """Freedom of each quantity of a rig. Raises InputError for what contradicts itself or means nothing."""

    calibration: Freedom = FIXED
    mounts: Freedom = FIXED
    """`head_T_camera`, in the camera's frame; model `mast`."""
    pan_T_tilt: Freedom = FIXED
    """Where the tilt axis sits, in its own frame; model `mast`."""
    radius: Freedom | None = None
    """Of the circles of model `circle`. None: free per eye there, with the default prior."""

    def __post_init__(self) -> None:
        """Check scopes, entries and sigmas."""
        for quantity, freedom in self._given():
            _check(quantity, freedom)

    def _given(self) -> list[tuple[Quantity, Freedom]]:
        freedoms: list[tuple[Quantity, Freedom | None]] = [
            ("calibration", self.calibration),
            ("mounts", self.mounts),
            ("pan_T_tilt", self.pan_T_tilt),
            ("radius", self.radius),
        ]
        return [(quantity, freedom) for quantity, freedom in freedoms if freedom is not None]

    def for_model(self, model: str) -> "Sharing":
        """The same with what the model itself says where nothing was given.

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
        """Whether anything is."""
        return any(freedom.scope != "fixed" for _, freedom in self._given())


def _known(quantity: Quantity) -> tuple[str, ...]:
    return (FOCAL, *ENTRIES[quantity]) if quantity == "calibration" else ENTRIES[quantity]


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
    if FOCAL in entries and not {"fx_px", "fy_px"}.isdisjoint(entries):
        raise InputError(f"{where}: free: expected either {FOCAL} or fx_px and fy_px, found both")
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
    """A sharing from words like `calibration=eye:fx_px,fy_px~2` as a command line has them.

    QUANTITY=SCOPE[:ENTRY[~SIGMA],...]: without entries all are free; SIGMA is the prior's, `inf` for none. A
    quantity that is named replaces that of `base`; without words `base` it is. Raises InputError saying which
    word is wrong.
    """
    if not words:
        return base
    given: dict[str, Freedom] = {}
    quantities = tuple(f.name for f in fields(Sharing))
    for word in words:
        quantity, equals, rest = word.partition("=")
        if not equals or quantity not in quantities:
            raise InputError(
                f"sharing: expected QUANTITY=SCOPE with one of {', '.join(quantities)}; found {word!r}"
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
