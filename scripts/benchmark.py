"""Measure the solver against its peers on simulated drives, and against the committed baseline.

Every engine solves each case in a new process. Prints a table for docs/performance.md; writes all figures as
JSON. Absolute times change between machines and hours. Only ratios within one run are compared; the file
scripts/benchmark_baseline.json keeps them.

Exit status: 0 as good as the baseline; 1 final costs differ, an engine failed, the time grows faster than
the drive or a ratio got worse; 2 bad input.
"""

import sys
import tempfile
import time
from pathlib import Path

from benchmarks.cases import CASES, DEFAULT_CASES, chosen_cases
from benchmarks.engines import ENGINES
from benchmarks.report import against_baseline, read_baseline, write_baseline
from benchmarks.running import prepare, run_cases
from benchmarks.terrain import measure_terrain, table
from pancam_graph.base.errors import InputError
from pancam_graph.cli import ScriptParser, run, show_log

BASELINE = Path(__file__).with_name("benchmark_baseline.json")


def main() -> int:
    """Make the cases, measure, compare, write."""
    parser = ScriptParser(__doc__ or "")
    add = parser.add_argument
    add("--cases", nargs="+", choices=CASES, default=DEFAULT_CASES, metavar="CASE", help=", ".join(CASES))
    add(
        "--engines",
        nargs="+",
        choices=ENGINES,
        metavar="ENGINE",
        help=f"{', '.join(ENGINES)} (each case's own)",
    )
    add("--repeats", type=int, help="warm solves, of which the fastest counts (each case's own)")
    add("--ceres", type=Path, help="compiled program (compiled from ../shared/bench where that is possible)")
    add("--json", type=Path, help="file to write; must be new (out/benchmark-TIME.json)")
    add("--tolerance", type=float, default=0.25, help="how much worse a ratio may get (%(default)s)")
    add(
        "--terrain",
        nargs=2,
        action="append",
        metavar=("RIG", "SEED"),
        help="instead of solving: render, refine and make terrain of this drive, each as a process, and "
        "compare with the rendering's truth; may be repeated",
    )
    add("--write-baseline", action="store_true", help=f"renew the measured ratios in {BASELINE.name}")
    a = parser.parse_args()
    show_log(verbose=a.verbose)
    if a.terrain:
        with tempfile.TemporaryDirectory(prefix="pancam-graph-benchmark-") as work:
            found = [measure_terrain(rig, _whole(seed), Path(work)) for rig, seed in a.terrain]
        print(table(found))
        return 0
    path = a.json or Path("out") / f"benchmark-{time.strftime('%Y%m%d-%H%M%S')}.json"
    if path.exists():
        raise InputError(f"{path}: expected a new file, found one that is there")
    path.parent.mkdir(parents=True, exist_ok=True)
    cases, baseline = chosen_cases(a.cases, engines=a.engines, repeats=a.repeats), read_baseline(BASELINE)

    with tempfile.TemporaryDirectory(prefix="pancam-graph-benchmark-") as work:
        setting = prepare(cases, Path(work), a.ceres)
        report = run_cases(
            cases, setting, Path(work) / "cases", say=lambda text: print(text, file=sys.stderr)
        )
    faults = report.complaints()
    if a.write_baseline and not faults:
        changes = write_baseline(BASELINE, report.ratios())
    else:
        worse, changes = against_baseline(report.ratios(), baseline, a.tolerance)
        faults += worse
    path.write_text(report.to_json(), encoding="utf-8")
    print(report.text([*changes, f"all figures: {path}"], faults))
    return 1 if faults else 0


def _whole(text: str) -> int:
    """A seed. Raises InputError for what is no whole number."""
    if not text.isdecimal():
        raise InputError(f"--terrain: expected a seed of 0 or more, found {text}")
    return int(text)


if __name__ == "__main__":
    run(main)
