"""Steps of the front end on workers of a cluster, which leave in the cache what the caller then finds there.

The caller goes through all steps as it does alone, and makes what is missing: whatever the workers do, and in
whatever order, the result has the same bytes.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pancam_graph import cluster
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import IntArray
from pancam_graph.data import Observations
from pancam_graph.images._cache import libraries
from pancam_graph.images._cache_folder import begin_cache
from pancam_graph.images._steps import PlacedStops, Steps
from pancam_graph.io import picture_file

__all__ = ["Helpers", "helped"]


class _Item(NamedTuple):
    """One step of one image, pair or group, or of a group's tracks that begin in one image."""

    kind: Literal["mask", "features", "matches", "tracks", "refined"]
    number: int
    """Row of the image, or number of the pair or group."""
    group: int = -1
    """Number of the group of tracks that are refined."""


@dataclass(frozen=True, eq=False)
class _Tying:
    """What ties between stops need: steps, observations within stops, and their rows among the features."""

    work: Steps
    observations: Observations
    feature: IntArray

    @cached_property
    def placed(self) -> PlacedStops:
        """The terrain of single stops, which the caller has left in the cache."""
        return self.work.placed(self.observations, self.feature)


class Helpers:
    """Workers that do steps before the caller asks for them."""

    def __init__(self, crew: cluster.Crew) -> None:
        """The crew is at work."""
        self._crew = crew

    def within_stops(self, work: Steps) -> None:
        """All steps up to the refined tracks of each group of stops, none of which waits for another group.

        The steps must know the plan of the drive.
        """
        items, after = _plan(work)
        job = cluster.Job(function=_do, shared=work, name=partial(_name, work))
        self._crew.share(job, items, after, partial(work.tell, "images, pairs and tracks on workers"))

    def between_stops(
        self, work: Steps, observations: Observations, feature: IntArray, stops: Sequence[tuple[int, int]]
    ) -> None:
        """Ties of each of these directed pairs of stops, whose terrain is in the cache."""
        names = [stop.id for stop in work.traverse.stops]
        job = cluster.Job(
            function=_tie,
            shared=_Tying(work, observations, feature),
            name=lambda pair: f"stops {names[pair[0]]} and {names[pair[1]]}",
        )
        self._crew.share(job, stops, done=partial(work.tell, "ties between stops on workers"))


@contextmanager
def helped(client: Any, work: Steps, folder: Path | None) -> Iterator[Helpers | None]:
    """The workers of a distributed.Client, found able to do the work; None without a client.

    `folder` is that of the cache. Raises InputError without one, and as `cluster.Crew.at_work` does.
    """
    if client is None:
        yield None
        return
    if folder is None:
        raise InputError(
            "find_observations: expected a folder for the cache, in which workers leave results, found none"
        )
    begin_cache(folder)
    crew = cluster.Crew(client, folder=folder, machine=_machine)
    files = (picture_file(work.traverse, row) for row in range(len(work.traverse.images)))
    with crew.at_work(path for path in files if path is not None):
        yield Helpers(crew)


@cache
def _machine() -> dict[str, str]:
    """What must be the same on all machines."""
    return {**cluster.machine(), **libraries()}


def _plan(work: Steps) -> tuple[list[_Item], list[list[int]]]:
    """Items group by group, and the numbers of those that each needs."""
    items, after = list[_Item](), list[list[int]]()
    mask, features = dict[int, int](), dict[int, int]()

    def add(item: _Item, before: list[int]) -> int:
        items.append(item)
        after.append(before)
        return len(items) - 1

    def add_images(rows: list[int]) -> None:
        new = [row for row in rows if row not in mask]
        mask.update((row, add(_Item("mask", row), [])) for row in new)
        features.update((row, add(_Item("features", row), [mask[row]])) for row in new)

    for group, pairs in enumerate(work.groups):
        ends = {k: (work.pairs[k].a, work.pairs[k].b) for k in pairs}
        rows = sorted({row for both in ends.values() for row in both})
        add_images(rows)
        matches = [add(_Item("matches", k), [features[a], features[b]]) for k, (a, b) in ends.items()]
        tracks = add(_Item("tracks", group), matches)
        for row in rows:
            add(_Item("refined", row, group), [tracks])
    add_images(work.rows)
    return items, after


def _do(work: Steps, item: _Item) -> None:
    """One item on a worker: what comes of it is in the cache."""
    if item.kind == "mask":
        work.figures(item.number)
    elif item.kind == "features":
        work.features(item.number)
    elif item.kind == "matches":
        work.matches(work.pairs[item.number])
    elif item.kind == "tracks":
        work.tracks(item.number)
    elif item.number in work.origins(item.group):
        work.refined(item.group, item.number)


def _tie(tying: _Tying, stops: tuple[int, int]) -> None:
    tying.placed.ties(*stops)


def _name(work: Steps, item: _Item) -> str:
    """An item for people."""
    images = work.traverse.images
    if item.kind == "matches":
        pair = work.pairs[item.number]
        return f"the matches of images {images[pair.a].id} and {images[pair.b].id}"
    if item.kind == "tracks":
        pair = work.pairs[work.groups[item.number][0]]
        return f"the tracks of stop {work.traverse.stops[work.traverse.image_stop[pair.a]].id}"
    return f"the {'tracks' if item.kind == 'refined' else item.kind} of image {images[item.number].id}"
