"""The report of a fault of the program itself: what its developers need to find it."""

import os
import platform
import shlex
import sys
import tempfile
import traceback
from pathlib import Path

from pancam_graph import __version__
from pancam_graph.base.text import visible

__all__ = ["write_fault_report"]

_LIBRARIES = (
    "gtsam",
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "pydantic",
    "pvl",
    "plotly",
    "rich",
)


def write_fault_report(error: BaseException) -> str:
    """Write traceback, versions and command line into a file; returns the sentence that names it.

    The file is in the temporary folder. Where it cannot be written, the sentence says where in the code the
    exception was raised.
    """
    what = " ".join(f"{type(error).__name__}: {error}".split())
    what = what if len(what) <= 200 else f"{what[:197]}..."
    begin = f"a fault of the program, not of your input: {what}"
    try:
        handle, name = tempfile.mkstemp(prefix="pancam-graph-fault-", suffix=".txt", text=True)
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(_report(error))
    except OSError as failure:
        last = traceback.extract_tb(error.__traceback__)[-1:]
        place = "".join(f" at {Path(f.filename).name}:{f.lineno}" for f in last)
        return f"{begin}{place}; no report of it could be written ({failure})"
    return (
        f"a fault of the program, not of your input: {what}; send the full report to its developers: {name}"
    )


def _report(error: BaseException) -> str:
    """The text of a report."""
    lines = [
        f"pancam-graph {__version__}",
        f"command: {shlex.join(sys.argv)}",
        f"folder: {os.getcwd()}",  # noqa: PTH109  may be deleted, which is an OSError like others
        f"Python {platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores",
        *(f"{name} {_version(name)}" for name in _LIBRARIES),
        "",
        *(line.rstrip("\n") for line in traceback.format_exception(error)),
    ]
    return visible("\n".join(lines), lines=True) + "\n"


def _version(name: str) -> str:
    from importlib import metadata  # it takes as long as the rest of the command to import

    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "is not installed"
