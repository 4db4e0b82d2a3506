"""The subcommand convert: files of other programs, one way or the other."""

from collections.abc import Iterable
from pathlib import Path

from pancam_graph.base.text import shortened
from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._parser import CommandParser, Flag, LateChoice
from pancam_graph.cli._streams import write

__all__ = ["CONVERT"]

_DESCRIPTION = """\
Write results, a drive or a camera in a format of another program.

IN is a folder of results, a folder that refine reads (as telemetry has it), a .cahvor file, or a .tpt, .nav
or .rvf of VICAR or an ISIS control network (.csv), which are taken into the drive of --images. The ending of
OUT says the format (.nav, .tpt, .rvf, .csv), or --to:

  nav, nav-text    pointing corrections of marsnav, XML and text
  tpt, tpt-text    tie points of marsnav, XML and the older text
  rvf              poses of the rover in its site, XML of VICAR
  vector           tracks and cameras for VECTOR
  cahvor           camera of each image as JPL's tools print it
  colmap           COLMAP model with undistorted images
  bundler          bundle.out with undistorted images
  nvm              scene.nvm of VisualSFM with undistorted images
  tsai             pinhole of each image for the Ames Stereo Pipeline
  csm              CSM Frame state of each image for ISIS and the Ames Stereo Pipeline
  control-network  ISIS control network as CSV
  tables           tables of all results with sigmas, CSV
  parquet          the same as Parquet
  traverse         a drive that refine reads, with what was taken in

docs/doors.md says what each format keeps and loses.

Exit status: 0 written, 1 written of a solution that failed a test or did not converge, 2 bad input or a fault
(nothing is written), 130 interrupted.
"""


def _formats() -> Iterable[str]:
    from pancam_graph.results import DOORS

    return DOORS


def _add_options(parser: CommandParser) -> None:
    add = parser.add_argument
    add("path", metavar="IN", type=Path, help="what to convert")
    add("out", metavar="OUT", type=Path, help="the file or the folder to write")
    add("--to", type=LateChoice(_formats), metavar="FORMAT", help="the format of OUT")
    add(
        "--images",
        type=Path,
        metavar="FOLDER",
        help="the folder of the pictures of a .tpt, a .nav, an .rvf or a control network; of results, the "
        "folder that was refined, or that has all that were refined together, where it is not any more where "
        "it was then",
    )
    add("--overwrite", action=Flag, help="replace a file, or a folder of an older conversion, that is there")


def _work(call: Invocation) -> int:
    """Read, write, say what was lost."""
    from pancam_graph.results import convert

    told = call.arguments
    with call.progress.shown(f"converting {told.path}"):
        done = convert(told.path, told.out, to=told.to, images=told.images, overwrite=told.overwrite)
    for warning in done.warnings:
        write("stderr", shortened(f"warning: {warning}"))
    call.say(f"{told.out}: {done.to}")
    if not done.passed:
        call.say("the solution failed a test or did not converge: see pancam-graph check")
    return 0 if done.passed else 1


CONVERT = Command(
    name="convert",
    summary="write results in a format of another program, or read one",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
