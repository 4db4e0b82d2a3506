"""A traverse of plain pictures in its folder: `traverse.json`, and what to change in it as text."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.text import visible
from pancam_graph.base.whole_files import whole_file
from pancam_graph.io._traverse_json import write_traverse
from pancam_graph.io.plain._plain_traverse import PlainTraverse

__all__ = ["write_plain"]

_TEXT = "traverse.txt"
_HEAD = """\
What stands in traverse.json
============================

pancam-graph init wrote traverse.json from the pictures and tables beside it. Change a number in it by hand,
or change tables and options and call pancam-graph init again with --overwrite. Then:

    pancam-graph refine FOLDER --out OUT

traverse.json has radians and metres, pans anticlockwise seen from above, tilts upwards. Its entries:

"rig"      the head: pan_T_tilt is where the tilt axis sits on the pan stage; of each camera its size, focal
           length (fx_px, fy_px), principal point (cx_px, cy_px), distortion (k1, k2, p1, p2, k3 of OpenCV,
           if you have them), and where it sits on the head, head_T_camera (x forward, y left, z up).
           "uncertainty": one standard deviation of each kind of number. Make smaller what you know better,
           and larger what you do not: too small ones bias the result, and the verdict names them.
"stops"    where the mast stood; sigmas of 0 hold it.
"frames"   pan and tilt of each pointing with their sigmas; a sigma of 0 holds the angle.
"images"   which file shows which frame through which camera. A file masks/IMAGE.png leaves parts of one out.

"""


def write_plain(plain: PlainTraverse, folder: Path | str, *, overwrite: bool = False) -> None:
    """Write `traverse.json`, which `read_input` reads, and `traverse.txt`, which explains it.

    Raises InputError where either is there already and `overwrite` is not set, and as `write_traverse` does.
    """
    folder = Path(folder)
    for name in ("traverse.json", _TEXT):
        if not overwrite and (folder / name).exists():
            raise InputError(
                f"{folder / name}: expected a folder without one, found one, which stays; --overwrite "
                "replaces it"
            )
    write_traverse(plain.traverse, folder, overwrite=overwrite)
    try:
        whole_file(folder / _TEXT, _text(plain).encode())
    except OSError as error:
        raise InputError(f"{folder}: expected a folder to write to, found: {error}") from error


def _text(plain: PlainTraverse) -> str:
    lines = ["Where the numbers come from", *(f"- {source}" for source in plain.sources)]
    uncertainty = plain.traverse.rig.uncertainty
    lines += ["", "How far the rig may be off, one standard deviation"]
    lines += [f"- {name}: {sigma:g}" for name, sigma in uncertainty.sigmas.items()]
    lines += [f"- source: {uncertainty.source}"]
    if plain.traverse.warnings:
        lines += ["", "Warnings", *(f"- {warning}" for warning in plain.traverse.warnings)]
    lines += ["", "Pictures", *_table(plain)]
    return _HEAD + "\n".join(visible(line) for line in lines) + "\n"


def _table(plain: PlainTraverse) -> Iterator[str]:
    """A line for each picture, degrees."""
    traverse = plain.traverse
    yield "pan_deg (+-)  tilt_deg (+-)  stop  frame  camera  file"
    for row, image in enumerate(traverse.images):
        frame = traverse.frames[int(traverse.image_frame[row])]
        pan, tilt, sigma_pan, sigma_tilt = np.rad2deg(
            [frame.pan_rad, frame.tilt_rad, frame.sigma_pan_rad, frame.sigma_tilt_rad]
        )
        yield (
            f"{pan:9.3f} ({sigma_pan:.3g})  {tilt:8.3f} ({sigma_tilt:.3g})  {frame.stop}  {frame.id}  "
            f"{image.camera}  {image.file}"
        )
