"""What pyproject.toml promises: all folders of the package, versions of Python, locked requirements."""

import re
import sys
import tomllib
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

import pytest

import pancam_graph

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def pyproject() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_package_is_listed(pyproject: dict[str, Any]) -> None:
    found = {m.name for m in walk_packages(pancam_graph.__path__, "pancam_graph.") if m.ispkg}
    # Where a checkout has no links, the import system knows factors/ by its mapping only.
    found |= {"pancam_graph", "pancam_graph.factors"}
    assert found == set(pyproject["tool"]["setuptools"]["packages"])


def test_promised_versions_of_python_agree(pyproject: dict[str, Any]) -> None:
    classifiers = pyproject["project"]["classifiers"]
    promised = [int(c.rpartition(".")[2]) for c in classifiers if re.match(r".* :: 3\.\d+$", c)]
    assert promised == list(range(promised[0], promised[-1] + 1))
    assert pyproject["project"]["requires-python"] == f">=3.{promised[0]}"
    assert pyproject["tool"]["ruff"]["target-version"] == f"py3{promised[0]}"
    assert sys.version_info.minor in promised


def test_every_requirement_of_development_is_locked(pyproject: dict[str, Any]) -> None:
    lock = ROOT / ".ci/requirements.lock"
    if not lock.exists():
        pytest.skip(f"no {lock}: it is part of the repository, not of the package")
    locked = set(re.findall(r"^([\w.-]+)==", lock.read_text(encoding="utf-8"), flags=re.MULTILINE))
    extras = pyproject["project"]["optional-dependencies"]
    required = [*pyproject["project"]["dependencies"], *extras["dev"]]
    for name in re.findall(r"[\w.-]+", next(r for r in required if r.startswith("pancam-graph["))):
        required += extras.get(name, [])
    names = {match[0] for text in required if (match := re.match(r"[\w.-]+", text))}
    missing = names - locked - {"pancam-graph"}
    assert not missing, f"{lock} lacks them; the command at its top writes it anew"
