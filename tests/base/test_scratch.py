"""Arrays in temporary files."""

import errno
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.base.scratch import Scratch


def test_arrays_keep_their_contents_when_they_are_let_go() -> None:
    given: list[NDArray[Any]] = [
        np.arange(7),
        np.zeros((0, 3), dtype=np.float32),
        np.linspace(0, 1, 5000).reshape(-1, 2),
    ]
    scratch = Scratch.of(given)
    scratch.arrays[2][17] = 5.0
    scratch.let_go()
    expected = given[2].copy()
    expected[17] = 5.0
    for stored, array in zip(scratch.arrays, (given[0], given[1], expected), strict=True):
        assert stored.dtype == array.dtype
        np.testing.assert_array_equal(stored, array)
    assert given[2][17, 0] != 5.0  # a copy


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems tell their memory otherwise")
def test_what_is_let_go_is_no_longer_in_memory() -> None:
    n_bytes = 64_000_000
    scratch = Scratch([((n_bytes // 8,), np.float64)])
    before = resident_bytes()
    scratch.arrays[0][:] = 1.0
    assert resident_bytes() > before + 0.9 * n_bytes
    scratch.let_go()
    assert resident_bytes() < before + 0.1 * n_bytes
    assert scratch.arrays[0][-1] == 1.0


def test_a_full_disk_is_one_sentence_that_names_the_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def __enter__(self) -> "Full":
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def write(self, _: bytes) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: Full())
    with pytest.raises(InputError, match=r"expected room for 8 MB of temporary files .*No space left"):
        Scratch([((1_000_000,), np.float64)])
