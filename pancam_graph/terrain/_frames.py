"""What single stereo frames see, found in this process or by the workers of a cluster."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.images import Cache, ImageMask, Masks, for_workers, key_of
from pancam_graph.terrain._drive import Drive, Pair
from pancam_graph.terrain._grid import Layer
from pancam_graph.terrain._levels import Level
from pancam_graph.terrain._surface import Points, surface_of

__all__ = ["SURFACE", "Frames", "Seen"]

SURFACE = "surface"
"""The kind of what a cache keeps of a frame."""
_LEFT_OUT = "left_out"
_BANDS = ("height_m", "variance_m2", "grey", "shared_m2")


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What one frame gave: its layer with each pointing, and its points."""

    pair: Pair
    refined: tuple[Layer | None, ...]
    """By level of the grid; None where the frame sees nothing of it."""
    telemetry: tuple[Layer | None, ...]
    points: Points

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything but the pair as arrays, for the cache."""
        arrays: dict[str, NDArray[Any]] = {f"points_{n}": column for n, column in vars(self.points).items()}
        arrays["levels"] = np.array(len(self.refined))
        for pointing, layers in (("refined", self.refined), ("telemetry", self.telemetry)):
            for k, layer in enumerate(layers):
                if layer is not None:
                    name = f"{pointing}_{k}"
                    arrays[f"{name}_first"] = np.array([layer.first_row, layer.first_column])
                    bands = {f"{name}_{band}": getattr(layer, band) for band in _BANDS}
                    arrays |= {n: band for n, band in bands.items() if band is not None}
        return arrays

    @staticmethod
    def of_arrays(pair: Pair, arrays: Mapping[str, NDArray[Any]]) -> "Seen":
        """The inverse of `arrays`."""

        def layer(name: str) -> Layer | None:
            if f"{name}_first" not in arrays:
                return None
            row, column = arrays[f"{name}_first"].tolist()
            bands = {band: arrays[f"{name}_{band}"] for band in _BANDS if f"{name}_{band}" in arrays}
            return Layer(frame=pair.frame, first_row=row, first_column=column, **bands)

        refined, telemetry = (
            tuple(layer(f"{pointing}_{k}") for k in range(int(arrays["levels"])))
            for pointing in ("refined", "telemetry")
        )
        points = {n.removeprefix("points_"): a for n, a in arrays.items() if n.startswith("points_")}
        return Seen(pair=pair, refined=refined, telemetry=telemetry, points=Points(**points))


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """The stereo frames of a drive, and how they are drawn."""

    drive: Drive
    levels: tuple[Level, ...]
    reach_m: float
    every: int
    """One point of so many goes into clouds."""
    masks: Masks

    def __getstate__(self) -> dict[str, Any]:
        """Without what no worker needs, and with paths that hold in any folder."""
        drive = replace(self.drive, traverse=for_workers(self.drive.traverse))
        return {name: getattr(self, name) for name in ("levels", "reach_m", "every", "masks")} | {
            "drive": drive
        }

    @cached_property
    def _telemetry(self) -> tuple[FloatArray, FloatArray]:
        return self.drive.telemetry()

    def seen(self, pair: Pair) -> Seen | str | None:
        """What a frame sees; why it is left out; None where it sees no ground within reach."""
        frame = self.drive.traverse.frames[pair.frame].id
        left, right = _usable(self.masks[pair.left]), _usable(self.masks[pair.right])
        if left is None or right is None:
            return f"terrain: frame {frame} is left out: a picture cannot be used"
        try:
            surface = surface_of(self.drive, pair, (left, right), self.reach_m)
        except ImageError as error:
            return f"terrain: frame {frame} is left out: {error}"
        refined, before = (
            tuple(
                surface.layer(level.grid, (level.nearest_m, level.farthest_m), move) for level in self.levels
            )
            for move in (None, self._to_telemetry(pair))
        )
        if all(layer is None for layer in refined):
            return None
        points = surface.points(self.reach_m, self.every)
        return Seen(pair=pair, refined=refined, telemetry=before, points=points)

    def kept(self, pair: Pair, cache: Cache) -> Seen | str | None:
        """The same, from a cache where it is there."""

        def make() -> dict[str, NDArray[Any]]:
            found = self.seen(pair)
            if isinstance(found, Seen):
                return found.arrays()
            return {_LEFT_OUT: np.array(found or "")}

        arrays = cache.recall(SURFACE, self._key(pair), make)
        if _LEFT_OUT in arrays:
            return str(arrays[_LEFT_OUT]) or None
        return Seen.of_arrays(pair, arrays)

    def _key(self, pair: Pair) -> str:
        """A digest of all that a frame's surface depends on."""
        drive, rows = self.drive, [pair.left, pair.right]
        telemetry = [part[rows] for part in self._telemetry]
        shared = drive.stereo and (drive.stereo.depth_m, drive.stereo.of(pair.left, pair.right))
        return key_of(
            SURFACE,
            (surface_of, *(type(drive.cameras[row]) for row in rows)),
            (__name__,),
            vars(pair),
            [drive.cameras[row] for row in rows],
            drive.world_R_camera[rows],
            drive.world_t_camera[rows],
            telemetry,
            drive.own_tilt_sigma_rad[pair.frame],
            shared,
            drive.traverse.rig.mast_height_m,
            [self.masks.digest_of(row) for row in rows],
            drive.traverse.frames[pair.frame].id,
            self.levels,
            self.reach_m,
            self.every,
        )

    def _to_telemetry(self, pair: Pair) -> tuple[FloatArray, FloatArray]:
        """From the refined world to telemetry's: where the left camera would have put its points."""
        i, (R, t) = pair.left, self._telemetry
        turn = R[i] @ self.drive.world_R_camera[i].T
        return turn, t[i] - turn @ self.drive.world_t_camera[i]


def _usable(mask: ImageMask | None) -> BoolArray | None:
    return None if mask is None else mask.usable(between_stops=True)
