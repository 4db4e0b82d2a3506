"""Products of one exposure: archives have an image raw, calibrated, scaled and linearised, each as a file.

They are one measurement. Taken for several, they would agree with each other far better than two images of
one scene do, and every sigma would be too small.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from pancam_graph.cameras import CAHV
from pancam_graph.io._labelled_image import LabelledImage

__all__ = ["Exposures", "one_of_each_exposure"]

_NAMED = 5
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
    """The best product of each exposure: one spacecraft, instrument and start of the clock.

    Best is raw geometry before linearised, then more pixels, more bits, and radiometric correction. Products
    whose first line or sample differ are tiles of the exposure, which show different things, and are all
    kept; so is an image whose label has no SPACECRAFT_CLOCK_START_COUNT.
    """
    products: dict[tuple[object, ...], list[LabelledImage]] = {}
    for image in images:
        products.setdefault(_exposure(image), []).append(image)
    left_out: set[str] = set()
    warnings: list[str] = []
    for same in products.values():
        best, *others = sorted(same, key=_rank)
        if others:
            names = sorted(image.file.name for image in others)
            left_out |= set(names)
            warnings.append(
                f"{best.file.name}: used of {len(same)} products of one exposure; left out: "
                f"{', '.join(names)}"
            )
    more = len(warnings) - _NAMED
    if more > 0:
        warnings[_NAMED:] = [f"{more} more exposures have several products, of which one each is used"]
    kept = tuple(image for image in images if image.file.name not in left_out)
    return Exposures(images=kept, warnings=tuple(warnings))


def _exposure(image: LabelledImage) -> tuple[object, ...]:
    if image.clock_start is None:
        return (image.file,)
    return image.host, image.instrument, image.clock_start, image.first_line_sample


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
