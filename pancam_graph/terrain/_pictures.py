"""Hillshade and slope of a surface, as pictures with axes and a bar for scale."""

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.charts import INK, STEPS, Axis, Picture, framed, write_over
from pancam_graph.terrain._fused import Fused

__all__ = ["hillshade", "hillshade_grey", "hillshade_picture", "on_paper", "slope_deg", "slope_picture"]

_EMPTY = (228, 228, 228)
_LIGHT_AZIMUTH, _LIGHT_HEIGHT = np.deg2rad(135.0), np.deg2rad(45.0)
"""Where the light comes from: anticlockwise from x, that is from the upper left, and above the ground."""
_WIDEST_PX = 1600
_BAR_SHARE = 0.2
_STEEPEST_DEG = 40.0


def _slopes(height_m: NDArray[np.float32], cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Change of height a metre along x and y (rows, columns); NaN beside holes."""
    along_x, along_y = np.full(height_m.shape, np.nan), np.full(height_m.shape, np.nan)
    along_x[:, 1:-1] = (height_m[:, 2:] - height_m[:, :-2]) / (2 * cell_m)
    along_y[1:-1] = (height_m[:-2] - height_m[2:]) / (2 * cell_m)
    return along_x, along_y


def hillshade(height_m: NDArray[np.float32], cell_m: float) -> FloatArray:
    """Cosine (rows, columns) of the angle between normals and the light, 0 at least; NaN in holes."""
    along_x, along_y = _slopes(height_m, cell_m)
    level = np.cos(_LIGHT_HEIGHT)
    light = level * np.cos(_LIGHT_AZIMUTH), level * np.sin(_LIGHT_AZIMUTH), np.sin(_LIGHT_HEIGHT)
    shade = (light[2] - along_x * light[0] - along_y * light[1]) / np.sqrt(1 + along_x**2 + along_y**2)
    return np.asarray(np.maximum(shade, 0.0))


def slope_deg(height_m: NDArray[np.float32], cell_m: float) -> FloatArray:
    """Angle (rows, columns) of the surface against the horizontal; NaN in holes."""
    return np.asarray(np.rad2deg(np.arctan(np.hypot(*_slopes(height_m, cell_m)))))


def hillshade_grey(height_m: NDArray[np.float32], cell_m: float) -> Picture:
    """The surface lit from the upper left (rows, columns, 3); holes have the colour of an empty page."""
    shade = hillshade(height_m, cell_m)
    grey = np.clip(20 + 235 * np.nan_to_num(shade), 0, 255).astype(np.uint8)
    return on_paper(np.repeat(grey[..., None], 3, axis=-1), np.isfinite(shade))


def on_paper(coloured: Picture, seen: NDArray[np.bool_]) -> Picture:
    """A picture (rows, columns, 3) with the colour of an empty page where nothing is seen (rows, columns)."""
    return np.where(seen[..., None], coloured, np.array(_EMPTY, dtype=np.uint8)).astype(np.uint8)


def hillshade_picture(fused: Fused, title: str) -> Picture:
    """The surface lit from the upper left, with axes."""
    picture = hillshade_grey(fused.height_m, fused.grid.cell_m)
    return _page(fused, picture, f"{title}: lit from the upper left, 45 degrees high")


def slope_picture(fused: Fused, title: str) -> Picture:
    """The slope of the surface in colours, from level (dark) to steep (bright)."""
    slope = slope_deg(fused.height_m, fused.grid.cell_m)
    scaled = np.clip(np.nan_to_num(slope) * (255 / _STEEPEST_DEG), 0, 255).astype(np.uint8)
    coloured = np.asarray(cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    says = f"{title}: slope, dark 0 to bright {_STEEPEST_DEG:.0f} degrees or more"
    return _page(fused, on_paper(coloured, np.isfinite(slope)), says)


def _page(fused: Fused, picture: Picture, title: str) -> Picture:
    grid = fused.grid
    scale = min(1.0, _WIDEST_PX / max(grid.rows, grid.columns))
    size = max(1, round(grid.columns * scale)), max(1, round(grid.rows * scale))
    picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    x, y = grid.middles()
    across = Axis.of(x[[0, -1]], size[0] / grid.columns, grid.columns)
    down = Axis.of(y[[0, -1]], size[1] / grid.rows, grid.rows)
    _draw_bar(picture, scale / grid.cell_m)
    return framed(picture, across, down, ("world x, metres", "world y, metres"), title)


def _draw_bar(picture: Picture, px_per_m: float) -> None:
    """A bar of a round length in the lower left corner, and how long it is."""
    height, width = picture.shape[:2]
    length = max((s for s in STEPS if s * px_per_m <= _BAR_SHARE * width), default=STEPS[0])
    right, bottom = 16 + round(length * px_per_m), height - 16
    cv2.rectangle(picture, (16, bottom - 6), (right, bottom), (255, 255, 255), cv2.FILLED)
    cv2.rectangle(picture, (16, bottom - 6), (right, bottom), INK, 1)
    write_over(picture, f"{length:g} m", np.array([(16 + right) / 2, bottom - 22.0]))
