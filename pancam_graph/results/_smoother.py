"""`smoother.npz`: the state of iSAM2 after a solve stop by stop, with which the drive goes on."""

from pathlib import Path

from pancam_graph.results._output import OutputWriter, Written

__all__ = ["SMOOTHER", "SMOOTHER_FILE"]

SMOOTHER_FILE = "smoother.npz"


def _write(written: Written, path: Path) -> Written:
    assert written.smoother is not None  # it is what the output is asked for by
    written.smoother.save(path)
    return written


SMOOTHER = OutputWriter(write=_write)
