"""The mosaics of one eye at one stop."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.base.options import options_of
from pancam_graph.data import Solution
from pancam_graph.images import Evening
from pancam_graph.io import same_pictures
from pancam_graph.mosaic._blend import blend, choose_look
from pancam_graph.mosaic._mosaic_options import MosaicOptions
from pancam_graph.mosaic._placed import (
    POINTINGS,
    PlacedImage,
    Pointing,
    View,
    placed_images,
    view_from_stop,
)
from pancam_graph.mosaic._projections import Cylinder, Ground, Projection
from pancam_graph.mosaic._seam_error import SeamError, native_px_per_degree, seam_error
from pancam_graph.mosaic._surface import Surface, surface_of_stop
from pancam_graph.mosaic._warp import STEP_PX, Lattice, Layer, largest_gap, warp

__all__ = ["Mosaic", "StopGround", "StopMosaics", "make_mosaics", "stop_ground"]

_CELLS_PER_FIELD = 24
_COARSEST_CELL_DEG = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Mosaic:
    """One picture of all images, with each pointing."""

    projection: Projection
    """Where the pixels are in the world."""
    pictures: dict[Pointing, NDArray[np.uint8]]
    """(rows, columns) grey, stretched for the eye; 0 where there is no image."""
    samples: dict[Pointing, NDArray[np.uint16]] | None
    """(rows, columns) samples of images of more than 8 bits, evened out, not stretched; 0 where there is no
    image, 1 at the least elsewhere. None for images of 8 bits."""
    dark: float
    bright: float
    """Samples that are 1 and 255 in `pictures`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StopMosaics:
    """The mosaics of one eye at one stop."""

    stop: str
    camera: str
    images: tuple[str, ...]
    """Ids of the images shown."""
    cylinder: Mosaic
    """Around the horizon."""
    ground: Mosaic | None
    """From above; None where no image shows ground near enough."""
    seams: SeamError
    evening: Evening
    """Gains, by the images' places in `images`, and the vignetting that was taken out."""
    warnings: tuple[str, ...]
    """Images that are left out, and why."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StopGround:
    """What the mosaics of all eyes at a stop share."""

    origin_m: FloatArray
    """(3,) mean of the cameras' refined centres; directions and ranges count from there."""
    views: dict[Pointing, View]
    surfaces: dict[Pointing, Surface]
    """The surface that the landmarks of each pointing span."""
    twice: Mapping[int, int]
    """Rows of images whose picture is the same as that of an image before, and that image's row."""


def stop_ground(solution: Solution, stop: int, twice: Mapping[int, int] | None = None) -> StopGround:
    """Origin, views and surfaces of a stop, by row; `twice` is what `same_pictures` gives, if it is known.

    Raises InputError where no camera has a pose.
    """
    views = {p: view_from_stop(solution, stop, p) for p in POINTINGS}
    centres = views["refined"].world_t_camera[solution.traverse.image_stop == stop]
    centres = centres[np.isfinite(centres).all(axis=1)]
    if not len(centres):
        name = solution.traverse.stops[stop].id
        raise InputError(f"mosaic: stop {name}: expected a camera with a pose, found none")
    origin_m = centres.mean(axis=0)
    surfaces = {p: surface_of_stop(solution, stop, origin_m, v) for p, v in views.items()}
    twice = same_pictures(solution.traverse) if twice is None else twice
    return StopGround(origin_m=origin_m, views=views, surfaces=surfaces, twice=twice)


def make_mosaics(
    solution: Solution,
    stop: str,
    camera: str,
    options: MosaicOptions = MosaicOptions(),  # noqa: B008  frozen
    *,
    ground: StopGround | None = None,
) -> StopMosaics:
    """Mosaics of the images that an eye took at a stop, with telemetry's and with the refined pointing.

    Both show the surface that the adjusted landmarks span, with the same exposures, seams and contrast, so
    that only the pointing differs. Image files are read from the traverse's folder. `ground` is what
    `stop_ground` gives, if it is known.

    Raises InputError for a stop or a camera that is not in the traverse, and where no image can be shown.
    """
    options = options_of(MosaicOptions, options, "make_mosaics")
    traverse = solution.traverse
    stops = {s.id: row for row, s in enumerate(traverse.stops)}
    if stop not in stops:
        raise InputError(f"mosaic: stop: expected the id of a stop, found {stop!r}")
    shared = ground or stop_ground(solution, stops[stop])
    eye = traverse.rig.eye_index(camera)
    images, warnings = placed_images(solution, stops[stop], eye, shared.views, shared.twice)
    if not images:
        more = f"; {len(warnings) - 1} more" if len(warnings) > 1 else ""
        why = f" ({warnings[0]}{more})" if warnings else ""
        raise InputError(
            f"mosaic: stop {stop}, camera {camera}: expected image files, found none that serve{why}"
        )
    surface = shared.surfaces["refined"]
    native = native_px_per_degree(images)
    around = _cylinder(images, surface, options, native)
    panorama, overview, evening = _mosaic(images, surface, around)
    if panorama is None or evening is None:
        raise InputError(f"mosaic: stop {stop}, camera {camera}: expected images with data, found none")
    square = Ground.around(shared.origin_m, options.ground_radius_m, options.ground_m_per_px)
    above, _, _ = _mosaic(images, surface, square, evening)
    return StopMosaics(
        stop=stop,
        camera=camera,
        images=tuple(image.id for image in images),
        cylinder=panorama,
        ground=above,
        seams=seam_error(images, shared.surfaces, overview, native),
        evening=evening,
        warnings=tuple(warnings),
    )


