"""Windows of a detector: subframes, and the tiles in which one exposure is sent, as images of one camera.

The camera model of a label is in the pixels of its own picture. Windows of one detector differ by the place
of the first pixel alone, so calibration, mount and smooth field are those of one eye.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pancam_graph.data import Tile
from pancam_graph.io._labelled_image import LabelledImage
from pancam_graph.io._pds_exposures import exposure_key
from pancam_graph.io._picture_size import MAX_PIXELS
from pancam_graph.io._template_cameras import subframed

__all__ = ["SAME_PRINCIPAL_POINT_PX", "on_detectors", "same_focal_lengths"]

SAME_PRINCIPAL_POINT_PX = 1.0
"""Pixels by which principal points of one eye may differ from label to label."""
_SAME_FOCAL = 2e-4
_AVERAGED = (1, 2, 4, 8)
"""Pixels of a detector along the side of a picture's pixel: labels count lines and samples in the former."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Window:
    image: LabelledImage
    left_px: int
    top_px: int
    """Place of its first pixel from that of the detector's first window, in its own pixels."""


def same_focal_lengths(one: LabelledImage, other: LabelledImage) -> bool:
    """Whether images are of one instrument, type of camera model and focal length."""
    a, b = one.model, other.model
    return (
        (one.host, one.instrument, type(a)) == (other.host, other.instrument, type(b))
        and abs(a.fx_px / b.fx_px - 1) < _SAME_FOCAL
        and abs(a.fy_px / b.fy_px - 1) < _SAME_FOCAL
    )


def on_detectors(images: Sequence[LabelledImage], root: Path) -> tuple[LabelledImage, ...]:
    """The images with windows of one detector in the pixels of the smallest picture that holds them all.

    Tiles are named by their way from the folder `root`.

    A window is told by two things that must agree to a pixel: its first line and sample, and the principal
    point of its camera model. Windows of one exposure become one image, in the place of the first. What is no
    window of the same detector as another image stays as it is, and so do all where the picture would have
    more than `MAX_PIXELS`.
    """
    detectors: list[list[_Window]] = []
    for image in images:
        for windows in detectors:
            window = _window(windows[0].image, image)
            if window is not None:
                windows.append(window)
                break
        else:
            detectors.append([_Window(image=image, left_px=0, top_px=0)])
    put = {id(w.image): image for windows in detectors for w, image in _on_one_detector(windows, root)}
    return tuple(put[id(image)] for image in images if id(image) in put)


def _window(first: LabelledImage, image: LabelledImage) -> _Window | None:
    """The image as a window of the detector of another; None where it is none."""
    if not same_focal_lengths(first, image):
        return None
    a, b = first.model, image.model
    moved = np.array([a.cx_px - b.cx_px, a.cy_px - b.cy_px])
    told = np.subtract(image.first_line_sample, first.first_line_sample)[::-1]
    for averaged in _AVERAGED:
        left_px, top_px = told // averaged
        whole = not (told % averaged).any()
        if whole and np.abs(moved - (left_px, top_px)).max() < SAME_PRINCIPAL_POINT_PX:
            return _Window(image=image, left_px=int(left_px), top_px=int(top_px))
    return None


def _on_one_detector(windows: Sequence[_Window], root: Path) -> list[tuple[_Window, LabelledImage]]:
    """Each exposure of a detector, with the first of its windows."""
    left, top = min(w.left_px for w in windows), min(w.top_px for w in windows)
    width = max(w.left_px + w.image.model.width_px for w in windows) - left
    height = max(w.top_px + w.image.model.height_px for w in windows) - top
    if width * height > MAX_PIXELS:
        return [(w, w.image) for w in windows]
    exposures: dict[tuple[object, ...], list[_Window]] = {}
    for window in windows:
        exposures.setdefault(exposure_key(window.image), []).append(window)
    found: list[tuple[_Window, LabelledImage]] = []
    for parts in exposures.values():
        first = parts[0]
        model = first.image.model
        if (model.width_px, model.height_px) == (width, height) and len(parts) == 1:
            found.append((first, first.image))
            continue
        whole = subframed(model, width, height, left_px=left - first.left_px, top_px=top - first.top_px)
        tiles = tuple(
            Tile(file=w.image.way_from(root), left_px=w.left_px - left, top_px=w.top_px - top) for w in parts
        )
        found.append((first, replace(first.image, model=whole, tiles=tiles)))
    return found
