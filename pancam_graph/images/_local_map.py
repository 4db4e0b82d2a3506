"""How a pixel of one image moves with that of another over a patch: to second order."""

from collections.abc import Callable

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray

__all__ = ["HALF_WIDTH_PX", "local_map"]

HALF_WIDTH_PX = 6
"""Half width of a patch in its first image: it has 2 HALF_WIDTH_PX + 1 pixels to a side."""


def local_map(moved: Callable[[float, float], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """First (n, 2, 2) and second derivatives (n, 2, 3: uu, uv, vv) of a map of n patches, over their width.

    `moved(du, dv)` is where the map takes the pixels (n, 2) that lie by that beside the patches' middles.
    Second derivatives are 0 where the map is not defined over the whole patch.
    """
    h = float(HALF_WIDTH_PX)
    middle, near = moved(0.0, 0.0), [moved(*d) for d in ((-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))]
    affine = np.stack([near[1] - near[0], near[3] - near[2]], axis=-1) / 2
    left, right, up, down = (moved(*d) for d in ((-h, 0.0), (h, 0.0), (0.0, -h), (0.0, h)))
    corners = moved(h, h) + moved(-h, -h) - moved(h, -h) - moved(-h, h)
    second = [left + right - 2 * middle, corners / 4, up + down - 2 * middle]
    bend = np.stack(second, axis=-1) / h**2
    whole: BoolArray = np.asarray(np.isfinite(bend).all(axis=(1, 2)))
    return affine, np.where(whole[:, None, None], bend, 0.0)
