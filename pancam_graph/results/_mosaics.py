"""Mosaics as an output of the folder of results."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from pancam_graph import report
from pancam_graph.images import cache_folder
from pancam_graph.mosaic import MOSAIC_PAGE, write_mosaics
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["MOSAICS"]


def _write(written: Written, folder: Path) -> Written:
    options, solution = written.mosaic_options, written.solution
    assert options is not None  # without options nobody asked for mosaics
    drawn = partial(
        write_mosaics, solution, folder, options, progress=written.progress, cache=cache_folder(written.out)
    )
    mosaics = written.made_with_workers(lambda client: drawn(client=client))
    if mosaics.entries:
        report.write_mosaic_page(mosaics, solution.traverse.name, folder / MOSAIC_PAGE)
    warned = replace(solution, warnings=(*solution.warnings, *mosaics.warnings))
    return replace(written, solution=warned, mosaics=mosaics)


MOSAICS = OutputWriter(write=_write)
