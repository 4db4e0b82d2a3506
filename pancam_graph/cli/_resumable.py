"""Work on a folder of results that an interrupt does not undo."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pancam_graph.base.errors import ClusterError, PancamGraphError
from pancam_graph.images import cache_folder, is_cache

__all__ = ["resumable"]


@contextmanager
def resumable(out: Path) -> Iterator[None]:
    """While the block runs, what it keeps in the cache of the folder `out` outlives an interrupt.

    The interrupt then says how to go on. Bad input leaves nothing behind that was not there before; a cluster
    that breaks down leaves what its workers have found.
    """
    before = [path for path in (out, cache_folder(out)) if path.exists()]
    try:
        yield
    except KeyboardInterrupt as interrupt:
        if not str(interrupt) and is_cache(cache_folder(out)):
            raise KeyboardInterrupt(
                f"interrupted; no results were written; what was found in the images so far is in "
                f"{cache_folder(out)}: run the same command again to go on from there"
            ) from None
        raise
    except PancamGraphError as error:
        is_kept = isinstance(error, ClusterError) and any(cache_folder(out).glob("*.npz"))
        if is_cache(cache_folder(out)) and cache_folder(out) not in before and not is_kept:
            shutil.rmtree(cache_folder(out) if out in before else out, ignore_errors=True)
        raise
