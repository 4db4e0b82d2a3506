"""The entries of `traverse.json`."""

import math
from dataclasses import fields, replace
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Tag

from pancam_graph.data import Freedom, Sharing
from pancam_graph.io._camera_entry import AnyCamera, camera_entry
from pancam_graph.io._entries import Entry, Label, PoseEntry, Text
from pancam_graph.io._json import prefixed
from pancam_graph.rigs import Rig, RigUncertainty, rig_template

__all__ = [
    "FrameEntry",
    "ImageEntry",
    "OwnRigEntry",
    "SharingEntry",
    "StopEntry",
    "TemplateRigEntry",
    "TraverseFile",
    "rig_entry",
]


class UncertaintyEntry(Entry):
    """How far the numbers of a rig may be off; what is not named is that of the rig."""

    focal: float | None = None
    aspect: float | None = None
    principal_point_px: float | None = None
    skew_px: float | None = None
    mount_rad: float | None = None
    mount_m: float | None = None
    tilt_axis_rad: float | None = None
    tilt_axis_m: float | None = None
    flex_rad: float | None = None
    flex_m: float | None = None
    source: Text | None = None

    def on(self, rig: Rig) -> Rig:
        """The rig with this uncertainty. Raises InputError for a negative sigma."""
        with prefixed("rig"):
            return replace(rig, uncertainty=replace(rig.uncertainty, **self.model_dump(exclude_none=True)))

    @staticmethod
    def of(uncertainty: RigUncertainty) -> "UncertaintyEntry":
        """The entry of an uncertainty."""
        sigmas = {name: float(sigma) for name, sigma in uncertainty.sigmas.items()}
        return UncertaintyEntry(**sigmas, source=uncertainty.source)


class TemplateRigEntry(Entry):
    """A rig that ships with the package."""

    template: Label
    uncertainty: UncertaintyEntry = UncertaintyEntry()

    def rig(self) -> Rig:
        """The rig. Raises InputError for an unknown template."""
        with prefixed("rig"):
            rig = rig_template(self.template)
        return self.uncertainty.on(rig)


class OwnRigEntry(Entry):
    """A rig of the user's own."""

    name: Text = "own rig"
    pan_T_tilt: PoseEntry
    cameras: list[AnyCamera]
    uncertainty: UncertaintyEntry = UncertaintyEntry()

    def rig(self) -> Rig:
        """The rig. Raises InputError naming the entry."""
        pan_T_tilt = self.pan_T_tilt.pose("rig.pan_T_tilt")
        eyes = tuple(c.eye(f"rig.cameras[{i}]") for i, c in enumerate(self.cameras))
        return self.uncertainty.on(Rig(name=self.name, pan_T_tilt=pan_T_tilt, eyes=eyes))


def _rig_tag(value: Any) -> str:
    template = isinstance(value, TemplateRigEntry) or (isinstance(value, dict) and "template" in value)
    return "<template>" if template else "<own>"


class StopEntry(Entry):
    """One place of the mast."""

    id: Label
    world_T_mast: PoseEntry
    sigma_rotation_rad: float
    sigma_translation_m: float


class FrameEntry(Entry):
    """One pointing of the head."""

    id: Label
    stop: Label
    pan_rad: float
    tilt_rad: float
    sigma_pan_rad: float
    sigma_tilt_rad: float


class ImageEntry(Entry):
    """One eye's picture of a frame."""

    id: Label
    frame: Label
    camera: Label
    file: Label | None = None
    mask: Label | None = None


class FreedomEntry(Entry):
    """Which entries of a quantity of the rig are free, and their priors."""

    scope: str
    free: list[str] | None = None
    sigma: dict[str, float | None] = {}  # noqa: RUF012  pydantic copies it
    """Sigmas of the priors by entry; null: no prior."""

    def freedom(self) -> Freedom:
        """The freedom. `Sharing` checks it."""
        sigma = {name: math.inf if value is None else value for name, value in self.sigma.items()}
        return Freedom(
            scope=self.scope,  # type: ignore[arg-type]  # checked by Sharing
            free=None if self.free is None else tuple(self.free),
            sigma=sigma,
        )

    @staticmethod
    def of(freedom: Freedom | None) -> "FreedomEntry | None":
        """The entry of a freedom."""
        if freedom is None:
            return None
        sigma = {name: value if math.isfinite(value) else None for name, value in freedom.sigma.items()}
        free = None if freedom.free is None else list(freedom.free)
        return FreedomEntry(scope=freedom.scope, free=free, sigma=sigma)


class SharingEntry(Entry):
    """Which quantities of the rig are free, and which images share one value."""

    calibration: FreedomEntry | None = None
    mounts: FreedomEntry | None = None
    pan_T_tilt: FreedomEntry | None = None
    radius: FreedomEntry | None = None
    flex: FreedomEntry | None = None

    def sharing(self) -> Sharing:
        """The sharing. Raises InputError for entries that contradict each other."""
        given = {field.name: getattr(self, field.name) for field in fields(Sharing)}
        return Sharing(**{name: entry.freedom() for name, entry in given.items() if entry is not None})

    @staticmethod
    def of(sharing: Sharing) -> "SharingEntry":
        """The entry of a sharing; it has only the quantities that differ from the default."""
        quantities = [field.name for field in fields(Sharing)]
        given = {name: FreedomEntry.of(getattr(sharing, name)) for name in quantities}
        usual = {name: FreedomEntry.of(getattr(Sharing(), name)) for name in quantities}
        return SharingEntry(**{name: entry for name, entry in given.items() if entry != usual[name]})


class TraverseFile(Entry):
    """`traverse.json`."""

    format: Literal["pancam-graph/traverse"] = "pancam-graph/traverse"
    version: Literal[1] = 1
    name: Text | None = None
    rig: Annotated[
        Annotated[TemplateRigEntry, Tag("<template>")] | Annotated[OwnRigEntry, Tag("<own>")],
        Discriminator(_rig_tag),
    ]
    stops: list[StopEntry]
    frames: list[FrameEntry]
    images: list[ImageEntry]
    observations: Label | None
    sharing: SharingEntry | None = None


def rig_entry(rig: Rig) -> OwnRigEntry:
    """The entry of a rig, with all its numbers even where a template made it.

    So the file means the same with every version of the package. The mast's height, which only simulations
    and drawings use, and the sources are not in the format.
    """
    return OwnRigEntry(
        name=rig.name,
        pan_T_tilt=PoseEntry.of(rig.pan_T_tilt),
        cameras=[camera_entry(e) for e in rig.eyes],
        uncertainty=UncertaintyEntry.of(rig.uncertainty),
    )
