"""The subcommand register: stops of a refined drive found on a picture from orbit."""

from pathlib import Path
from typing import TYPE_CHECKING

from pancam_graph.base.text import shortened
from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._parser import CommandParser, above_zero, add_images_option
from pancam_graph.cli._streams import write

if TYPE_CHECKING:
    from pancam_graph.terrain import Registration

__all__ = ["REGISTER"]

_DESCRIPTION = """\
Find the stops of a refined drive on a picture from orbit, and write the ties that hold them there.

OUT is a folder of results of stereo frames. Each stop's view from above is sought on the map, turned and
shifted. TIES gets a tie of each stop that is found, with what is known of its place and heading; then

    pancam-graph refine FOLDER --ties TIES --out OTHER

solves the drive again with them. Maps are GeoTIFF: in the world frame of the traverse, or, where that has a
"site", in a map projection of its body.

Needs the extra: pip install 'pancam-graph[terrain]'.

Exit status: 0 all stops were found, 1 some were (each other one has a sentence), 2 bad input, none found or a
fault (nothing is written), 130 interrupted.
"""


def _add_options(parser: CommandParser) -> None:
    add = parser.add_argument
    add("out", metavar="OUT", type=Path, help="folder of results")
    add("--map", metavar="ORTHO.tif", type=Path, required=True, help="picture from above, its first band")
    add(
        "--dem",
        metavar="DEM.tif",
        type=Path,
        help="heights in metres, first band: stops are tied to them too",
    )
    add("--ties", metavar="TIES", type=Path, required=True, help="new file for the ties (JSON)")
    add(
        "--search",
        type=above_zero,
        default=15.0,
        metavar="M",
        help="how far off a stop may be along x and along y, metres (%(default)s)",
    )
    add(
        "--turn",
        type=above_zero,
        default=6.0,
        metavar="DEG",
        help="how far a stop may be turned, degrees (%(default)s)",
    )
    add_images_option(parser)


def _work(call: Invocation) -> int:
    """Match the stops' ground, find it on the map, write ties."""
    import math

    from pancam_graph.base.errors import InputError
    from pancam_graph.io import write_ties
    from pancam_graph.results import register
    from pancam_graph.terrain import require_extra

    arguments, progress = call.arguments, call.progress
    require_extra()
    if arguments.ties.exists():
        raise InputError(f"{arguments.ties}: expected a new file, found one that is there")
    with progress.shown(f"reading {arguments.out}"):
        registered = register(
            arguments.out,
            arguments.map,
            arguments.dem,
            images=arguments.images,
            search_m=arguments.search,
            search_rad=math.radians(arguments.turn),
            progress=progress.counted,
        )
    write_ties(registered.ties, arguments.ties)
    for one in registered.found:
        call.say(_said(one))
    for sentence in registered.missing:
        write("stderr", shortened(f"warning: {sentence}"))
    call.say(f"{arguments.ties}: ties of {len(registered.ties)} stops, for pancam-graph refine --ties")
    return 1 if registered.missing else 0


def _said(found: "Registration") -> str:
    """How a stop moves onto the map, as a sentence."""
    import math

    sigma_m = math.sqrt(max(found.covariance[1, 1], found.covariance[2, 2]))
    sigma_deg = math.degrees(math.sqrt(found.covariance[0, 0]))
    height = "" if found.height_m is None else f", {found.height_m:+.2f} m up ({found.sigma_height_m:.2f})"
    return (
        f"stop {found.stop}: moves by {found.shift_m[0]:+.2f} m along x, {found.shift_m[1]:+.2f} m along y "
        f"({sigma_m:.2f}), turns by {math.degrees(found.turn_rad):+.2f} degrees ({sigma_deg:.2f}){height}; "
        f"{found.sigmas:.0f} sigma above chance"
    )


REGISTER = Command(
    name="register",
    summary="find the stops of a refined drive on a picture from orbit",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