def _mosaic(
    images: Sequence[PlacedImage],
    surface: Surface,
    projection: Projection,
    evening: Evening | None = None,
) -> tuple[Mosaic | None, Lattice, Evening | None]:
    """A mosaic (None where no image shows any of it), its lattice, and gains and vignetting.

    Gains and vignetting are estimated, unless they are given.
    """
    lattice = Lattice.over(projection, surface)
    layers = _layers(images, "refined", lattice)
    if not layers:
        return None, lattice, evening
    look = choose_look(layers, projection.height_px, projection.width_px, evening)
    blended = {"refined": blend(layers, look)}
    del layers
    blended["telemetry"] = blend(_layers(images, "telemetry", lattice), look)
    samples = None
    if any(image.grey.dtype != np.uint8 for image in images):
        samples = {p: _to_16_bits(blended[p]) for p in POINTINGS}
    mosaic = Mosaic(
        projection=projection,
        pictures={p: look.to_8_bits(blended[p]) for p in POINTINGS},
        samples=samples,
        dark=look.dark,
        bright=look.bright,
    )
    return mosaic, lattice, look.evening


def _to_16_bits(blended: NDArray[np.float32]) -> NDArray[np.uint16]:
    there = ~np.isnan(blended)
    return np.where(there, np.clip(np.rint(np.nan_to_num(blended)), 1, 65535), 0).astype(np.uint16)


def _layers(images: Sequence[PlacedImage], pointing: Pointing, lattice: Lattice) -> list[tuple[int, Layer]]:
    return [(n, layer) for n, image in enumerate(images) for layer in warp(image, pointing, lattice)]


def _cylinder(
    images: Sequence[PlacedImage], surface: Surface, options: MosaicOptions, native: float
) -> Cylinder:
    """The cylinder that just holds all images, with both pointings."""
    sphere = _sphere(images, surface.origin_m, native)
    lattice = Lattice.over(sphere, surface)
    seen: BoolArray = np.any([lattice.seen_by(image.at[p])[1] for image in images for p in POINTINGS], axis=0)
    rows, cell_deg = np.flatnonzero(seen.any(axis=1)), STEP_PX / sphere.px_per_degree
    start, gap = largest_gap(np.any(seen[:, : sphere.width_px // STEP_PX], axis=0))
    left_deg = sphere.left_deg - (start + gap) * cell_deg
    top_deg = sphere.top_deg - float(rows[0]) * cell_deg
    height_deg = min((int(rows[-1] - rows[0]) + 1) * cell_deg, top_deg + 90)
    width_deg = 360 - gap * cell_deg
    # The cells that images see bound the mosaic to a few cells; drawing it once bounds it to the pixel.
    scale = min(options.px_per_degree or native, options.max_width_px / max(width_deg, height_deg))
    rough = _part(surface.origin_m, scale, left_deg, width_deg, top_deg, height_deg, closed=gap == 0)
    lattice = Lattice.over(rough, surface)
    layers = [layer for p in POINTINGS for _, layer in _layers(images, p, lattice)]
    if not layers:
        return rough
    first_row = min(layer.top_px for layer in layers)
    last_row = max(layer.top_px + layer.grey.shape[0] for layer in layers)
    top_deg = rough.top_deg - first_row / scale
    height_deg = (last_row - first_row) / scale
    if not rough.closed:
        first = min(layer.left_px for layer in layers)
        last = max(layer.left_px + layer.grey.shape[1] for layer in layers)
        left_deg, width_deg = rough.left_deg - first / scale, (last - first) / scale
    scale = min(options.px_per_degree or native, options.max_width_px / max(width_deg, height_deg))
    return _part(surface.origin_m, scale, left_deg, width_deg, top_deg, height_deg, closed=rough.closed)


def _sphere(images: Sequence[PlacedImage], origin_m: FloatArray, native: float) -> Cylinder:
    """All directions, with cells of the lattice that are small beside an image."""
    camera = images[0].at["refined"].camera
    field_deg = min(camera.width_px, camera.height_px) / native
    cells = int(np.ceil(360 / min(_COARSEST_CELL_DEG, field_deg / _CELLS_PER_FIELD)))
    return _part(origin_m, STEP_PX * cells / 360, 180.0, 360.0, 90.0, 180.0, closed=True)


def _part(
    origin_m: FloatArray,
    scale: float,
    left_deg: float,
    width_deg: float,
    top_deg: float,
    height_deg: float,
    *,
    closed: bool,
) -> Cylinder:
    """A cylinder of about the given scale; one that goes round has a whole number of lattice cells."""
    if closed:
        width = max(STEP_PX * int(360 * scale / STEP_PX), STEP_PX)
        scale, left_deg = width / 360, 180.0
    else:
        width = max(int(width_deg * scale), 2)
    return Cylinder(
        origin_m=origin_m,
        width_px=width,
        height_px=max(int(height_deg * scale), 2),
        px_per_degree=scale,
        left_deg=left_deg,
        top_deg=top_deg,
    )
