"""Where sites of a rover are: .svf files of localisation, XML, each site in the frame of the site before it.

Source: the readers of these files in VICAR; tried on a made-up file only.
"""

from collections.abc import Sequence
from pathlib import Path

import gtsam

from pancam_graph.base.errors import GeometryError, InputError
from pancam_graph.base.geometry import pose_from_wxyz
from pancam_graph.io._told_numbers import told_number
from pancam_graph.io._xml import XmlElement, read_xml
from pancam_graph.rigs import pose_z_up

__all__ = ["SITE_FILE", "site_poses"]

SITE_FILE = ".svf"
"""How files with sites end, in small letters."""
_FRAME = "SITE_FRAME"


def site_poses(files: Sequence[Path]) -> dict[int, gtsam.Pose3]:
    """`before_T_site`, z up, by site. Of several solutions of a site that of the highest priority counts.

    Priorities of a file are listed lowest first; a later file counts before an earlier one.
    Raises InputError naming file and entry for what is malformed.
    """
    poses: dict[int, gtsam.Pose3] = {}
    for file in files:
        root = read_xml(file)
        if root.name != "rmc_file":
            raise InputError(f"{file}: expected a file of sites (rmc_file), found {root.name[:60]!r}")
        order = [entry.attributes.get("solution_id", "") for entry in root.every("entry")]
        rank = {name: row for row, name in enumerate(order)}
        for solution in sorted(
            root.every("solution"), key=lambda s: rank.get(s.attributes.get("solution_id", ""), -1)
        ):
            reference = solution.required("reference_frame")
            names = solution.attributes.get("name", ""), reference.attributes.get("name", "")
            site, before = _index(solution), _index(reference)
            if names == (_FRAME, _FRAME) and before == site - 1:
                poses[site] = _pose(solution)
    return poses


def _index(element: XmlElement) -> int:
    number = told_number(element.attributes.get("index1", ""))
    if number is None or number != int(number) or not 0 <= number < 1 << 31:
        element.refuse("a whole number index1", repr(element.attributes.get("index1", "")[:60]))
    return int(number)


def _pose(solution: XmlElement) -> gtsam.Pose3:
    offset, turn = solution.required("offset"), solution.required("orientation")
    try:
        pose = pose_from_wxyz(
            [_number(turn, name) for name in ("s", "v1", "v2", "v3")],
            [_number(offset, name) for name in "xyz"],
        )
    except GeometryError as error:
        raise InputError(f"{solution.file}: orientation: {error}") from error
    return pose_z_up(pose)


def _number(element: XmlElement, name: str) -> float:
    number = told_number(element.attributes.get(name, ""))
    if number is None:
        element.refuse(f"a number {name}", repr(element.attributes.get(name, "")[:60]))
    return number
