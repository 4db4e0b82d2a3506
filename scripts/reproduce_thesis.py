"""Run the experiments of the thesis and write results.json, figures (PNG, SVG) and results.md into OUT.

Simulated clusters and traverses are solved over 50 seeds in two processes; so is Opportunity's panorama if
../shared has its images. The same options give the same numbers. Figures need matplotlib:
pip install -e '.[thesis]'.

Exit status: 0 written, 2 bad input (nothing is written).
"""

from pathlib import Path

from experiments.figures import require_matplotlib
from experiments.output import require_new, write_results
from experiments.registry import FAMILIES, plan
from experiments.running import run_tasks
from pancam_graph.base.errors import InputError
from pancam_graph.cli import Progress, ScriptParser, run, show_log


def main() -> int:
    """Plan, run, write."""
    parser = ScriptParser(__doc__ or "")
    add = parser.add_argument
    add("--out", metavar="OUT", type=Path, required=True, help="folder to write; must be new or empty")
    add("--quick", action="store_true", help="5 seeds and two noises, for a look")
    add("--seeds", type=int, help="runs of each simulated experiment (50; with --quick 5)")
    add("--only", nargs="+", choices=FAMILIES, default=FAMILIES, metavar="FAMILY", help=", ".join(FAMILIES))
    add("--processes", type=int, default=2, help="(%(default)s)")
    a = parser.parse_args()
    show_log(verbose=a.verbose)
    seeds = a.seeds if a.seeds is not None else 5 if a.quick else 50
    for name, value in (("--seeds", seeds), ("--processes", a.processes)):
        if value < 1:
            raise InputError(f"{name}: expected 1 or more, found {value}")
    require_new(a.out)
    require_matplotlib()

    chosen, progress = plan(seeds=seeds, quick=a.quick, families=a.only), Progress()
    with progress.shown("running the experiments"):
        samples = run_tasks(chosen.tasks, processes=a.processes, progress=progress.counted)
    verdicts = write_results(samples, chosen.left_out, a.out)
    for verdict in verdicts:
        print(f"{'holds' if verdict.holds else 'does not hold everywhere'}: {verdict.expectation}")
    print(f"{a.out}: results.md, results.json, figures")
    return 0


if __name__ == "__main__":
    run(main)
