"""The entries of `traverse.json`."""

import math
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag

from pancam_graph.base.choices import expected_one_of
from pancam_graph.base.errors import InputError
from pancam_graph.data import QUANTITIES, Body, Freedom, Image, Sharing, Site, Tile
from pancam_graph.io._camera_entry import AnyCamera, camera_entry
from pancam_graph.io._constraint_entries import AnyConstraint
from pancam_graph.io._entries import Entry, Label, PoseEntry, SparseEntry, Text
from pancam_graph.io._json import prefixed
from pancam_graph.rigs import Rig, RigCovariance, RigEntry, RigUncertainty, rig_template

__all__ = [
    "AnyRigEntry",
    "FrameEntry",
    "ImageEntry",
    "OwnRigEntry",
    "SharingEntry",
    "SiteEntry",
    "StopEntry",
    "TemplateRigEntry",
    "TraverseFile",
    "rig_entry",
]


class RigNumberEntry(Entry):
    """Which number of a rig a row of a covariance is about."""

    quantity: Label
    camera: Label | None = None
    """Name of its eye; missing or null for the tilt axis."""
    entry: Label


class CovarianceEntry(Entry):
    """Joint covariance of errors of a rig's numbers."""

    entries: list[RigNumberEntry]
    matrix: list[list[float]]
    """One row an entry, in their order and units."""
    pictures: list[Label] = []  # noqa: RUF012  pydantic copies it
    """Digests of the pictures that the rig was calibrated with."""

    def covariance(self, rig: Rig) -> RigCovariance:
        """The covariance. Raises InputError naming the entry."""
        eyes = [eye.name for eye in rig.eyes]
        for i, entry in enumerate(self.entries):
            if entry.camera is not None and entry.camera not in eyes:
                where = f"covariance: entries[{i}]: camera"
                raise InputError(expected_one_of(where, entry.camera, eyes))
        for i, row in enumerate(self.matrix):
            if len(row) != len(self.matrix):
                raise InputError(
                    f"covariance: matrix[{i}]: expected {len(self.matrix)} numbers, as there are rows; "
                    f"found {len(row)}"
                )
        n = len(self.matrix)
        return RigCovariance(
            entries=tuple(RigEntry(e.quantity, e.camera, e.entry) for e in self.entries),
            matrix=np.array(self.matrix, dtype=float).reshape(n, n),
            pictures=tuple(self.pictures),
        )

    @staticmethod
    def of(covariance: RigCovariance) -> "CovarianceEntry":
        """The entry of a covariance."""
        return CovarianceEntry(
            entries=[RigNumberEntry(**entry._asdict()) for entry in covariance.entries],
            matrix=covariance.matrix.tolist(),
            pictures=list(covariance.pictures),
        )


class UncertaintyEntry(SparseEntry):
    """How far the numbers of a rig may be off; what is not named is that of the rig."""

    _OPTIONAL: ClassVar = frozenset({"covariance"})

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
    pan_scale: float | None = None
    tilt_scale: float | None = None
    field_px: float | None = None
    source: Text | None = None
    covariance: CovarianceEntry | None = None

    def on(self, rig: Rig) -> Rig:
        """The rig with this uncertainty. Raises InputError for a negative sigma, and as `RigCovariance`."""
        told = self.model_dump(exclude_none=True, exclude={"covariance"})
        with prefixed("rig"):
            if self.covariance is not None:
                with prefixed("uncertainty"):
                    told["covariance"] = self.covariance.covariance(rig)
            return replace(rig, uncertainty=replace(rig.uncertainty, **told))

    @staticmethod
    def of(uncertainty: RigUncertainty) -> "UncertaintyEntry":
        """The entry of an uncertainty."""
        sigmas = {name: float(sigma) for name, sigma in uncertainty.sigmas.items()}
        joint = uncertainty.covariance
        return UncertaintyEntry(
            **sigmas,
            source=uncertainty.source,
            covariance=None if joint is None else CovarianceEntry.of(joint),
        )


class TemplateRigEntry(Entry):
    """A rig that ships with the package."""

    template: Label
    uncertainty: UncertaintyEntry = UncertaintyEntry()

    def rig(self) -> Rig:
        """The rig. Raises InputError for an unknown template."""
        with prefixed("rig"):
            rig = rig_template(self.template)
        return self.uncertainty.on(rig)


