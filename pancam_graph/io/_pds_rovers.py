"""The rovers whose labels are read. To add one: a module with its `LabelledRover`, a line in `ROVERS`."""

from collections.abc import Mapping
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.io._pds_mars2020 import MARS2020
from pancam_graph.io._pds_mer import MER
from pancam_graph.io._pds_msl import MSL
from pancam_graph.io._pds_rover import LabelledRover

__all__ = ["OTHER_CAMERAS", "OTHER_HOSTS", "ROVERS", "rover_of"]

ROVERS: tuple[LabelledRover, ...] = (MER, MSL, MARS2020)

OTHER_HOSTS: Mapping[str, str] = {
    "NSYT": "InSight, whose cameras are on an arm and on the body",
    "INSIGHT": "InSight, whose cameras are on an arm and on the body",
    "PHX": "Phoenix, whose mast is not known here",
    "ZHURONG": "Zhurong, whose labels have no angles of the mast",
    "ZHU RONG": "Zhurong, whose labels have no angles of the mast",
}
"""Spacecraft that are recognised and left out: how INSTRUMENT_HOST_ID may begin, and why."""

OTHER_CAMERAS: Mapping[str, str] = {
    **dict.fromkeys(
        ("FHAZ", "RHAZ", "FRONT_HAZ", "REAR_HAZ", "HAZCAM", "HAZ_"), "a hazard camera, fixed to the body"
    ),
    **dict.fromkeys(
        ("MAHLI", "MI", "WATSON", "SHERLOC", "SHRLC", "SI1", "SI2", "SIF", "PIXL", "MCC", "CLUPI", "IDC"),
        "a camera on the arm",
    ),
    **dict.fromkeys(
        ("MARDI", "DESCENT", "EDL", "LCAM", "CACHECAM", "CCAM_", "SKYCAM", "HELI", "ICC"),
        "a camera that is not on the mast",
    ),
}
"""Cameras that are recognised and left out: how INSTRUMENT_ID may begin, and what they are."""


def rover_of(
    host: str, instrument: str, *, where: Path, host_entry: str, instrument_entry: str
) -> LabelledRover:
    """The rover that a label names, whose mast carries the camera that it names, both in capitals.

    Raises InputError naming file and entry for a spacecraft that is none of the `ROVERS`, and for a camera
    that is not on its mast; known ones are named (`OTHER_HOSTS`, `OTHER_CAMERAS`).
    """
    rover = next((known for known in ROVERS if host.startswith(known.hosts)), None)
    if rover is None:
        *first, last = (known.named for known in ROVERS)
        raise InputError(
            f"{where}: {host_entry}: expected {', '.join(first)} or {last}, found {host!r}"
            f"{_known(OTHER_HOSTS, host)}"
        )
    if not instrument.startswith(rover.cameras):
        names = ", ".join(name.rstrip("_") for name in rover.cameras)
        raise InputError(
            f"{where}: {instrument_entry}: expected a camera on the mast ({names}), found {instrument!r}"
            f"{_known(OTHER_CAMERAS, instrument)}"
        )
    return rover


def _known(table: Mapping[str, str], name: str) -> str:
    """What a name is, as a sentence goes on with it; "" for one that is not in the table."""
    found = next((what for start, what in table.items() if name.startswith(start)), None)
    return "" if found is None else f", {found}"
