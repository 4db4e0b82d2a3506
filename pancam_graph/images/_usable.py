"""Which pixels of images may be used."""

from collections.abc import Callable

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray

__all__ = ["on_terrain", "pixels_at", "rows_by_image"]


def pixels_at(usable: BoolArray, uv_px: FloatArray) -> BoolArray:
    """Whether pixels (n, 2) are usable; one outside the image counts as the nearest inside."""
    height, width = usable.shape
    u, v = np.rint(uv_px).astype(np.int64).T
    return np.asarray(usable[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)])


def on_terrain(usable: Callable[[int], BoolArray], image: IntArray, uv_px: FloatArray) -> BoolArray:
    """Which pixels (n, 2) of images (n,) show terrain."""
    shows = np.zeros(len(image), dtype=bool)
    for i, rows in rows_by_image(image).items():
        shows[rows] = pixels_at(usable(i), uv_px[rows])
    return shows


def rows_by_image(image: IntArray) -> dict[int, IntArray]:
    """Rows (ascending) of a column of images (n,), by the image."""
    order = np.argsort(image, kind="stable")
    images, begin = np.unique(image[order], return_index=True)
    return dict(zip(images.tolist(), np.split(order, begin)[1:], strict=True))
