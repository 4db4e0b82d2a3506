"""The doors of the rooms: what a room's `__init__.py` offers is its own, by its own name."""

import ast
import importlib
import re
from pathlib import Path

import pytest

import pancam_graph

PACKAGE = Path(pancam_graph.__file__).parent
DOORS = sorted(d.relative_to(PACKAGE).as_posix() for d in PACKAGE.rglob("__init__.py") if d.parent != PACKAGE)


def test_every_room_has_a_door() -> None:
    rooms = {d.name for d in PACKAGE.iterdir() if d.is_dir() and d.name != "__pycache__"}
    assert {door.partition("/")[0] for door in DOORS} >= rooms - {"factors"}
    assert len(DOORS) > 15


@pytest.mark.parametrize("door", DOORS)
def test_a_door_offers_only_its_own_under_the_same_names(door: str) -> None:
    tree = ast.parse((PACKAGE / door).read_text(encoding="utf-8"))
    assert ast.get_docstring(tree)
    room = ".".join(["pancam_graph", *Path(door).parent.parts])
    late = [node for node in tree.body if isinstance(node, ast.If)]  # if TYPE_CHECKING, else __getattr__
    lines = [n for n in (*tree.body, *(n for i in late for n in i.body)) if isinstance(n, ast.ImportFrom)]
    offered = []
    for line in lines:
        if late and line.module in {"importlib", "typing"}:
            continue
        assert f"{line.module}.".startswith(f"{room}."), f"{door} imports from {line.module}"
        assert line.level == 0
        for alias in line.names:
            assert alias.asname == alias.name, f"{door}: {alias.name} as {alias.asname}"
            assert not alias.name.startswith("_")
            offered.append(alias.name)
    assert len(set(offered)) == len(offered)
    module = importlib.import_module(room)
    assert [name for name in offered if not hasattr(module, name)] == []


def test_rooms_import_each_other_by_their_doors() -> None:
    """Of another room nothing private is imported; `base` has public modules instead of a door."""
    imported = re.compile(r"^ *(?:from|import) +(pancam_graph\.(\w+)\S*)", re.MULTILINE)
    found = [
        (path.relative_to(PACKAGE), module, room)
        for path in PACKAGE.rglob("*.py")
        for module, room in imported.findall(path.read_text(encoding="utf-8"))
    ]
    assert len(found) > 1000
    assert [one for one in found if "._" in one[1] and one[2] != one[0].parts[0]] == []
