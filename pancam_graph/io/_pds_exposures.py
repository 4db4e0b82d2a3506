"""Products of one exposure: archives have an image raw, calibrated, scaled and linearised, each as a file.

They are one measurement. Taken for several, they would agree with each other far better than two images of
one scene do, and every sigma would be too small.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pancam_graph.cameras import CAHV
from pancam_graph.io._labelled_image import LabelledImage

__all__ = ["Exposures", "exposure_key", "one_of_each_exposure"]

_NAMED = 5
_FAR_M = 100.0
_TYPE = re.compile(r"(?:[12][A-Z]|[A-Z]{2}[A-Z0-9]_)\d{9}(?:_\d{3})?_?([A-Z]{3})")
"""Product type in the names of MER, MSL and Mars 2020, behind the clock."""
_TYPES = ("RAD", "MRD", "RAS", "ILF", "ILT")
"""Radiometrically corrected products, best first; then those whose companding is undone."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposures:
    """Images of different exposures, and what is said of the products that were left out."""

    images: tuple[LabelledImage, ...]
    """One of each exposure, in the order in which they were given."""
    warnings: tuple[str, ...]


def one_of_each_exposure(images: Sequence[LabelledImage]) -> Exposures:
    """The best product of each exposure: one spacecraft, camera and clock, one part of the detector.

    Best is raw geometry before linearised, then more pixels, more bits, and radiometric correction. Images of
    one exposure of which neither sees the middle of the other are tiles, which show different things, and are
    all kept; so is an image whose label has no clock.
    """
    products: dict[tuple[object, ...], list[LabelledImage]] = {}
    for image in images:
        products.setdefault(exposure_key(image), []).append(image)
    kept: list[LabelledImage] = []
    warnings: list[str] = []
    for same in products.values():
        used: dict[Path, list[str]] = {}
        best: list[LabelledImage] = []
        for image in sorted(same, key=_rank):
            other = next((better for better in best if _show_the_same(better, image)), None)
            if other is None:
                best.append(image)
            else:
                used.setdefault(other.file, []).append(image.file.name)
        kept += best
        warnings += [
            f"{file.name}: used of {len(names) + 1} products of one exposure; "
            f"left out: {', '.join(sorted(names))}"
            for file, names in used.items()
        ]
    more = len(warnings) - _NAMED
    if more > 0:
        warnings[_NAMED:] = [f"{more} more exposures have several products, of which one each is used"]
    chosen = set(map(id, kept))
    return Exposures(images=tuple(i for i in images if id(i) in chosen), warnings=tuple(warnings))


def exposure_key(image: LabelledImage) -> tuple[object, ...]:
    """What images of one exposure have in common: spacecraft, camera and clock; without a clock, the file."""
    if image.clock_start is None:
        return (image.file,)
    return image.host, _camera(image), image.clock_start


def _camera(image: LabelledImage) -> str:
    """The camera without what labels of one camera may or may not add: NAVCAM_LEFT, NAV_LEFT_B."""
    return image.instrument.replace("NAVCAM", "NAV")


def _show_the_same(one: LabelledImage, other: LabelledImage) -> bool:
    """Whether one image of an exposure sees the middle of the other; tiles overlap by a few pixels."""
    return _sees_middle(one.model, other.model) or _sees_middle(other.model, one.model)


def _sees_middle(camera: CAHV, other: CAHV) -> bool:
    middle = np.array([[(other.width_px - 1) / 2, (other.height_px - 1) / 2]])
    rays = other.unproject(middle)
    pixel, valid = camera.project(rays.origin_m + _FAR_M * rays.direction)
    size = np.array([camera.width_px, camera.height_px])
    return bool(valid[0] and (pixel[0] >= -0.5).all() and (pixel[0] < size - 0.5).all())


def _rank(image: LabelledImage) -> tuple[object, ...]:
    """Best first; the name decides among equals."""
    name = image.file.name
    match = _TYPE.match(name.upper())
    kind = match[1] if match is not None else ""
    model = image.model
    return (
        type(model) is CAHV,  # linearised
        -model.width_px * model.height_px,
        -image.sample_bits,
        _TYPES.index(kind) if kind in _TYPES else len(_TYPES),
        name,
    )
