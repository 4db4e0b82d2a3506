"""The report in a browser: names full of HTML and script do nothing there."""

import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from pancam_graph.report import write_report
from support.made_solutions import fabricate

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SET = "document.documentElement.dataset.owned='yes'"
HOSTILE = [
    f"</script><script>{SET}</script>",
    f'"><img src=x onerror="{SET}">',
    f"'><svg onload={SET}>",
    f'<a href="javascript:{SET}">press</a>',
    f"</title></style></select></option><script>{SET}</script>",
    "`${" + SET + "}`",
    f"\\u003cscript>{SET}</script>",
]


class Elements(HTMLParser):
    """The elements of a page with their attributes, once its scripts have run."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
@pytest.mark.parametrize("name", HOSTILE)
def test_no_name_runs_as_script(name: str, tmp_path: Path) -> None:
    solution = fabricate(ids=lambda old: f"{name}{old}", points=60, stops=2, pans=2, folder=tmp_path)
    for number, image in enumerate(solution.traverse.images):
        if number % 2:
            cv2.imwrite(str(tmp_path / str(image.file)), np.full((1024, 1024), 90, np.uint8))
    solution = replace(
        solution, warnings=(name,), stop_reason=name, model="free" if len(name) % 2 else "mast"
    )
    write_report(solution, tmp_path / "report.html")
    assert BROWSER is not None
    words = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=20000",
        "--dump-dom",
    ]
    profile = f"--user-data-dir={tmp_path / 'profile'}"
    done = subprocess.run(
        [*words, profile, (tmp_path / "report.html").as_uri()], capture_output=True, text=True, check=True
    )
    elements = Elements()
    elements.feed(done.stdout)
    _, page = next(e for e in elements.found if e[0] == "html")
    assert page.get("data-drawn") == "yes"
    assert "data-owned" not in page
    for _, attributes in elements.found:
        assert not [a for a in attributes if a in {"onerror", "onload"}]
        assert not (attributes.get("href") or "").startswith("javascript:")
