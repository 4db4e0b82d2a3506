"""The first page keeps its word."""

import re
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[2] / "README.md"


@pytest.fixture(scope="module")
def readme() -> str:
    if not README.exists():
        pytest.skip("no README.md: it is part of the repository, not of the installed package")
    return README.read_text(encoding="utf-8")


def test_the_python_of_the_first_page_runs(
    readme: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    assert (tmp_path / "out" / "python" / "report.html").exists()
    before, after = map(float, re.findall(r"([\d.]+) -> ([\d.]+) px", capsys.readouterr().out)[0])
    assert after < 0.5 < before


def test_links_lead_somewhere(readme: str) -> None:
    targets = re.findall(r"\]\((?!https?:)([^)#]+)\)", readme)
    assert targets
    assert [t for t in targets if not (README.parent / t).exists()] == []
