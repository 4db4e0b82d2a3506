"""The subcommand refine: adjust a traverse and write a folder of results."""

import time
from collections.abc import Iterable
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pancam_graph.cli._collector import loading
from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._parser import Assignment, CommandParser, Flag, LateChoice, Several
from pancam_graph.cli._workers import add_cluster_option, workers

if TYPE_CHECKING:
    from pancam_graph import SolveOptions
    from pancam_graph.data import Solution, Traverse
    from pancam_graph.initialise import Start
    from pancam_graph.smoother import TraverseSmoother

__all__ = ["REFINE", "started"]

_DESCRIPTION = """\
Refine a rover traverse: mast poses, pointing and terrain points from images taken by a camera mast.

FOLDER has a traverse.json, which pancam-graph init makes of plain pictures, or rover images with PDS labels
(MER, MSL, Mars 2020). OUT gets solution.json, points.ply, residuals.npz and report.html, and with --mosaic a
folder of mosaics; an older OUT is replaced once the new results are complete. OUT/cache keeps what was found
in images: the same command goes on after an interrupt, and again only with what has changed.

Exit status: 0 solved and passed its tests, 1 not converged or a test failed (results are written, and say
which), 2 bad input or a fault (nothing is written), 130 interrupted.
"""
_SHARING_HELP = (
    "what of the rig is estimated, and who shares it, in one or more WORDs: "
    "QUANTITY=SCOPE[:ENTRY[~SIGMA],...] with quantities calibration (fx_px fy_px skew_px cx_px cy_px; focal "
    "and aspect, factors, in place of fx_px fy_px), mounts and pan_T_tilt (rx_rad ry_rad rz_rad "
    "x_m y_m z_m), radius (radius_m; model circle), flex (twist_rad forward_m left_m up_m; scope frame), "
    "encoders (pan_scale tilt_scale; scope all) "
    "and scopes fixed, all, eye, stop, image; without entries "
    "all are free; SIGMA is the prior's, inf for none; what traverse.json says of a quantity is overridden; "
    "for example calibration=eye:focal mounts=eye"
)


def _exports() -> Iterable[str]:
    from pancam_graph.results import EXPORTS

    return EXPORTS


def _add_options(parser: CommandParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="folder to read")
    add("--out", type=Path, required=True, help="folder to write")
    add(
        "--add",
        action=Several,
        type=Path,
        default=(),
        metavar="FOLDER",
        help="a folder with more of the same drive, such as the pictures of a later sol; may be repeated: "
        "with OUT of the drive so far, pictures and stops that it does not see are not matched again",
    )
    add(
        "--model",
        choices=("mast", "circle", "free", "projective"),
        default="mast",
        help="mast: rigid pan-tilt mast (default); circle: camera centres on the mast's circles, rotations "
        "free; free: every camera on its own; projective: every projection matrix on its own",
    )
    add(
        "--landmarks",
        choices=("eliminated", "explicit"),
        default="eliminated",
        help="eliminated: terrain points follow the cameras (default); explicit: they are variables, slow",
    )
    add(
        "--method",
        choices=("joint", "alternation"),
        default="joint",
        help="joint: everything at once (default); alternation: what all stops share and everything else in "
        "turn, slow",
    )
    add(
        "--loss",
        choices=("none", "huber", "cauchy"),
        default="huber",
        help="robust loss while outliers are sought (default huber); none: keep every observation",
    )
    add(
        "--noise",
        choices=("stated", "estimated"),
        help="stated: sigmas of the observations count as they are given; estimated: residuals rescale them "
        "(default: stated for observations of FOLDER, estimated for those found in its images)",
    )
    add(
        "--stop",
        action=Several,
        type=Assignment(),
        default=(),
        metavar="NAME=NUMBER",
        help="when the final iterations end; one or more of max_iterations (default 100), "
        "relative_decrease (of the cost, 1e-7), relative_step, max_gradient, residual_sigmas; 0: not used",
    )
    add(
        "--rig",
        choices=("estimated", "held", "considered"),
        default="estimated",
        help="estimated: what images say of cameras, mounts and tilt axis is estimated, within the rig's "
        "uncertainty (default); held: the rig counts as exact; considered: it is not moved, but its "
        "uncertainty is in every sigma",
    )
    add(
        "--use-rig",
        type=Path,
        metavar="FILE",
        help="rig.json of an earlier run with --export rig, of the same unit and other pictures: it takes "
        "the place of the rig of FOLDER, and its covariance is the prior",
    )
    add(
        "--start",
        type=Path,
        metavar="PATH",
        help="begin at what another program found: a folder with a COLMAP model, Bundler's bundle.out, or "
        "CAHVOR files, in any world and scale, or a .nav of marsnav; priors stay those of the traverse",
    )
    add(
        "--ties",
        type=Path,
        metavar="FILE",
        help="ties to what is known, beside those of the traverse: a file that register wrote, or "
        "constraints as traverse.json has them",
    )
    add(
        "--field",
        choices=("auto", "estimated", "held"),
        default="auto",
        help="smooth distortion field of each eye, beside its lens; auto: estimated with the rig where tie "
        "points are found in the images, held where they come with the input, as it makes a solve take 1.5 "
        "to 3 times as long",
    )
    add("--sharing", action=Several, type=Assignment(), default=(), metavar="WORD", help=_SHARING_HELP)
    add(
        "--incremental",
        action=Flag,
        help="add the stops one by one as a rover does, with iSAM2 (model mast), a line for each",
    )
    add(
        "--cross-validate",
        action=Flag,
        help="check the formal sigmas: solve halves of the terrain points too, and say how far they differ",
    )
    _add_outputs(parser)


