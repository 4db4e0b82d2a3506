"""Files and folders that appear whole or not at all, whenever an interrupt comes."""

import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from pancam_graph.base import whole_files
from pancam_graph.base.whole_files import recover, whole_folder


def interrupted_at(line: int, out: Path, keep: str | None) -> str | None:
    """Write a folder, with a signal at a line of the module, counted as they run; text of the interrupt."""
    passed = 0

    def trace(frame: FrameType, event: str, _argument: Any) -> Any:
        nonlocal passed
        if frame.f_code.co_filename != whole_files.__file__:
            return None
        if event == "line":
            passed += 1
            if passed == line:
                signal.raise_signal(signal.SIGINT)
        return trace

    tracing = sys.gettrace()
    sys.settrace(trace)
    try:
        with whole_folder(out, keep=keep) as partial:
            (partial / "text").write_text("new")
    except KeyboardInterrupt as interrupt:
        return str(interrupt)
    finally:
        sys.settrace(tracing)
    return None


@pytest.mark.parametrize("keep", [None, "cache"])
def test_an_interrupt_at_any_line_leaves_the_old_or_the_new_and_says_which(
    tmp_path: Path, keep: str | None
) -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    seen = set()
    try:
        for line in range(1, 200):
            out = tmp_path / str(line) / "out"
            (out / "cache").mkdir(parents=True)
            (out / "text").write_text("old")
            said = interrupted_at(line, out, keep)
            seen.add(said)
            recover(out, keep=keep)  # as the next writer does; a lock goes when the process ends
            assert [p.name for p in out.parent.iterdir() if p.suffix != ".lock"] == ["out"]
            is_new = (out / "text").read_text() == "new"
            assert said == (f"interrupted; {out} was written whole before" if is_new else "") or said is None
            assert (out / "cache").exists() == (keep is not None or not is_new)
            if said is None:
                break
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(seen) > 2
    assert None in seen
