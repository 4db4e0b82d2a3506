"""The pages in docs/ keep their word: what they name exists, and what the code cites is in the table."""

import importlib
import re
from functools import reduce
from pathlib import Path
from typing import Any

import pytest

import pancam_graph

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

NUMBER = r"\d\.\d+"
CITED = re.compile(rf"\beq\.\s+({NUMBER}(?:(?:\s*,|\s+and|\s+to)\s+{NUMBER})*)")


@pytest.fixture(scope="module", autouse=True)
def _of_the_repository() -> None:
    if not DOCS.is_dir():
        pytest.skip("no docs/: they are part of the repository, not of the installed package")


def rows_of(page: str, after: str) -> list[dict[str, str]]:
    """Rows of all tables between a heading and the next of its level, by the titles of their columns."""
    level = after.split(maxsplit=1)[0]
    text = page[page.index(f"\n{after}\n") + len(after) + 2 :]
    text = re.split(rf"(?m)^#{{1,{len(level)}}} ", text)[0]
    rows, titles = [], list[str]()
    for line in text.splitlines():
        if not line.startswith("|"):
            titles = []
            continue
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if not titles:
            titles = cells
        elif not set("".join(cells)) <= set("-: "):
            rows.append(dict(zip(titles, cells, strict=True)))
    return rows


def expanded(numbers: str) -> set[str]:
    """The single numbers of a citation: "3.3, 3.30 to 3.34" has six."""
    out, words = set[str](), re.findall(rf"{NUMBER}|to", numbers)
    for i, word in enumerate(words):
        if word == "to":
            (chapter, first), (_, last) = (words[j].split(".") for j in (i - 1, i + 1))
            out |= {f"{chapter}.{n}" for n in range(int(first), int(last) + 1)}
        else:
            out.add(word)
    return out


def cited_equations() -> dict[str, list[str]]:
    """Each equation number that the package's source cites, with the files that do."""
    out: dict[str, list[str]] = {}
    files = {
        path.resolve() for folder in ("pancam_graph", "factors") for path in (ROOT / folder).rglob("*.py")
    }
    assert files
    for path in sorted(files):
        for numbers in CITED.findall(path.read_text(encoding="utf-8")):
            for number in expanded(numbers):
                out.setdefault(number, []).append(str(path.relative_to(ROOT)))
    return out


@pytest.fixture(scope="module")
def method() -> str:
    return (DOCS / "method.md").read_text(encoding="utf-8")


def file_of(row: dict[str, str]) -> str:
    """The file of a row, from the top of the repository; what is shown is the end of where the link leads."""
    ((shown, target),) = re.findall(r"^\[`(.+)`\]\(\.\./(.+)\)$", row["file"])
    assert target.endswith(shown)
    return str(target)


def test_every_place_of_the_table_exists(method: str) -> None:
    rows = rows_of(method, "## Where a formula lives")
    assert len(rows) > 50
    wrong = []
    for row in rows:
        file, name = file_of(row), row["name"].strip("`")
        module = file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        if module.startswith("factors"):
            module = f"pancam_graph.{module}"
        if not (ROOT / file).is_file():
            wrong.append(f"{file}: no such file")
            continue
        try:
            reduce(getattr, name.split("."), importlib.import_module(module))
        except AttributeError as error:
            wrong.append(f"{file}: {error}")
    assert wrong == []


def test_equations_of_code_and_table_are_the_same(method: str) -> None:
    table = set[str]()
    for row in rows_of(method, "### Numbered equations of the thesis"):
        assert "to" not in row["equation"], "each number by itself, so that a search finds it"
        table |= expanded(row["equation"])
    code = cited_equations()
    assert {n: files for n, files in code.items() if n not in table} == {}, "cited in the code only"
    assert table - set(code) == set(), "in the table only"
    assert {"4.8", "3.40", "4.11"} <= table


@pytest.mark.parametrize(
    "what", ["CAHVOR", "where pan wraps", "where outliers are judged", "4.8", "3.40", "4.11"]
)
def test_two_opened_files_lead_from_the_readme_to_the_code(method: str, what: str) -> None:
    """README links to the table, and one row of the table has what is sought, its file and its function."""
    assert "(docs/method.md#where-a-formula-lives)" in (ROOT / "README.md").read_text(encoding="utf-8")
    rows = rows_of(method, "## Where a formula lives")
    found = [
        row for row in rows if any(re.search(rf"(?<![\d.]){re.escape(what)}\b", c) for c in row.values())
    ]
    assert found
    assert all((ROOT / file_of(row)).is_file() for row in found)