def _add_outputs(parser: CommandParser) -> None:
    """What is written besides the solution."""
    add = parser.add_argument
    add(
        "--export",
        action=Several,
        type=LateChoice(_exports),
        default=(),
        metavar="FORMAT",
        help="write a folder more into OUT for each of one or more FORMATs, such as colmap (undistorted "
        "images and a model with rigs and frames, for dense reconstruction), cahvor (the refined cameras "
        "as text files) and rig (the refined rig with its covariance, for --use-rig); an unknown one lists "
        "all",
    )
    add(
        "--mosaic",
        action=Flag,
        help="write mosaics of each stop before and after too, around the horizon and from above",
    )
    add(
        "--terrain",
        action=Flag,
        help="write heights, an orthoimage, a mesh and a cloud of the ground that stereo frames see; needs "
        "the extra: pip install 'pancam-graph[terrain]'",
    )
    add_cluster_option(parser)
    add(
        "--stretches",
        type=int,
        default=1,
        metavar="N",
        help="eliminate a long drive in N stretches of its stops, one of which is in memory at a time, the "
        "others on disk (in TMPDIR); the optimum and its sigmas are the same (%(default)s)",
    )
    add("--csv", action=Flag, help="write residuals.csv too, a line for each observation")
    add(
        "--plots",
        type=Path,
        metavar="DIR",
        help="draw the report's figures as SVG and PNG into a folder of their own, with all tables as CSV; "
        "needs Chrome or Chromium and the extra: pip install 'pancam-graph[plots]'",
    )
    add("--report", action=Flag, default=True, help="write report.html (default)")


