"""Terrain as the report shows it: small pictures, and heights coarse enough for a page."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.charts import Picture, encoded
from pancam_graph.terrain._fused import Fused
from pancam_graph.terrain._grid import Grid
from pancam_graph.terrain._pictures import hillshade_grey, on_paper
from pancam_graph.terrain._section import Section

__all__ = ["Relief", "ShownSurface", "WrittenTerrain", "shown_surface"]

_MOST_NODES = 400
"""Rows and columns of the heights of a page; a grid of more is averaged over blocks of cells."""
_WIDEST_PX = 1000
_QUALITY = 82

Relief = Literal["refined", "telemetry", "orthoimage"]
"""A picture of a surface: lit, with either pointing, or as the cameras see it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownSurface:
    """One surface of terrain."""

    title: str
    files: dict[str, str]
    """Names of its files by kind, relative to the folder of the terrain."""
    grid: Grid
    """Where the heights below lie; its cells are blocks of those of the files."""
    refined_m: NDArray[np.float32]
    """(rows, columns) heights; NaN where nothing is seen."""
    telemetry_m: NDArray[np.float32]
    """(rows, columns) heights with telemetry's pointing; NaN where not known."""
    sigma_m: NDArray[np.float32]
    """(rows, columns) typical standard deviation of a height in the files."""
    jpeg: dict[Relief, bytes]
    """Pictures of one size, which cover the grid of the files; telemetry's only where it is known."""
    width_px: int
    height_px: int
    wide_m: float
    """What the pictures cover along x, and below along y, from the upper left corner of the grid."""
    high_m: float


@dataclass(frozen=True, kw_only=True, eq=False)
class WrittenTerrain:
    """What `write_terrain` wrote, for the report and for the list of warnings."""

    surfaces: tuple[ShownSurface, ...]
    """The drive, then its stops; of a drive of one stop the drive alone."""
    lines: tuple[str, ...]
    """What was found, in words."""
    section: Section | None
    frame_ids: tuple[str, ...]
    """Id of each frame of the traverse."""
    warnings: tuple[str, ...]


def shown_surface(fused: Fused, grey: NDArray[np.uint8], title: str, files: dict[str, str]) -> ShownSurface:
    """What a page needs of a surface. `grey` (rows, columns) is its orthoimage, 0 where nothing is seen."""
    cell_m = fused.grid.cell_m
    block = max(1, -(-max(fused.grid.rows, fused.grid.columns) // _MOST_NODES))
    pictures: dict[Relief, Picture] = {
        "refined": hillshade_grey(fused.height_m, cell_m),
        "orthoimage": on_paper(np.repeat(grey[..., None], 3, axis=-1), grey > 0),
    }
    if np.isfinite(fused.telemetry_m).any():
        pictures["telemetry"] = hillshade_grey(fused.telemetry_m, cell_m)
    scale = min(1.0, _WIDEST_PX / max(fused.grid.rows, fused.grid.columns))
    size = max(1, round(fused.grid.columns * scale)), max(1, round(fused.grid.rows * scale))
    coarse = _means((fused.height_m, fused.telemetry_m, fused.sigma_m), block)
    return ShownSurface(
        title=title,
        files=files,
        grid=Grid(
            left_m=fused.grid.left_m,
            top_m=fused.grid.top_m,
            cell_m=cell_m * block,
            rows=coarse[0].shape[0],
            columns=coarse[0].shape[1],
        ),
        refined_m=coarse[0],
        telemetry_m=coarse[1],
        sigma_m=coarse[2],
        jpeg={
            kind: encoded(
                np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8),
                ".jpg",
                _QUALITY,
            )
            for kind, picture in pictures.items()
        },
        width_px=size[0],
        height_px=size[1],
        wide_m=fused.grid.columns * cell_m,
        high_m=fused.grid.rows * cell_m,
    )


def _means(bands: Sequence[NDArray[np.float32]], block: int) -> list[NDArray[np.float32]]:
    """Means over blocks of cells, of those that have a value; NaN where none has."""
    rows, columns = bands[0].shape
    filled = -rows % block, -columns % block
    out = []
    for band in bands:
        wider = np.pad(band, ((0, filled[0]), (0, filled[1])), constant_values=np.nan)
        blocks = wider.reshape(wider.shape[0] // block, block, wider.shape[1] // block, block)
        seen = np.isfinite(blocks)
        count = seen.sum(axis=(1, 3))
        total = np.where(seen, blocks, 0).sum(axis=(1, 3), dtype=np.float64)
        out.append(np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32))
    return out