def slug(heading: str) -> str:
    """The anchor that GitHub and the site give a heading of plain words."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted(ROOT.glob("C*.md")), *sorted(DOCS.rglob("*.md"))]


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_links_lead_to_pages_and_headings(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    wrong = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"(https?|mailto):", target):
            continue
        file, _, anchor = target.partition("#")
        path = page.parent / file if file else page
        if not path.exists():
            wrong.append(target)
        elif anchor and path.suffix == ".md":
            headings = re.findall(r"(?m)^#+ (.+)$", path.read_text(encoding="utf-8"))
            if anchor not in {slug(heading) for heading in headings}:
                wrong.append(target)
    assert wrong == []


def python_of(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)


def run(blocks: list[str], page: str) -> dict[str, Any]:
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, page, "exec"), names)
    return names


@pytest.mark.slow
def test_the_python_of_own_rig_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All but the block that renders pictures; what the page says of its numbers is so."""
    monkeypatch.chdir(tmp_path)
    names = run([block for block in python_of("own_rig.md") if "pg.render" not in block], "own_rig.md")
    printed = capsys.readouterr().out
    (_, usual), (_, told) = re.findall(r"residuals ([\d.]+) -> ([\d.]+) px", printed)
    (held,) = re.findall(r"held: ([\d.]+) px .* passed: False", printed)
    assert max(float(usual), float(told)) < 0.35
    assert float(held) > 0.6
    aside = [int(number) for number in re.findall(r"(\d+) set aside", printed)]
    outliers = int(names["field"].truth.outlier.sum())
    assert max(aside[0], aside[2]) < 2 * outliers
    assert aside[1] > 4 * outliers
    assert (tmp_path / "field" / "traverse.json").exists()
    assert (tmp_path / "out" / "field" / "report.html").exists()
    assert names["fit"].worst_rad < 1e-9


@pytest.mark.slow
def test_pictures_of_own_rig_are_solved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first, *others = python_of("own_rig.md")
    names = run(
        [first, *(block for block in others if "pg.render" in block or "real_rig =" in block)], "own_rig.md"
    )
    assert names["solution"].converged
    assert names["solution"].rms_final_px < 0.2
    assert (tmp_path / "out" / "pictures" / "report.html").exists()


@pytest.mark.slow
def test_the_python_of_own_pictures_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From rendered pictures without their traverse to refined pointing; the page asserts its numbers."""
    monkeypatch.chdir(tmp_path)
    names = run(python_of("own_pictures.md"), "own_pictures.md")
    assert names["solution"]["converged"]
    assert (tmp_path / "out" / "pictures" / "report.html").exists()


def test_one_version_everywhere() -> None:
    """The version is in pancam_graph/__init__.py; what repeats it for readers is the same."""
    version = re.escape(pancam_graph.__version__)
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.findall(r"(?m)^## \[([\d.]+)\] - (\d{4}-\d\d-\d\d)$", changelog)
    (date,) = (day for number, day in released if number == pancam_graph.__version__)
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(rf"(?m)^version: {version}$", citation)
    assert f'date-released: "{date}"' in citation
    assert 'dynamic = ["version"]' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_modules_that_the_architecture_names_exist() -> None:
    """`room/_module.py` and `_module.py`; names in capitals stand for what somebody adds."""
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    named = {name for name in re.findall(r"`([\w/]+\.py)`", text) if not re.search(r"[A-Z]", name)}
    assert len(named) > 30
    files = [
        path.relative_to(ROOT)
        for folder in ("pancam_graph", "factors")
        for path in (ROOT / folder).rglob("*.py")
    ]
    known = {"/".join(path.parts[i:]) for path in files for i in range(len(path.parts))}
    assert named - known == set()


def test_the_architecture_has_the_rooms_of_the_contract() -> None:
    layers = (ROOT / ".importlinter").read_text(encoding="utf-8").split("layers =")[1].split("exhaustive")[0]
    rows = rows_of((DOCS / "architecture.md").read_text(encoding="utf-8"), "## Rooms")
    assert [set(re.findall(r"`(\w+)`", row["room"])) for row in rows] == [
        set(re.findall(r"\w+", line)) for line in layers.strip().splitlines()
    ]
