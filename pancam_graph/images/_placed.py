"""Steps that follow those within stops: terrain of stops, each by itself, and ties between two of them.

No stop waits for all others: a few tell the rig, those of a group (see `Steps.groups`) are solved alone with
it, and two of them are tied once both are placed. Memory holds what a few stops need.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import Observations, Traverse
from pancam_graph.images._alignment import Ties
from pancam_graph.images._between import StopMatcher, StopTies, agreeing
from pancam_graph.images._cache import Arrays, key_of
from pancam_graph.images._held import Held
from pancam_graph.images._splines import Splines
from pancam_graph.images._steps import Steps
from pancam_graph.images._terrain import (
    StopTerrain,
    of_stops,
    rig_arrays,
    rig_from,
    terrain_arrays,
    terrain_from,
    unplaced_arrays,
)
from pancam_graph.images._usable import on_terrain
from pancam_graph.rigs import RigUncertainty
from pancam_graph.solve import SolveOptions, solve

__all__ = ["PlacedStops", "TiedTracks", "placed_key"]

_LOG = logging.getLogger(__name__)
_HELD_BYTES = 32 << 20
_RIG_GROUPS = 4
"""Groups whose observations together tell the rig that all stops are placed with: more hardly tell it better,
and memory holds the observations of all of them."""
_COLUMNS = ("image", "uv_px", "sigma_px", "covariance_px2")
_CALLS: dict[str, tuple[Callable[..., Any], ...]] = {
    "rig": (solve, of_stops),
    "terrain": (solve, of_stops, on_terrain),
    "ties": (Splines, terrain_from, on_terrain, StopMatcher),
}


def placed_key(kind: str, *inputs: Any) -> str:
    """The key of a step with these inputs. Of this module and that of `Steps` only their own text counts."""
    return key_of(kind, _CALLS[kind], (__name__, Steps.__module__), *inputs)


@dataclass(frozen=True, kw_only=True, eq=False)
class TiedTracks:
    """What images of other stops see of the tracks of one group: n observations as columns."""

    image: IntArray
    """(n,) row of the image in the drive."""
    track: IntArray
    """(n,) number of the track in the group."""
    uv_px: FloatArray
    """(n, 2)"""
    covariance_px2: FloatArray
    """(n, 2, 2)"""


@dataclass(frozen=True, eq=False)
class PlacedStops:
    """The terrain of stops, each by itself, to be sought in the images of others.

    Several threads may ask at once. Another process gets it by pickling, without what memory holds.
    """

    work: Steps
    """The steps within stops; with the plan of the drive."""

    def __getstate__(self) -> dict[str, Any]:
        """The steps alone: all else follows from them."""
        return {"work": self.work}

    def plan(self) -> None:
        """Find out what all steps need to know of the drive as a whole, so that threads may ask for items."""
        self.work.plan()
        self.group_of, self._terrains, self._keys  # noqa: B018  made when asked for

    @cached_property
    def group_of(self) -> dict[int, int]:
        """The group of each stop that is tied to another."""
        stop, tied = self.work.traverse.image_stop, {s for pair in self.work.stop_pairs for s in pair}
        groups = {
            int(stop[row]): group
            for group in range(len(self.work.groups))
            for row in self.work.rows_of(group)
        }
        return {s: groups[s] for s in sorted(tied)}

    @cached_property
    def groups(self) -> list[int]:
        """The groups of these stops, ascending."""
        return sorted(set(self.group_of.values()))

    @property
    def directed(self) -> list[tuple[int, int]]:
        """Pairs of stops to tie, each in both directions, one after the other."""
        return [each for a, b in self.work.stop_pairs for each in ((a, b), (b, a))]

    # A group

    def images_of(self, group: int) -> list[int]:
        """Rows of all images of a group's stops that have a picture, ascending."""
        return [int(row) for row in self._alone(group)[1]]

    def _stops_of(self, group: int) -> IntArray:
        return np.unique(self.work.traverse.image_stop[self.work.rows_of(group)])

    def _alone(self, group: int) -> tuple[Traverse, IntArray]:
        """The stops of a group as a drive of their own, and the rows of its images."""
        return of_stops(self.work.traverse, self._stops_of(group), self.work.has_picture)

    @property
    def rig_groups(self) -> list[int]:
        """The groups that tell the rig: the first ones, so that later stops change nothing of them."""
        return self.groups[:_RIG_GROUPS]

    def _rig_key(self) -> str:
        if "rig" not in self._keys:
            work, groups = self.work, self.rig_groups
            pictures = [work.picture_keys[row] for group in groups for row in self.images_of(group)]
            observed = [work.observed_key(group) for group in groups]
            self._keys["rig"] = placed_key("rig", observed, pictures, work.traverse.sharing)
        return self._keys["rig"]

    def rig(self) -> Arrays:
        """The rig as the observations of a few groups have it, or as it is told; see `rig_arrays`."""

        def make() -> Arrays:
            stops = np.concatenate([self._stops_of(group) for group in self.rig_groups])
            few, rows = of_stops(self.work.traverse, np.sort(stops), self.work.has_picture)
            observed = [self.work.observed(group) for group in self.rig_groups]
            if not any(len(each["track"]) for each in observed):
                return rig_arrays(few.rig)
            try:
                # A rig that is off as its uncertainty says puts terrain where other stops do not see it;
                # fields are too small for that.
                solution = solve(
                    few.with_observations(_observations(observed, rows)), SolveOptions(field=False)
                )
            except SolveError as error:
                _LOG.info("the rig as it is told places terrain: %s", error)
                return rig_arrays(few.rig)
            return rig_arrays(solution.rig)

        return self.work.cache.recall("rig", self._rig_key(), make)

    def terrain_key(self, group: int) -> str:
        """Key of the terrain of a group."""
        name = f"terrain {group}"
        if name not in self._keys:
            work, images = self.work, self.images_of(group)
            pictures = [work.picture_keys[row] for row in images]
            masks = [work.reasons(row) for row in images]
            inputs = self._rig_key(), work.observed_key(group), pictures, masks
            self._keys[name] = placed_key("terrain", *inputs)
        return self._keys[name]

    @cached_property
    def _keys(self) -> dict[str, str]:
        return {}

    def placed(self, group: int) -> Arrays:
        """The terrain that the observations within a group place; see `terrain_arrays`.

        Also `slope`, which points are `shown` (n,) outside of masks, how many observations there are
        (`weight`), and `unit`, the factor from noise in pixels to the sigmas of these observations. None are
        placed, with a log entry, where the observations do not determine them.
        """

        def make() -> Arrays:
            alone, rows = self._alone(group)
            arrays: dict[str, Any] = self._solved(alone, rows, self.work.observed(group))
            unit, weight = arrays.pop("unit"), arrays.pop("weight")
            terrain = terrain_from(alone, drive_row=rows, **arrays)
            shown = on_terrain(lambda i: self.work.usable(int(rows[i])), terrain.image, terrain.uv_px)
            return {**arrays, "slope": terrain.slope, "shown": shown, "unit": unit, "weight": weight}

        return self.work.cache.recall("terrain", self.terrain_key(group), make)

    def _solved(self, alone: Traverse, rows: IntArray, observed: Arrays) -> Arrays:
        """The points that a solve of a group places, `unit` and `weight`."""
        names = ", ".join(stop.id for stop in alone.stops)
        unplaced = {**unplaced_arrays(alone), "unit": np.array(1.0), "weight": np.array(0)}
        if not len(observed["track"]):
            return unplaced
        observations, told = _observations([observed], rows), rig_from(alone.rig, **self.rig())
        # Stops without ties have nothing but the rig in common: with it each is where a solve of all has it.
        held = replace(told, uncertainty=_of_flex(told.uncertainty))
        alone = replace(alone, rig=held, sharing=None)
        try:
            solution = solve(alone.with_observations(observations), SolveOptions(field=False))
        except SolveError as error:
            _LOG.info("stops %s: no terrain: %s", names, error)
            return unplaced
        # A solve scales all noise by one factor, and the ties' noise must be in the same unit.
        unit = np.median(observations.sigma_px / solution.sigma_px)
        _LOG.info("stops %s: terrain placed, %d observations", names, len(observations))
        return {
            **terrain_arrays(solution, observed["feature"]),
            "unit": np.array(unit),
            "weight": np.array(len(observations)),
        }

    def unit(self) -> float:
        """Factor from noise in pixels to the observations' sigmas: the groups' median, by their sizes."""
        parts = [self.placed(group) for group in self.groups]
        units, weights = (np.array([float(p[name]) for p in parts]) for name in ("unit", "weight"))
        order = np.argsort(units, kind="stable")
        half = np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)
        return float(units[order][min(int(half), len(units) - 1)])

    # A stop

    @cached_property
    def _terrains(self) -> Held[int, StopTerrain]:
        return Held[int, StopTerrain](_HELD_BYTES, lambda terrain: terrain.nbytes)

    def terrain(self, stop: int) -> StopTerrain:
        """The terrain of a stop, without what masks cover."""

        def make() -> StopTerrain:
            group = self.group_of[stop]
            arrays: dict[str, Any] = self.placed(group)
            alone, rows = self._alone(group)
            shown = arrays.pop("shown")
            del arrays["unit"], arrays["weight"]
            terrain = terrain_from(alone, drive_row=rows, **arrays).select(shown)
            return terrain.of_stop(int(np.searchsorted(self._stops_of(group), stop)))

        return self._terrains.get(stop, make)

    # Two stops

    def ties(self, one: int, other: int) -> StopTies:
        """Ties of the terrain of one stop with the images of another; images by their rows in the drive."""

        def make() -> Arrays:
            return self._matcher(one, other).ties(0, 1).arrays()

        keys = [self.terrain_key(self.group_of[stop]) for stop in (one, other)]
        stops = [self.work.traverse.stops[stop] for stop in (one, other)]
        found = StopTies.of_arrays(self.work.cache.recall("ties", placed_key("ties", keys, stops), make))
        rows = self._between(one, other).drive_row
        return replace(
            found,
            ties=replace(found.ties, image=rows[found.ties.image]),
            report=replace(found.report, a=one, b=other),
        )

    def _between(self, one: int, other: int) -> StopTerrain:
        return self.terrain(one).beside(self.terrain(other))

    def _matcher(self, one: int, other: int) -> StopMatcher:
        terrain, work = self._between(one, other), self.work
        rows = terrain.drive_row.tolist()

        def usable(image: int) -> BoolArray:
            return work.usable(rows[image])

        return StopMatcher(
            terrain=terrain,
            spline=lambda image, half_octaves: work.spline(rows[image], half_octaves),
            usable=usable,
            features=lambda image: work.features(rows[image]),
            options=work.options,
        )

    def agreeing(self, there: StopTies, back: StopTies) -> tuple[StopTies, StopTies]:
        """The ties of two stops in both directions; see `agreeing`."""
        return agreeing(self._between(there.report.a, there.report.b), there, back)

    def tied(self, found: StopTies, unit: float) -> tuple[int, TiedTracks]:
        """The ties of one stop as observations of its tracks, and its group; `unit` as `unit` returns it."""
        stop = found.report.a
        ties: Ties = found.ties.scaled(np.full(len(found.ties), unit))
        track = self.terrain(stop).track[ties.row]
        return self.group_of[stop], TiedTracks(
            image=ties.image, track=track, uv_px=ties.uv_px, covariance_px2=ties.covariance_px2
        )


def _observations(observed: Sequence[Arrays], rows: IntArray) -> Observations:
    """Observations within some groups, of images by their places in `rows`, sorted by track, then image."""
    first = np.cumsum([0, *(1 + int(each["track"].max(initial=-1)) for each in observed)])
    columns = {n: np.concatenate([each[n] for each in observed]) for n in _COLUMNS}
    return Observations(
        image=np.searchsorted(rows, columns["image"]),
        track=np.concatenate([each["track"] + n for each, n in zip(observed, first, strict=False)]),
        uv_px=columns["uv_px"],
        sigma_px=columns["sigma_px"],
        origin="images",
    ).with_covariance(columns["covariance_px2"])


def _of_flex(uncertainty: RigUncertainty) -> RigUncertainty:
    """What is uncertain of a rig that pictures have told: the flex of frames, and encoders."""
    return replace(
        uncertainty,
        focal=0.0,
        aspect=0.0,
        principal_point_px=0.0,
        skew_px=0.0,
        mount_rad=0.0,
        mount_m=0.0,
        tilt_axis_rad=0.0,
        tilt_axis_m=0.0,
        covariance=None,
    )
