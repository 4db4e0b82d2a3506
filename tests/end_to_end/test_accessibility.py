"""Pages are usable without a mouse and by screen readers, as far as axe-core can tell (Deque Systems)."""

import json
import os
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from pancam_graph.cli import main

AXE = Path(os.environ.get("PANCAM_GRAPH_AXE", "no such file"))
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
RUN = """<script>addEventListener("load", () => setTimeout(async () => {
  const found = await axe.run(document, {resultTypes: ["violations"]});
  const out = document.createElement("pre");
  out.id = "axe";
  out.textContent = JSON.stringify(found.violations.map((v) => [v.id, v.impact, v.nodes[0].html]));
  document.body.append(out);
}, 5000));</script></body>"""


def violations(page: Path) -> list[Any]:
    """What axe-core finds wrong with a page once its figures are drawn."""
    script = AXE.read_text(encoding="utf-8").replace("</script", "<\\/script")
    head, _, tail = page.read_text(encoding="utf-8").rpartition("</body>")
    tested = page.with_name("tested.html")
    tested.write_text(f"{head}<script>{script}</script>{RUN}{tail}", encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=60000"]
    command = [str(BROWSER), *options, f"--user-data-dir={page.parent / 'browser'}", "--dump-dom"]
    dumped = subprocess.run([*command, tested.as_uri()], check=True, capture_output=True, text=True).stdout
    (found,) = re.findall(r'<pre id="axe">(.*?)</pre>', dumped, flags=re.DOTALL)
    wrong: list[Any] = json.loads(unescape(found))
    return wrong


@pytest.mark.slow
@pytest.mark.skipif(
    BROWSER is None or not AXE.is_file(),
    reason="needs Chromium, and axe.min.js of the npm package axe-core at PANCAM_GRAPH_AXE",
)
def test_the_report_and_the_page_of_a_drive_have_no_finding(tmp_path: Path) -> None:
    simulated, out, drive = tmp_path / "simulated", tmp_path / "out", tmp_path / "drive.html"
    assert main(["simulate", str(simulated), "--rig", "mer-navcam", "--stops", "2"]) == 0
    assert main(["refine", str(simulated), "--out", str(out)]) == 0
    assert violations(out / "report.html") == []
    assert main(["drive", str(drive), "--stops", "4"]) == 0
    assert violations(drive) == []
