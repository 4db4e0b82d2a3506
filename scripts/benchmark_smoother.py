"""Measure the smoother stop by stop on simulated drives, against one batch of all stops by Ceres Solver.

A stop should take less than a tenth of that batch, and the last estimate should be that of the batch. Prints
a table of the slowest stop of each drive (the first drive of a process, and the fastest of the warm ones),
and of the differences in cost, poses and sigmas; writes all figures as JSON.

Exit status: 0; 1 an engine failed; 2 bad input.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.cases import CASES, chosen_cases, make
from benchmarks.engines import ENGINES, NotRun, measure, run_module
from benchmarks.running import prepare
from pancam_graph.base.errors import InputError
from pancam_graph.cli import ScriptParser, run, show_log

_ENGINE = "eliminated"
"""The engine whose compiled code the smoother uses."""


def main() -> int:
    """Make the cases, drive, solve all at once with Ceres, write."""
    parser = ScriptParser(__doc__ or "")
    add = parser.add_argument
    default = ["mid", "long"]
    add("--cases", nargs="+", choices=CASES, default=default, metavar="CASE", help=", ".join(CASES))
    add("--repeats", type=int, default=3, help="warm drives (%(default)s)")
    add("--ceres", type=Path, help="compiled program (compiled from ../shared/bench where that is possible)")
    add("--json", type=Path, help="file to write; must be new (out/benchmark-smoother-TIME.json)")
    a = parser.parse_args()
    show_log(verbose=a.verbose)
    path = a.json or Path("out") / f"benchmark-smoother-{time.strftime('%Y%m%d-%H%M%S')}.json"
    if path.exists():
        raise InputError(f"{path}: expected a new file, found one that is there")
    path.parent.mkdir(parents=True, exist_ok=True)
    failed, figures = False, {}
    print("case   stops  slowest stop: first, warm   Ceres, all   ratio   cost off   poses off   sigmas off")
    with tempfile.TemporaryDirectory(prefix="pancam-graph-benchmark-") as work:
        cases = chosen_cases(a.cases, engines=[_ENGINE, "ceres"], repeats=a.repeats)
        setting = prepare(cases, Path(work), a.ceres)
        for case in cases:
            print(f"{case.name}: simulating and driving", file=sys.stderr)
            files, size = make(case, Path(work) / case.name)
            drive = ["benchmarks.drive_with_us", str(files.traverse), f"--repeats={case.repeats}"]
            # Twice: the first process may compile.
            for _ in range(2):
                ours = run_module(drive, setting.child_environment(_ENGINE))
            if isinstance(ours, NotRun):
                print(f"{case.name}: {ours.reason}")
                failed = True
                continue
            peer = measure(ENGINES["ceres"], files, setting, case.repeats)
            peer_s = None if isinstance(peer, NotRun) else peer.best_s
            failed |= isinstance(peer, NotRun) and peer.failed
            figures[case.name] = {**ours, "stops": size.stops, "ceres_s": peer_s}
            best = min(ours["seconds"])
            against = f"{peer_s:8.3f} s {peer_s / best:7.1f}" if peer_s else f"{'not run':>18}"
            off = f"{ours['cost_off']:+10.1e} {ours['pose_off_sigma']:8.3f} sigma"
            print(
                f"{case.name:<8}{size.stops:4d} {ours['first_s']:17.3f} s {best:8.3f} s {against} {off} "
                f"{100 * ours['sigma_off']:8.3f} %"
            )
    path.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    print(f"all figures: {path}")
    return int(failed)


if __name__ == "__main__":
    run(main)
