"""The report as an output of the folder of results."""

from pathlib import Path

from pancam_graph import report
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["REPORT"]


def _write(written: Written, path: Path) -> Written:
    report.write_report(written.solution, path, written.mosaics, written.terrain)
    return written


REPORT = OutputWriter(write=_write)
