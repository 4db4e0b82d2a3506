"""Steps of the front end on workers of a cluster, which leave in the cache what the caller then finds there.

The caller goes through all steps as it does alone, and makes what is missing: whatever the workers do, and in
whatever order, the result has the same bytes.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pancam_graph import cluster
from pancam_graph.base.errors import InputError
from pancam_graph.data import Traverse
from pancam_graph.images._cache import libraries
from pancam_graph.images._cache_folder import begin_cache
from pancam_graph.images._placed import PlacedStops
from pancam_graph.images._steps import Steps
from pancam_graph.io import picture_file

__all__ = ["Helpers", "crew_at_work", "helped"]


class _Item(NamedTuple):
    """One step of one image, pair, group, or two stops, or of a group's tracks that begin in one image."""

    kind: Literal["mask", "features", "matches", "tracks", "refined", "observed", "rig", "terrain", "ties"]
    number: int
    """Row of the image or stop, or number of the pair or group."""
    second: int = -1
    """Number of the group of tracks that are refined, or row of the stop whose images are looked at."""


class Helpers:
    """Workers that do steps before the caller asks for them."""

    def __init__(self, crew: cluster.Crew) -> None:
        """The crew is at work."""
        self._crew = crew

    def do_masks(self, work: Steps) -> None:
        """The mask of each image; the steps must know what masks need of the drive."""
        items = [_Item("mask", row) for row in work.rows]
        job = cluster.Job(function=_do_mask, shared=work, name=partial(_name, work), kind=_kind)
        self._crew.share(job, items, done=partial(work.tell, "masks on workers"))

    def do_all(self, placed: PlacedStops) -> None:
        """All steps of a drive, none of which waits for stops that it does not need.

        The steps must know the plan of the drive.
        """
        items, after = _plan(placed)
        work = placed.work
        job = cluster.Job(function=_do, shared=placed, name=partial(_name, work), kind=_kind)
        self._crew.share(job, items, after, partial(work.tell, "images, stops and ties on workers"))


@contextmanager
def helped(client: Any, work: Steps, folder: Path | None) -> Iterator[Helpers | None]:
    """The workers of a distributed.Client, found able to do the work; None without a client.

    `folder` is that of the cache. Raises as `crew_at_work` does.
    """
    with crew_at_work(client, work.traverse, folder) as crew:
        yield None if crew is None else Helpers(crew)


@contextmanager
def crew_at_work(client: Any, traverse: Traverse, folder: Path | None) -> Iterator[cluster.Crew | None]:
    """The workers of a distributed.Client, found able to work on pictures; None without a client.

    `folder` is that of the cache. Raises InputError without one, and as `cluster.Crew.at_work` does.
    """
    if client is None:
        yield None
        return
    if folder is None:
        raise InputError(
            "client: expected a folder for the cache, in which workers leave results, found none"
        )
    begin_cache(folder)
    crew = cluster.Crew(client, folder=folder, machine=_machine)
    files = (picture_file(traverse, row) for row in range(len(traverse.images)))
    with crew.at_work(path for path in files if path is not None):
        yield crew


@cache
def _machine() -> dict[str, str]:
    """What must be the same on all machines."""
    return {**cluster.machine(), **libraries()}


def _plan(placed: PlacedStops) -> tuple[list[_Item], list[list[int]]]:
    """Items group by group, and the numbers of those that each needs.

    Two stops are tied right after the later of them: what memory and disks hold of them is still there.
    """
    work = placed.work
    items, after = list[_Item](), list[list[int]]()
    mask, features, terrain = dict[int, int](), dict[int, int](), dict[int, int]()
    tell_rig, rig, without_rig = list[int](), list[int](), list[int]()
    waiting = [(max(placed.group_of[a], placed.group_of[b]), a, b) for a, b in placed.directed]
    ties = {last: [pair[1:] for pair in waiting if pair[0] == last] for last, *_ in waiting}

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
        rows = work.rows_of(group)
        add_images(rows)
        matches = [add(_Item("matches", k), [features[a], features[b]]) for k, (a, b) in ends.items()]
        tracks = add(_Item("tracks", group), matches)
        refined = [add(_Item("refined", row, group), [tracks]) for row in rows]
        observed = add(_Item("observed", group), refined)
        if group in placed.groups:
            images = placed.images_of(group)
            add_images(images)
            if group in placed.rig_groups:
                tell_rig.append(observed)
            if group == placed.rig_groups[-1]:
                rig = [add(_Item("rig", group), tell_rig)]
            before = [observed, *rig, *(mask[row] for row in images)]
            terrain[group] = add(_Item("terrain", group), before)
            if not rig:
                without_rig.append(terrain[group])
        for one, other in ties.get(group, ()):
            add(_Item("ties", one, other), [terrain[placed.group_of[stop]] for stop in (one, other)])
    for number in without_rig:  # those that tell the rig wait for it, too
        after[number] += rig
    add_images(work.rows)
    return items, after


def _do_mask(work: Steps, item: _Item) -> None:
    work.figures(item.number)


def _do(placed: PlacedStops, item: _Item) -> None:
    """One item on a worker: what comes of it is in the cache."""
    work, number = placed.work, item.number
    if item.kind == "mask":
        work.figures(number)
    elif item.kind == "features":
        work.features(number)
    elif item.kind == "matches":
        work.matches(work.pairs[number])
    elif item.kind == "tracks":
        work.tracks(number)
    elif item.kind == "observed":
        work.observed(number)
    elif item.kind == "rig":
        placed.rig()
    elif item.kind == "terrain":
        placed.placed(number)
    elif item.kind == "ties":
        placed.ties(number, item.second)
    elif number in work.origins(item.second):
        work.refined(item.second, number)


def _kind(item: _Item) -> str:
    return item.kind


def _name(work: Steps, item: _Item) -> str:
    """An item for people."""
    traverse, number = work.traverse, item.number
    if item.kind == "matches":
        pair = work.pairs[number]
        return f"the matches of images {traverse.images[pair.a].id} and {traverse.images[pair.b].id}"
    if item.kind == "ties":
        return f"the ties of stops {traverse.stops[number].id} and {traverse.stops[item.second].id}"
    if item.kind == "rig":
        return "the rig that stops are placed with"
    if item.kind in {"tracks", "observed", "terrain"}:
        what = "terrain" if item.kind == "terrain" else "tracks"
        return f"the {what} of stop {traverse.stops[traverse.image_stop[work.rows_of(number)[0]]].id}"
    return f"the {'tracks' if item.kind == 'refined' else item.kind} of image {traverse.images[number].id}"
