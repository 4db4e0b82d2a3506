"""The subcommand init: plain pictures with told pointing to a traverse.json."""

from pathlib import Path
from typing import TYPE_CHECKING

from pancam_graph.base.text import shortened
from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._parser import CommandParser, Flag, degrees
from pancam_graph.cli._streams import write

if TYPE_CHECKING:
    from pancam_graph.io.plain import PlainTraverse

__all__ = ["INIT"]

_DESCRIPTION = """\
Make a traverse.json of plain pictures (JPEG, PNG, TIFF and others) in FOLDER or in folders below it, one a
stop, for pancam-graph refine FOLDER. traverse.txt beside it says where every number comes from and what to
change.

Where the pointing of a picture is not told, or only to more than 2 degrees, pan, tilt and focal length are
found in the pictures, which must overlap by a quarter or so: pan 0 is then where the first of them looks.
Else only headers of pictures are read.

--pointing names a CSV file, one line a picture, with the columns file, pan_deg, tilt_deg (or file alone) and,
where you like, sigma_pan_deg, sigma_tilt_deg, camera, frame, stop. Pan counts anticlockwise seen from above
(--pan clockwise for azimuths), tilt upwards. Pictures of several cameras at one stop, pan and tilt are one
frame.

Without --rig, pictures of one size, camera and focal length (EXIF) are of one eye, which sits on the head as
--arms says. What is not told is taken wide and estimated from the pictures.

Exit status: 0 written, 2 bad input or a fault (nothing is written), 130 interrupted.
"""


def _add_options(parser: CommandParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="folder with the pictures; gets traverse.json")
    add(
        "--pointing",
        type=Path,
        metavar="FILE",
        help="CSV file with pan and tilt of each picture, degrees; by default they are found in the pictures",
    )
    add(
        "--stops",
        type=Path,
        metavar="FILE",
        help="CSV file with the places of stops, where there are several: the columns stop, x_m, y_m, z_m (z "
        "up) and, where you like, yaw_deg, sigma_m (0.2), sigma_deg (2); the first is held",
    )
    add(
        "--rig",
        metavar="RIG",
        help="a template such as mer-navcam (an unknown one lists all), or a JSON file: the entry rig of a "
        "traverse.json by itself, a traverse.json, or a rig.json of --export rig",
    )
    add(
        "--pan",
        choices=("anticlockwise", "clockwise"),
        default="anticlockwise",
        help="the sense in which pans and yaws of the tables count, seen from above (%(default)s)",
    )
    add(
        "--sigma-deg",
        dest="sigma_rad",
        type=degrees,
        metavar="DEG",
        help="standard deviation of pans and tilts where the table tells none (a template's own, else 0.5)",
    )
    add(
        "--focal-px",
        type=float,
        metavar="PX",
        help="focal length of the cameras; by default EXIF tells it, or pictures of unknown pointing",
    )
    add(
        "--field-deg",
        dest="field_rad",
        type=degrees,
        metavar="DEG",
        help="horizontal field of view of the stored pictures, in place of --focal-px",
    )
    add(
        "--focal-sigma",
        type=float,
        metavar="PERCENT",
        help="standard deviation of focal lengths, percent (2 of one that is told, 3 to 5 of EXIF)",
    )
    add(
        "--arms",
        type=float,
        nargs=3,
        metavar=("UP", "FORWARD", "LEFT"),
        help="metres: height of the tilt axis above the origin on the pan axis, and how far the camera is "
        "before and left of the axes (0 0 0)",
    )
    add(
        "--arms-sigma",
        dest="arms_sigma_m",
        type=float,
        metavar="M",
        help="standard deviation of each of these lengths, metres (0.01 where they are told, else 0.05)",
    )
    add("--overwrite", action=Flag, help="replace a traverse.json that is there")


def _work(call: Invocation) -> int:
    """Read headers and tables, write."""
    from pancam_graph.io.plain import PlainOptions, plain_traverse, write_plain

    told = call.arguments
    options = PlainOptions(
        pointing=told.pointing,
        stops=told.stops,
        rig=told.rig,
        clockwise=told.pan == "clockwise",
        sigma_rad=told.sigma_rad,
        focal_px=told.focal_px,
        field_rad=told.field_rad,
        focal_sigma=None if told.focal_sigma is None else told.focal_sigma / 100,
        arms_m=None if told.arms is None else tuple(told.arms),
        arms_sigma_m=told.arms_sigma_m,
    )
    with call.progress.shown(f"reading {told.folder}"):
        plain = plain_traverse(told.folder, options)
    if any(frame.is_vague for frame in plain.traverse.frames):
        plain = _with_found_pointing(plain, call)
    write_plain(plain, told.folder, overwrite=told.overwrite)
    for warning in plain.traverse.warnings:
        write("stderr", shortened(f"warning: {warning}"))
    for source in plain.sources:
        call.say(source)
    traverse = plain.traverse
    counts = {"stop": traverse.stops, "frame": traverse.frames, "image": traverse.images}
    found = ", ".join(f"{len(of)} {name}{'' if len(of) == 1 else 's'}" for name, of in counts.items())
    call.say(f"{told.folder / 'traverse.json'}: {found}; traverse.txt explains it")
    return 0


def _with_found_pointing(plain: "PlainTraverse", call: Invocation) -> "PlainTraverse":
    """The traverse with the pointing that its pictures tell."""
    from pancam_graph.images import find_pointing
    from pancam_graph.io.plain import PlainTraverse

    with call.progress.shown("looking where pictures overlap"):
        found = find_pointing(plain.traverse, progress=call.progress.counted)
    return PlainTraverse(traverse=found.traverse, sources=(*plain.sources, *found.sources))


INIT = Command(
    name="init",
    summary="make a traverse.json of plain pictures",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
