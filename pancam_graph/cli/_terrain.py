"""The subcommand terrain: dense surfaces of a drive that was refined earlier."""

from pathlib import Path

from pancam_graph.base.text import shortened
from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._parser import CommandParser, above_zero, add_images_option
from pancam_graph.cli._streams import write
from pancam_graph.cli._workers import add_cluster_option, workers

__all__ = ["TERRAIN"]

_DESCRIPTION = """\
Make terrain of refined stereo frames: heights with sigmas, orthoimage, hillshade, mesh and cloud.

OUT is a folder of results. OUT/terrain gets terrain.json, dem.tif (bands height, sigma, count, disagreement),
orthoimage.tif, hillshade.png, slope.png, mesh.glb and cloud.laz of the drive, OUT/terrain/STOP those of each
stop, and terrain.html shows them; an older one is replaced once all is complete. dem.tif is the ground near
the masts; farther away cells are larger: dem_1.tif, dem_2.tif and so on, and dem.vrt shows all as one.
terrain.json says by how much surfaces of frames differ where they see the same ground, with telemetry's and
with the refined pointing.

Needs the extra: pip install 'pancam-graph[terrain]'.

Exit status: 0 written, 1 written of a solution that failed a test or did not converge, 2 bad input or a fault
(nothing is written), 130 interrupted.
"""


def _add_options(parser: CommandParser) -> None:
    add = parser.add_argument
    add("out", metavar="OUT", type=Path, help="folder of results")
    add(
        "--cell",
        type=above_zero,
        metavar="M",
        help="side of a cell of the finest grid, metres (default: as far as points lie apart 6 m away)",
    )
    add(
        "--reach",
        type=above_zero,
        default=100.0,
        metavar="M",
        help="farthest ground from a mast, metres (%(default)s)",
    )
    add(
        "--fill",
        type=above_zero,
        default=0.0,
        metavar="M",
        help="fill holes up to this width, metres, from what surrounds them; their count is 0 (none)",
    )
    add("--ply", action="store_true", help="write clouds as PLY too")
    add_images_option(parser)
    add_cluster_option(parser)


def _work(call: Invocation) -> int:
    """Read the solution and its pictures, match, write."""
    from pancam_graph.results import read_drive, read_solution_json, write_terrain_of
    from pancam_graph.terrain import TerrainOptions, require_extra

    arguments, progress = call.arguments, call.progress
    options = TerrainOptions(
        cell_m=arguments.cell, reach_m=arguments.reach, fill_m=arguments.fill, ply=arguments.ply
    )
    require_extra()
    with progress.shown(f"reading {arguments.out}"):
        drive = read_drive(arguments.out, arguments.images)
        with workers(call) as client:
            terrain = write_terrain_of(
                drive, arguments.out, options, progress=progress.counted, client=client
            )
    for warning in terrain.warnings:
        write("stderr", shortened(f"warning: {warning}"))
    first, *others = terrain.says()
    for line in (f"{arguments.out / 'terrain'}: {first}", *others):
        call.say(line)
    file = read_solution_json(arguments.out / "solution.json")
    passed = file.converged and (file.verdict is None or file.verdict.passed)
    if not passed:
        call.say("the solution failed a test or did not converge: see pancam-graph check")
    return 0 if passed else 1


TERRAIN = Command(
    name="terrain",
    summary="make heights, orthoimage, mesh and cloud of a refined drive",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
