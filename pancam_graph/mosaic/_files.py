"""Mosaics as a folder of files with an index, drawn in this process or by the workers of a cluster."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from secrets import token_hex
from typing import Any

from pancam_graph.cluster import Job
from pancam_graph.data import Solution
from pancam_graph.images import Arrays, Cache, crew_at_work, key_of
from pancam_graph.io import MOSAIC_FORMAT, VERSION, same_pictures
from pancam_graph.mosaic._mosaic_options import MosaicOptions
from pancam_graph.mosaic._stop_files import Blink, EyeFiles, Json, eye_of_arrays, files_of_stop

__all__ = ["MOSAIC_INDEX", "MOSAIC_PAGE", "WrittenMosaics", "write_mosaics"]

MOSAIC_INDEX = "mosaics.json"
"""The file in a folder of mosaics that lists the others."""
MOSAIC_PAGE = "mosaics.html"
"""The page of a folder of mosaics, which the index does not list: whoever writes reports writes it."""
_BLINK_BUDGET = 6_000_000
"""Bytes that the pictures for the report may take together."""
_KEPT = "mosaics"
"""The kind of what a cache keeps of a stop."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class WrittenMosaics:
    """What `write_mosaics` wrote, for the report and for the list of warnings."""

    blinks: tuple[Blink, ...]
    lines: tuple[str, ...]
    """The seam error of each panorama, in words."""
    warnings: tuple[str, ...]
    entries: tuple[Json, ...]
    """What the index says of each mosaic."""
    north_deg: float | None
    """Azimuth of north, anticlockwise from the world's x axis; None: not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Stops:
    """The stops whose mosaics are drawn."""

    solution: Solution
    options: MosaicOptions
    twice: Mapping[int, int]
    eyes: dict[int, list[int]]
    """Eyes with images at each stop, by row."""
    token: str
    """Of this run: nothing that another one kept is taken for its."""

    def __getstate__(self) -> dict[str, Any]:
        """With paths that hold in any folder."""
        traverse = self.solution.traverse
        whole = replace(traverse, folder=(traverse.folder or Path()).resolve(), warnings=(), matching=None)
        return {**vars(self), "solution": replace(self.solution, traverse=whole)}

    def kept(self, stop: int, cache: Cache) -> list[EyeFiles]:
        """What the mosaics of a stop come to, with pictures for the report; from a cache if it is there."""

        def make() -> Arrays:
            found = files_of_stop(
                self.solution, stop, self.eyes[stop], self.options, self.twice, blinks=lambda _: True
            )
            return {f"{k} {name}": a for k, eye in enumerate(found) for name, a in eye.arrays().items()}

        arrays, found = cache.recall(_KEPT, key_of(_KEPT, (), (), self.token, stop), make), list[EyeFiles]()
        for k in range(len(self.eyes[stop])):
            mark = f"{k} "
            own = {n.removeprefix(mark): array for n, array in arrays.items() if n.startswith(mark)}
            found.append(eye_of_arrays(own))
        return found


def write_mosaics(
    solution: Solution,
    folder: Path,
    options: MosaicOptions = MosaicOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
    cache: Path | None = None,
    client: Any = None,
) -> WrittenMosaics:
    """Write the mosaics of every eye at every stop into a folder, which must exist (docs/files.md).

    An image that cannot be shown, or an eye without any image at a stop, becomes a warning. `progress` is
    called with a stage, how many of its parts are done, and how many there are. `client`, a
    distributed.Client, shares stops among the workers of a Dask cluster, with the same files; they leave what
    they draw in the folder `cache`, and hold the solution each. Raises ClusterError as `find_observations`
    does.
    """
    traverse = solution.traverse
    pairs = sorted(set(zip(traverse.image_stop.tolist(), traverse.image_eye.tolist(), strict=True)))
    stops = _Stops(
        solution=solution,
        options=options,
        twice=same_pictures(traverse),
        eyes={stop: [eye for _, eye in of] for stop, of in groupby(pairs, key=lambda pair: pair[0])},
        token=token_hex(20),
    )
    entries, blinks, lines, warnings = list[Json](), list[Blink](), list[str](), list[str]()
    spent = 0
    with crew_at_work(client, traverse, cache) as crew:
        drawn = _drawn(stops, progress) if crew is None else _drawn_by(crew, stops, cache, progress)
        for eye in drawn:
            for name, content in eye.files.items():
                (folder / name).write_bytes(content)
            entries += eye.entries
            lines += eye.lines
            warnings += eye.warnings
            if spent < _BLINK_BUDGET:
                spent += _n_bytes([eye])
                blinks += eye.blinks
    index = {"format": MOSAIC_FORMAT, "version": VERSION, "mosaics": entries}
    text = json.dumps(index, indent=1, allow_nan=False, ensure_ascii=False)
    (folder / MOSAIC_INDEX).write_text(text + "\n", encoding="utf-8", newline="\n")
    return WrittenMosaics(
        blinks=tuple(blinks),
        lines=tuple(lines),
        warnings=tuple(warnings),
        entries=tuple(entries),
        north_deg=None if traverse.site is None else math.degrees(traverse.site.north_rad),
    )


def _n_bytes(eyes: Sequence[EyeFiles]) -> int:
    """Bytes of the pictures for the report."""
    return sum(len(data) for eye in eyes for blink in eye.blinks for data in blink.jpeg.values())


def _drawn(stops: _Stops, progress: Progress | None) -> Iterator[EyeFiles]:
    """The mosaics of each eye at each stop, drawn here."""
    total, n_done, spent = sum(map(len, stops.eyes.values())), 0, 0

    def done() -> None:
        nonlocal n_done
        n_done += 1
        if progress is not None:
            progress("mosaics", n_done, total)

    def has_room(before: Sequence[EyeFiles]) -> bool:
        return spent + _n_bytes(before) < _BLINK_BUDGET

    for stop, eyes in stops.eyes.items():
        found = files_of_stop(
            stops.solution, stop, eyes, stops.options, stops.twice, blinks=has_room, done=done
        )
        spent += _n_bytes(found)
        yield from found


def _drawn_by(crew: Any, stops: _Stops, cache: Path | None, progress: Progress | None) -> Iterator[EyeFiles]:
    """The same, drawn by workers, who leave it in the cache until it is taken from there."""
    kept, names = Cache(cache), [stop.id for stop in stops.solution.traverse.stops]
    done = None if progress is None else partial(progress, "mosaics on workers")
    job = Job(function=_keep, shared=(stops, kept), name=lambda stop: f"the mosaics of stop {names[stop]}")
    crew.share(job, list(stops.eyes), done=done)
    for stop in stops.eyes:
        yield from stops.kept(stop, kept)
    kept.forget(_KEPT)


def _keep(shared: tuple[_Stops, Cache], stop: int) -> None:
    """Have the mosaics of a stop in the cache; runs on a worker."""
    stops, cache = shared
    stops.kept(stop, cache)
