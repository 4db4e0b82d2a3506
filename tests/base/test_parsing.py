"""Sources are parsed and headers of arrays read in several threads at once."""

import ast
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from pancam_graph.base import sources
from pancam_graph.io import NpzFile


def test_one_thread_parses_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez(tmp_path / "arrays.npz", x=np.arange(3))
    inside, most = [0], [0]
    parse = ast.parse

    def watched(*arguments: object, **others: object) -> ast.AST:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        try:
            return parse(*arguments, **others)  # type: ignore[call-overload,no-any-return]  # handed on
        finally:
            inside[0] -= 1

    monkeypatch.setattr(ast, "parse", watched)
    text = tmp_path / "module.py"
    text.write_text("import os\n" * 2000)
    monkeypatch.setattr(sources, "source_of", lambda name: (text, text.read_text()))
    with ThreadPoolExecutor(4) as pool:
        parsed = [pool.submit(sources._from_statements.__wrapped__, "module") for _ in range(4)]
        read = [pool.submit(lambda: NpzFile(tmp_path / "arrays.npz").array("x")) for _ in range(40)]
        assert all(len(each.result()) == 2000 for each in parsed)
        assert all(each.result().tolist() == [0, 1, 2] for each in read)
    assert most == [1]
