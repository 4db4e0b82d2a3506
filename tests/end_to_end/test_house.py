"""The house: no long file or function, nothing loose beside the rooms, no test module that another needs."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MOST_LINES_OF_A_FILE = 600
MOST_LINES_OF_A_FUNCTION = 120
IMPORT = re.compile(r"^ *((?:from|import) +\S+)", re.MULTILINE)


@pytest.fixture(scope="module", autouse=True)
def _of_the_repository() -> None:
    if not (ROOT / "factors").is_dir():
        pytest.skip("no factors/ beside tests/: the sources are part of the repository, not of the package")


def sources(*folders: str) -> Iterator[tuple[str, str]]:
    """Name and text of each Python file; factors/ once, not again through the package."""
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if not name.startswith("pancam_graph/factors/"):
                yield name, path.read_text(encoding="utf-8")


EVERYWHERE = ("pancam_graph", "factors", "scripts", "tests")


def test_no_file_is_long() -> None:
    lines = {name: len(text.splitlines()) for name, text in sources(*EVERYWHERE)}
    assert len(lines) > 200
    assert {name: n for name, n in lines.items() if n > MOST_LINES_OF_A_FILE} == {}


@pytest.mark.slow
def test_no_function_is_long() -> None:
    lines = {
        f"{name}: {node.name}": (node.end_lineno or node.lineno) - node.lineno + 1
        for name, text in sources(*EVERYWHERE)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    assert len(lines) > 2000
    assert {name for name, n in lines.items() if n > MOST_LINES_OF_A_FUNCTION} == set()


def test_the_package_is_rooms_and_nothing_loose() -> None:
    entries = [e for e in (ROOT / "pancam_graph").iterdir() if e.name != "__pycache__"]
    assert {e.name for e in entries if e.is_file()} <= {"__init__.py", "__main__.py", "py.typed"}
    assert [e.name for e in entries if e.is_dir() and not (e / "__init__.py").is_file()] == []


def test_no_test_module_imports_from_another() -> None:
    """What several share is in tests/support."""
    imported = [(name, line) for name, text in sources("tests") for line in IMPORT.findall(text)]
    assert len(imported) > 1000
    assert [found for found in imported if re.search(r"\b(conftest|test_\w+)\b", found[1])] == []
