"""Options of terrain."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.errors import InputError

__all__ = ["TerrainOptions"]


@dataclass(frozen=True, kw_only=True)
class TerrainOptions:
    """How fine and how large surfaces are. Raises InputError for a number that is not above 0."""

    cell_m: float | None = None
    """Side of a cell of the finest grid; None: as far as points lie apart on the ground 6 m from the mast.
    Grids with larger cells go on where points lie too far apart for it."""
    reach_m: float = 100.0
    """Ground farther than this from the mast of its frame is left out."""
    fill_m: float = 0.0
    """Holes up to this width are filled from what surrounds them, with a count of 0; 0: none is."""
    most_cloud_points: int = 4_000_000
    """Points of a cloud; of more, some are left out evenly."""
    most_mesh_cells: int = 250_000
    """Cells of the mesh; of more, the mesh is coarser than the grid."""

    ply: bool = False
    """Whether clouds are written as PLY beside LAZ."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("cell_m", "reach_m", "most_cloud_points", "most_mesh_cells"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise InputError(f"terrain: {name}: expected a number above 0, found {value}")
        if not 0 <= self.fill_m < np.inf:
            raise InputError(f"terrain: fill_m: expected a width of 0 or more, found {self.fill_m}")