class OwnRigEntry(SparseEntry):
    """A rig of the user's own."""

    _OPTIONAL: ClassVar = frozenset({"rover_T_mast"})

    name: Text = "own rig"
    pan_T_tilt: PoseEntry
    cameras: list[AnyCamera]
    uncertainty: UncertaintyEntry = UncertaintyEntry()
    rover_T_mast: PoseEntry | None = None

    def rig(self) -> Rig:
        """The rig. Raises InputError naming the entry."""
        pan_T_tilt = self.pan_T_tilt.pose("rig.pan_T_tilt")
        eyes = tuple(c.eye(f"rig.cameras[{i}]") for i, c in enumerate(self.cameras))
        of_rover = None if self.rover_T_mast is None else self.rover_T_mast.pose("rig.rover_T_mast")
        rig = Rig(name=self.name, pan_T_tilt=pan_T_tilt, eyes=eyes, rover_T_mast=of_rover)
        return self.uncertainty.on(rig)


def _rig_tag(value: Any) -> str:
    template = isinstance(value, TemplateRigEntry) or (isinstance(value, dict) and "template" in value)
    return "<template>" if template else "<own>"


AnyRigEntry = Annotated[
    Annotated[TemplateRigEntry, Tag("<template>")] | Annotated[OwnRigEntry, Tag("<own>")],
    Discriminator(_rig_tag),
]
"""A template or an own rig, as the type of an entry."""


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


class TileEntry(Entry):
    """A file with a part of an image."""

    file: Label
    left_px: int
    top_px: int


class ImageEntry(SparseEntry):
    """One eye's picture of a frame."""

    _OPTIONAL: ClassVar = frozenset({"mask", "tiles"})

    id: Label
    frame: Label
    camera: Label
    file: Label | None = None
    mask: Label | None = None
    tiles: Annotated[list[TileEntry], Field(min_length=1)] | None = None

    def image(self) -> Image:
        """The image. Raises InputError as `Image` does."""
        told = self.model_dump(exclude={"tiles"})
        return Image(**told, tiles=tuple(Tile(**tile.model_dump()) for tile in self.tiles or ()))

    @staticmethod
    def of(image: Image) -> "ImageEntry":
        """The entry of an image."""
        return ImageEntry(
            id=image.id,
            frame=image.frame,
            camera=image.camera,
            file=None if image.tiles else image.file,
            mask=image.mask,
            tiles=[TileEntry(**vars(tile)) for tile in image.tiles] or None,
        )

    @property
    def named_files(self) -> dict[str, str]:
        """Image files by the entries that name them."""
        if self.tiles is None:
            return {} if self.file is None else {"file": self.file}
        return {f"tiles[{i}].file": tile.file for i, tile in enumerate(self.tiles)}


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
    encoders: FreedomEntry | None = None
    field: FreedomEntry | None = None

    def sharing(self) -> Sharing:
        """The sharing. Raises InputError for entries that contradict each other."""
        given = {name: getattr(self, name) for name in QUANTITIES}
        return Sharing(**{name: entry.freedom() for name, entry in given.items() if entry is not None})

    @staticmethod
    def of(sharing: Sharing) -> "SharingEntry":
        """The entry of a sharing; it has only the quantities that differ from the default."""
        given = {name: FreedomEntry.of(getattr(sharing, name)) for name in QUANTITIES}
        usual = {name: FreedomEntry.of(getattr(Sharing(), name)) for name in QUANTITIES}
        return SharingEntry(**{name: entry for name, entry in given.items() if entry != usual[name]})


class SiteEntry(Entry):
    """Where the world's origin is on its planet, and where north is."""

    body: Body
    latitude_deg: float
    longitude_deg: float
    height_m: float
    north_rad: float

    @staticmethod
    def of(site: Site) -> "SiteEntry":
        """The entry of a site."""
        return SiteEntry(**{name: getattr(site, name) for name in SiteEntry.model_fields})

    def site(self) -> Site:
        """The site. Raises InputError for numbers out of range."""
        return Site(**dict(self))


class TraverseFile(Entry):
    """`traverse.json`."""

    format: Literal["pancam-graph/traverse"] = "pancam-graph/traverse"
    version: Literal[1] = 1
    name: Text | None = None
    rig: AnyRigEntry
    stops: list[StopEntry]
    frames: list[FrameEntry]
    images: list[ImageEntry]
    observations: Label | None
    sharing: SharingEntry | None = None
    constraints: list[AnyConstraint] = []  # noqa: RUF012  pydantic copies it
    points: Label | None = None
    site: SiteEntry | None = None


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
        rover_T_mast=None if rig.rover_T_mast is None else PoseEntry.of(rig.rover_T_mast),
    )
