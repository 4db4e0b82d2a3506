"""Writing results: complete or not at all, and never over existing files."""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

from experiments.figures import draw
from experiments.running import Sample, summarise
from experiments.tables import results_text
from experiments.verdicts import Results, Verdict, verdicts
from pancam_graph.base.errors import InputError

__all__ = ["require_new", "write_results"]


def require_new(out: Path) -> None:
    """Raise InputError unless `out` is new or an empty folder."""
    if out.is_symlink() or (out.exists() and not (out.is_dir() and not any(out.iterdir()))):
        raise InputError(f"{out}: expected a new or empty folder, found something there")


def write_results(samples: Sequence[Sample], left_out: Sequence[str], out: Path) -> list[Verdict]:
    """Write results.json, figures and results.md into the folder `out`; returns the verdicts."""
    require_new(out)
    rows = summarise(samples)
    results = Results(rows)
    judged = verdicts(results)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as beside:
        folder = Path(beside) / "results"
        folder.mkdir()
        entries = [row.to_json() for row in rows]
        text = json.dumps(entries, indent=1, allow_nan=False, ensure_ascii=False)
        (folder / "results.json").write_text(text + "\n", encoding="utf-8")
        figures = draw(results, folder)
        (folder / "results.md").write_text(
            results_text(rows, samples, judged, left_out, figures), encoding="utf-8"
        )
        folder.rename(out)
    return judged
