"""Processes for which permissions hold, also where the tests run as root."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

__all__ = ["run_bound", "sealed"]

_DROP_FROM_BOUNDING_SET = 24  # of prctl
_OVERRIDE, _READ_AND_SEARCH = 1, 2  # what lets root pass permissions by


def run_bound(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a program that may write only where permissions let it."""
    return subprocess.run(
        words,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=_bind if sys.platform == "linux" and os.geteuid() == 0 else None,
    )


def sealed(*folders: Path) -> None:
    """Take from folders and files the permission to be changed; skips the test where that changes nothing."""
    for folder in folders:
        for path in (folder, *folder.rglob("*")):
            path.chmod(path.stat().st_mode & ~0o222)
        if run_bound("touch", str(folder / "touched")).returncode == 0:
            pytest.skip("permissions do not hold here")


def _bind() -> None:
    library = ctypes.CDLL(None)
    for capability in (_OVERRIDE, _READ_AND_SEARCH):
        library.prctl(_DROP_FROM_BOUNDING_SET, capability, 0, 0, 0)