def _work(call: Invocation) -> int:
    """Read, match images where observations are missing, solve, write."""
    with loading():
        from pancam_graph import SolveOptions, read_input, solve
        from pancam_graph.cli._resumable import resumable
        from pancam_graph.cli._summary import print_summary
        from pancam_graph.data import parse_sharing
        from pancam_graph.io import read_ties, use_rig
        from pancam_graph.landmarks.kernel import must_compile
        from pancam_graph.results import check_exports, check_out, write_results
        from pancam_graph.solve import COMPILING, criteria

    arguments, progress = call.arguments, call.progress
    chosen: dict[str, Any] = {
        n: getattr(arguments, n) for n in ("model", "landmarks", "method", "loss", "rig", "stretches")
    }
    chosen.update(criteria(arguments.stop))
    chosen["rescale_noise"] = None if arguments.noise is None else arguments.noise == "estimated"
    chosen["field"] = {"auto": None, "estimated": True, "held": False}[arguments.field]
    sharing = parse_sharing(arguments.sharing)
    # Covariances of terrain points take about a tenth of a solve: points.ply always has them.
    options = SolveOptions(**chosen, sharing=sharing, landmark_covariances=True)

    begin = time.perf_counter()
    if arguments.terrain:
        from pancam_graph.terrain import require_extra

        require_extra()
    check_out(arguments.out)
    if arguments.plots is not None:
        from pancam_graph.results import check_plots

        check_plots(arguments.plots)
    with progress.shown(f"reading {arguments.folder}"), resumable(arguments.out), ExitStack() as clients:
        client = clients.enter_context(workers(call))
        traverse = read_input(arguments.folder, *arguments.add)
        if arguments.use_rig is not None:
            traverse = use_rig(traverse, arguments.use_rig)
        if arguments.ties is not None:
            traverse = read_ties(arguments.ties, traverse)
        start = None
        if arguments.start is not None:
            traverse, start = started(traverse, arguments.start, incremental=arguments.incremental)
        check_exports(traverse, arguments.export)
        options = replace(
            options,
            sharing=parse_sharing(arguments.sharing, traverse.sharing),
            stereo_covariances=any(image.file is not None for image in traverse.images),  # for terrain
        )
        if traverse.observations is None:
            from pancam_graph import find_observations
            from pancam_graph.images import cache_folder

            traverse = find_observations(
                traverse, progress=progress.counted, cache=cache_folder(arguments.out), client=client
            )
        clients.close()  # the adjustment has all cores of this machine
        read_s = time.perf_counter() - begin
        if must_compile():
            progress.say(COMPILING)
        smoother = None
        if arguments.incremental:
            solution, smoother = _stop_by_stop(call, traverse, options)
        else:
            solution = solve(traverse, options, start=start, on_iteration=progress.iteration)
        solution = solution.with_seconds(read=read_s)
        if arguments.cross_validate:
            from pancam_graph import cross_validate

            validated = cross_validate(traverse, options, solution=solution, progress=progress.counted)
            solution = solution.with_cross_validation(validated)
        progress.say("writing the results")
        results: dict[str, Any] = {
            "report": arguments.report,
            "csv": arguments.csv,
            "exports": arguments.export,
            "smoother": smoother,
        }
        if arguments.mosaic:
            from pancam_graph.mosaic import MosaicOptions

            results["mosaics"] = MosaicOptions()
        if arguments.terrain:
            from pancam_graph.terrain import TerrainOptions

            results["terrain"] = TerrainOptions()
        with workers(call) if arguments.terrain or arguments.mosaic else nullcontext() as client:
            solution = write_results(
                solution, arguments.out, **results, progress=progress.counted, client=client
            )
        if arguments.plots is not None:
            from pancam_graph.results import write_plots

            progress.say("drawing figures")
            write_plots(solution, arguments.plots)
    print_summary(solution, str(arguments.out), quiet=arguments.quiet)
    return 0 if solution.passed else 1


def _stop_by_stop(
    call: Invocation, traverse: "Traverse", options: "SolveOptions"
) -> "tuple[Solution, TraverseSmoother]":
    """The solution with stops added one by one; with --add those that the smoother of OUT lacks alone."""
    from pancam_graph.results import SMOOTHER_FILE
    from pancam_graph.smoother import continued, smoother_for, solve_incrementally

    smoother, n_stops = None, len(traverse.stops)
    kept = call.arguments.out / SMOOTHER_FILE
    if call.arguments.add and kept.exists():
        smoother, why = continued(kept, traverse, options)
        if smoother is None:
            call.say(f"all stops are added anew: {why}")
    if smoother is None:
        smoother = smoother_for(traverse, options)
    solution = solve_incrementally(
        traverse, options, on_stop=lambda update: call.progress.stop(update, n_stops), smoother=smoother
    )
    return solution, smoother


def started(traverse: "Traverse", path: Path, *, incremental: bool) -> "tuple[Traverse, Start]":
    """The start that another program's cameras or pointings give, and the traverse with warnings of them.

    Raises InputError for those of other pictures, and with --incremental, which has starts of its own.
    """
    from pancam_graph.base.errors import InputError
    from pancam_graph.initialise import start_from_poses, start_from_telemetry
    from pancam_graph.io import prefixed
    from pancam_graph.io.posed import images_of, read_posed
    from pancam_graph.io.vicar import read_nav, with_pointing

    if incremental:
        raise InputError("--start: expected without --incremental, which begins each stop by odometry")
    if path.suffix.lower() == ".nav":
        pointed = with_pointing(traverse, read_nav(path), path)
        said = [sentence for sentence in pointed.warnings if sentence not in traverse.warnings]
        return traverse.with_warnings(said), start_from_telemetry(pointed)
    cameras = read_posed(path)
    with prefixed(path):
        known, warnings = images_of(traverse, cameras)
        start = start_from_poses(traverse, {row: camera.world_T_camera for row, camera in known.items()})
    return traverse.with_warnings(warnings), start


REFINE = Command(
    name="refine",
    summary="adjust a traverse of images or observations, and write a report",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
