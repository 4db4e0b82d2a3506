"""Frames of the rover motion counter: .svf and .rvf files of localisation, XML.

An .svf has each site in the frame of the site before it, an .rvf the rover in the frame of a site.
Source: the readers of these files in VICAR; tried on made-up files only.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam

from pancam_graph.base.errors import GeometryError, InputError
from pancam_graph.base.geometry import pose_from_wxyz
from pancam_graph.io._told_numbers import told_number
from pancam_graph.io._xml import XmlElement, read_xml
from pancam_graph.rigs import pose_z_up

__all__ = ["SITE_FILE", "rover_poses", "site_poses"]

SITE_FILE = ".svf"
"""How files with sites end, in small letters."""
_SITE, _ROVER = "SITE_FRAME", "ROVER_FRAME"


@dataclass(frozen=True, kw_only=True)
class _Solution:
    """A frame in another one."""

    names: tuple[str, str]
    """Its name, and that of the frame it is in."""
    index: tuple[int, ...]
    """Its counters: site, drive and so on."""
    reference: int
    """First counter of the frame it is in."""
    element: XmlElement

    @property
    def pose(self) -> gtsam.Pose3:
        """reference_T_frame, z up. Raises InputError where it is malformed."""
        return _pose(self.element)


def site_poses(files: Sequence[Path]) -> dict[int, gtsam.Pose3]:
    """`before_T_site`, z up, by site. Of several solutions of a site that of the highest priority counts.

    Priorities of a file are listed lowest first; a later file counts before an earlier one.
    Raises InputError naming file and entry for what is malformed.
    """
    return {
        one.index[0]: one.pose
        for file in files
        for one in _solutions(file, "a file of sites")
        if one.names == (_SITE, _SITE) and one.reference == one.index[0] - 1
    }


def rover_poses(file: Path, site: int) -> dict[tuple[int, int], gtsam.Pose3]:
    """`site_T_rover` in the frame of one site, z up, by site and drive; of others what sites here lead to.

    Of several solutions of a place that of the highest priority counts, of one solution the last.
    Raises InputError naming file and entry for what is malformed.
    """
    before_T_site = site_poses([file])
    out: dict[tuple[int, int], gtsam.Pose3] = {}
    for one in _solutions(file, "a file of rover poses"):
        if one.names != (_ROVER, _SITE) or len(one.index) < 2:
            continue
        pose, at = one.pose, one.reference
        while at > site and at in before_T_site:
            pose, at = before_T_site[at] * pose, at - 1
        if at == site:
            out[one.index[0], one.index[1]] = pose
    return out


def _solutions(file: Path, what: str) -> Iterator[_Solution]:
    """The solutions of a file, those of the highest priority last."""
    root = read_xml(file)
    if root.name != "rmc_file":
        raise InputError(f"{file}: expected {what} (rmc_file), found {root.name[:60]!r}")
    order = [entry.attributes.get("solution_id", "") for entry in root.every("entry")]
    rank = {name: row for row, name in enumerate(order)}
    for solution in sorted(
        root.every("solution"), key=lambda s: rank.get(s.attributes.get("solution_id", ""), -1)
    ):
        reference = solution.required("reference_frame")
        names = solution.attributes.get("name", ""), reference.attributes.get("name", "")
        index = [_index(solution, 1)]
        while f"index{len(index) + 1}" in solution.attributes:
            index.append(_index(solution, len(index) + 1))
        yield _Solution(names=names, index=tuple(index), reference=_index(reference, 1), element=solution)


def _index(element: XmlElement, n: int) -> int:
    name = f"index{n}"
    number = told_number(element.attributes.get(name, ""))
    if number is None or number != int(number) or not 0 <= number < 1 << 31:
        element.refuse(f"a whole number {name}", repr(element.attributes.get(name, "")[:60]))
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
