"""The wheel has every folder of the package: one that is not listed is silently absent from it."""

import re
from pathlib import Path
from pkgutil import walk_packages

import pancam_graph

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


def test_every_package_is_listed() -> None:
    text = PROJECT.read_text(encoding="utf-8")
    (listed,) = re.findall(r"^packages = \[\n(.*?)\]", text, flags=re.DOTALL | re.MULTILINE)
    found = {m.name for m in walk_packages(pancam_graph.__path__, "pancam_graph.") if m.ispkg}
    assert {"pancam_graph", *found} == set(re.findall(r'"([\w.]+)"', listed))
