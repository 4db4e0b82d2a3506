"""Measure the way from image files to a solution: time of each step, memory, and images a minute.

TRAVERSE is a folder of a traverse with image files. If it does not exist, it is rendered first, in another
process: MER Navcam stereo panoramas of 20 images of 1024 x 1024 each, ten stops 7 m apart, so 200 images.
No cache is used.

Exit status: 0 solved; 1 not converged; 2 bad input.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.memory import peak_memory_mb
from benchmarks.steps import Steps
from pancam_graph import find_observations, read_input, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.threads import n_workers
from pancam_graph.cli import Progress, ScriptParser, run, show_log
from pancam_graph.results import write_results

RENDER = Path(__file__).with_name("render_traverse.py")


def main() -> int:
    """Render where that is needed, measure, print."""
    parser = ScriptParser(__doc__ or "")
    parser.add_argument("traverse", metavar="TRAVERSE", type=Path)
    parser.add_argument("--stops", type=int, default=10, help="to render (%(default)s)")
    parser.add_argument("--rig", default="mer-navcam", help="to render (%(default)s)")
    a = parser.parse_args()
    show_log(verbose=a.verbose)
    progress = Progress()
    if not a.traverse.exists():
        command = [sys.executable, str(RENDER), "--out", a.traverse, "--rig", a.rig, "--stops", str(a.stops)]
        if subprocess.run(command, check=False).returncode != 0:
            raise InputError(f"{a.traverse}: expected to render {a.stops} stops of {a.rig} there, it failed")

    steps = Steps()

    def tell(step: str, done: int, total: int) -> None:
        steps.done(step)
        progress.counted(step, done, total)

    with progress.shown("reading"), tempfile.TemporaryDirectory(prefix="pancam-graph-benchmark-") as out:
        traverse = read_input(a.traverse)
        steps.done("traverse")
        matched = find_observations(traverse, progress=tell)
        steps.done("tracks")
        solution = solve(matched, on_iteration=progress.iteration)
        steps.done("solve")
        write_results(solution, Path(out) / "out")
        steps.done("results and report")
    print(steps.table())
    wall_s, n = sum(wall for wall, _ in steps.seconds.values()), len(traverse.images)
    print(
        f"{n} images, {len(solution.used)} observations, {len(solution.landmark_track)} points: "
        f"{60 * n / wall_s:.1f} images a minute on {n_workers()} threads of {os.cpu_count()} cores, "
        f"{peak_memory_mb():.0f} MB at most"
    )
    return 0 if solution.converged else 1


if __name__ == "__main__":
    run(main)
