"""Refine a rover traverse: mast poses, pointing and terrain points from images taken by a camera mast.

TRAVERSE is a folder with traverse.json, or a folder of rover images with PDS labels (MER, MSL,
Mars 2020). OUT gets solution.json, points.ply, residuals.csv and report.html, and with
--mosaic a folder of mosaics; an older OUT is replaced once the new results are complete.
OUT/cache keeps what was found in images: the same command goes on after an interrupt, and again
only with what has changed.

Exit status: 0 solved, 1 not converged (results are written), 2 bad input (nothing is written),
130 interrupted.
"""

import time
from dataclasses import replace
from typing import Any

from pancam_graph import SolveOptions, cross_validate, find_observations, read_input, solve
from pancam_graph.cli._program import Parser, Progress, print_summary, resumable, run, show_log
from pancam_graph.cli._refine_options import add_main_options
from pancam_graph.data._sharing import parse_sharing
from pancam_graph.images import cache_folder
from pancam_graph.landmarks.kernel import must_compile
from pancam_graph.mosaic import MosaicOptions
from pancam_graph.results import check_exports, check_out, write_results
from pancam_graph.smoother._incremental import solve_incrementally
from pancam_graph.solve._solve import COMPILING
from pancam_graph.solve._stopping import criteria


def main() -> int:
    """Read, match images where observations are missing, solve, write."""
    parser = Parser(__doc__ or "")
    add_main_options(parser)
    arguments = parser.parse_args()
    show_log(verbose=arguments.verbose)
    choices = {name: getattr(arguments, name) for name in ("model", "landmarks", "method", "loss")}
    sharing = parse_sharing(arguments.sharing)
    # Covariances of terrain points take at most a twentieth of the solve: points.ply always has them.
    stopping: dict[str, Any] = criteria(arguments.stop)
    options = SolveOptions(**choices, sharing=sharing, landmark_covariances=True, **stopping)
    progress = Progress()

    begin = time.perf_counter()
    check_out(arguments.out)
    with progress.shown(f"reading {arguments.traverse}"), resumable(arguments.out):
        traverse = read_input(arguments.traverse)
        check_exports(traverse, arguments.export)
        options = replace(options, sharing=parse_sharing(arguments.sharing, traverse.sharing))
        if traverse.observations is None:
            traverse = find_observations(
                traverse, progress=progress.counted, cache=cache_folder(arguments.out)
            )
        read_s = time.perf_counter() - begin
        if must_compile():
            progress.say(COMPILING)
        if arguments.incremental:
            solution = solve_incrementally(traverse, options, on_stop=progress.stop)
        else:
            solution = solve(traverse, options, on_iteration=progress.iteration)
        solution = solution.with_seconds(read=read_s)
        if arguments.cross_validate:
            found = cross_validate(traverse, options, solution=solution, progress=progress.counted)
            solution = solution.with_cross_validation(found)
        progress.say("writing the results")
        mosaics = MosaicOptions() if arguments.mosaic else None
        results = {"report": not arguments.no_report, "exports": arguments.export, "mosaics": mosaics}
        solution = write_results(solution, arguments.out, **results, progress=progress.counted)
    print_summary(solution, str(arguments.out))
    return 0 if solution.converged else 1


if __name__ == "__main__":
    run(main)
