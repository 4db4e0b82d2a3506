"""The subcommand simulate: a traverse of made-up points, with its truth."""

import math
from pathlib import Path

from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._drive_options import add_drive_options, drive_options
from pancam_graph.cli._parser import CommandParser

__all__ = ["SIMULATE"]

_DESCRIPTION = """\
Simulate a rover traverse with known truth and write it as a traverse folder.

OUT gets traverse.json and observations.npz, which pancam-graph refine reads, and truth.npz, which no solver
reads: world_T_mast (stops,4,4), pan_tilt_rad (frames,2), landmarks_m (tracks,3), and per observation uv_px
without noise and outlier. Metres, radians, z up. Same options, same numbers.

Exit status: 0 written, 2 bad input or a fault (nothing is written), 130 interrupted.
"""


def _add_options(parser: CommandParser) -> None:
    add_drive_options(
        parser,
        stops=3,
        spacing_m=4.0,
        pans=None,
        sweep_rad=math.tau,
        say_pans="so many that the widest eye's overlap by 28 %%",
        say_sweep="360",
        say_tilts="two rows",
    )
    add = parser.add_argument
    add("out", metavar="OUT", type=Path, help="folder to write; must be new or empty")
    add(
        "--points-per-image",
        type=int,
        default=25,
        help="about how many terrain points an image shows (%(default)s)",
    )
    add("--noise-px", type=float, default=0.3, help="sigma of the pixels, per coordinate (%(default)s)")
    add("--noise-stretch", type=float, default=1.0, help="length over width of error ellipses (1: round)")
    add(
        "--field-error",
        choices=("none", "drawn"),
        default="none",
        help="drawn: images have a smooth distortion field, as large as the rig's uncertainty says (none)",
    )
    add(
        "--outliers",
        type=float,
        default=0.0,
        help="share of observations that are random pixels (%(default)s)",
    )


def _work(call: Invocation) -> int:
    """Simulate and write."""
    from pancam_graph import SimulationOptions, simulate, write_traverse
    from pancam_graph.rigs import rig_template
    from pancam_graph.simulate import check_new, write_truth

    out = call.arguments.out
    options = drive_options(call.arguments, SimulationOptions)
    check_new(out)
    with call.progress.shown("simulating"):
        made = simulate(rig_template(call.arguments.rig), options, seed=call.arguments.seed)
        write_traverse(made.traverse, out)
        write_truth(made.truth, out)
    counts = f"{len(made.traverse.stops)} stops, {len(made.traverse.images)} images"
    call.say(f"{out}: {counts}, {len(made.truth.landmarks_m)} tracks, {len(made.truth.uv_px)} observations")
    return 0


SIMULATE = Command(
    name="simulate",
    summary="make up a traverse of observed points, with its truth",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
