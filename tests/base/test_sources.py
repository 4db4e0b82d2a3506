"""Which modules of a package a function runs through."""

import ast
import importlib
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import sleep
from types import FunctionType
from typing import Any

import pytest

from pancam_graph.base import sources
from pancam_graph.base.sources import modules_behind, source_digest

FILES = {
    "__init__": "from housed.unused import thing\n",
    "used": "def value():\n    from .late import late\n    return late\n",
    "late": "late = 1\n",
    "unused": "thing = 2\n",
    "room/__init__": "from housed.room._a import a as a\nfrom housed.room import _b\nb = _b.b\n",
    "room/_a": "import json\na = 3\n",
    "room/_b": "b = 4\n",
    "by_door": "from housed.room import a\ndef run():\n    return a\n",
    "made_by_door": "from housed.room import b\n",
    "by_module": "from housed import used as other, room\nimport housed.late\n",
}


@pytest.fixture
def housed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package of these files."""
    (tmp_path / "housed" / "room").mkdir(parents=True)
    for name, text in FILES.items():
        (tmp_path / "housed" / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "housed"]:
        del sys.modules[name]


@pytest.mark.usefixtures("housed")
@pytest.mark.parametrize(
    ("module", "behind"),
    [
        ("used", {"used", "late"}),
        ("by_door", {"by_door", "room._a"}),
        ("made_by_door", {"made_by_door", "room", "room._a", "room._b"}),
        ("by_module", {"by_module", "used", "late", "room", "room._a", "room._b"}),
    ],
)
def test_imports_lead_through_doors_to_the_modules_that_make_the_names(module: str, behind: set[str]) -> None:
    assert modules_behind(frozenset([f"housed.{module}"])) == {f"housed.{name}" for name in behind}


@pytest.mark.usefixtures("housed")
def test_a_digest_of_functions_is_that_of_their_modules() -> None:
    by_door, used = (importlib.import_module(f"housed.{name}") for name in ("by_door", "used"))
    digests = [source_digest(by_door.run), source_digest(used.value), source_digest(by_door.run, used.value)]
    assert len(set(digests)) == 3
    assert source_digest(used.value, by_door.run) == digests[2]
    assert source_digest(used.value, alone=["housed.by_door"]) not in digests


def test_a_function_without_a_source_file_does_no_harm() -> None:
    made = FunctionType(compile("1", "nowhere", "eval"), {"__name__": "nowhere"})
    assert len(source_digest(made)) == 64


def test_what_the_link_or_the_wheel_calls_factors_is_found() -> None:
    behind = modules_behind(frozenset(["pancam_graph.solve._solve"]))
    assert "pancam_graph.factors.mast" in behind
    assert "pancam_graph.report._style" not in behind


def test_threads_that_ask_at_once_get_what_one_gets(monkeypatch: pytest.MonkeyPatch) -> None:
    """One text is parsed at a time: Python 3.11 confuses the depths of parsers in several threads."""
    inside, most = 0, 0
    parse = ast.parse

    def counted(*given: Any, **named: Any) -> ast.AST:
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        sleep(1e-4)  # another thread would come in here
        tree: ast.AST = parse(*given, **named)
        inside -= 1
        return tree

    names = [frozenset({f"pancam_graph.{room}"}) for room in ("graph", "elimination", "landmarks", "rigs")]
    alone = [sources.modules_behind(name) for name in names]
    for kept in (sources.modules_behind, sources._imported, sources._from_statements):
        kept.cache_clear()
    monkeypatch.setattr(ast, "parse", counted)
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(sources.modules_behind, names)) == alone
    monkeypatch.undo()
    assert most == 1
