"""The subcommand render: a traverse of made-up images, with its truth."""

from pathlib import Path

from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._drive_options import add_drive_options, drive_options
from pancam_graph.cli._parser import CommandParser, Flag, degrees

__all__ = ["RENDER"]

_DESCRIPTION = """\
Render a rover traverse with known truth: image files, and a traverse folder without observations.

OUT gets images/*.png, traverse.json with "observations": null and disturbed telemetry, which pancam-graph
refine reads, and truth.npz, which no solver reads: world_T_mast (stops,4,4) and pan_tilt_rad (frames,2).
Metres, radians, z up. Same options, same bytes.

Exit status: 0 written, 2 bad input or a fault (nothing is written), 130 interrupted.
"""


def _add_options(parser: CommandParser) -> None:
    add_drive_options(
        parser,
        stops=2,
        spacing_m=7.0,
        pans=10,
        sweep_rad=None,
        say_pans="%(default)s",
        say_sweep="as far as frames overlap by 20 %%",
        say_tilts="one row",
    )
    add = parser.add_argument
    add("--out", metavar="OUT", type=Path, required=True, help="folder to write; must be new or empty")
    add(
        "--rocks",
        dest="rock_abundance",
        type=float,
        default=0.05,
        help="share of the ground that rocks cover (%(default)s)",
    )
    add(
        "--sun-elevation-deg",
        dest="sun_elevation_rad",
        type=degrees,
        default=degrees("38"),
        metavar="SUN_ELEVATION_DEG",
        help="height of the sun above the horizon (38)",
    )
    add(
        "--bits",
        type=int,
        choices=(8, 12),
        default=8,
        help="bits of a sample; 12 are written in 16-bit files (%(default)s)",
    )
    add("--deck", action=Flag, help="show the rover's own deck, which moves along with it")


def _work(call: Invocation) -> int:
    """Render and write."""
    from pancam_graph import RenderOptions, render, write_rendering
    from pancam_graph.rigs import rig_template

    out, progress = call.arguments.out, call.progress
    options = drive_options(call.arguments, RenderOptions)
    with progress.shown("making a world"):
        rendering = render(rig_template(call.arguments.rig), options, seed=call.arguments.seed)
        write_rendering(rendering, out, progress=lambda done, n: progress.counted("rendering", done, n))
    call.say(f"{out}: {options.stops} stops, {len(rendering.traverse.images)} images")
    return 0


RENDER = Command(
    name="render",
    summary="make up the images of a traverse, with its truth",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
