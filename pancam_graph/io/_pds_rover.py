"""The names in the PDS labels of one rover; each rover's module fills in one `LabelledRover`."""

from collections.abc import Callable
from dataclasses import dataclass

from pancam_graph.base.errors import InputError
from pancam_graph.io._pds_label import LabelGroup, PdsLabel
from pancam_graph.rigs import MastKinematics, RigUncertainty

__all__ = ["ROVER_FRAMES", "LabelledRover", "named_joints", "reference_frame"]

ROVER_FRAMES = {"ROVER_FRAME", "ROVER_NAV_FRAME"}
"""Names of the rover's own frame."""
_RSM_GROUPS = ("RSM_ARTICULATION_STATE", "RSM_ARTICULATION_STATE_PARMS")


@dataclass(frozen=True, kw_only=True)
class LabelledRover:
    """A rover whose images carry PDS labels."""

    hosts: tuple[str, ...]
    """How its INSTRUMENT_HOST_ID may begin."""
    named: str
    """Its INSTRUMENT_HOST_ID, as error messages say it."""
    cameras: tuple[str, ...]
    """How the INSTRUMENT_ID of a camera on its mast may begin."""
    mast: MastKinematics
    """The mast as published."""
    uncertainty_of: Callable[[int], RigUncertainty]
    """How far cameras and axes of labels may be off, by the longer side of the images, pixels."""
    joints_rad: Callable[[PdsLabel], tuple[float, float]]
    """Measured readings of the azimuth and the elevation joint. Raises InputError naming the entry."""
    mast_of: Callable[[PdsLabel], MastKinematics] | None = None
    """The mast with those numbers that a label has; None: labels have none."""


def reference_frame(group: LabelGroup, expected: set[str]) -> str:
    """The frame in which a group's numbers are. Raises InputError for another one than expected."""
    frame = group.text("REFERENCE_COORD_SYSTEM_NAME").upper()
    if frame not in expected:
        raise InputError(
            f"{group.where}: REFERENCE_COORD_SYSTEM_NAME: expected {' or '.join(sorted(expected))}, "
            f"found {frame!r}"
        )
    return frame


def named_joints(
    azimuth: tuple[str, ...], elevation: tuple[str, ...]
) -> Callable[[PdsLabel], tuple[float, float]]:
    """Readings of the remote sensing mast by their names in ARTICULATION_DEVICE_ANGLE_NAME, best first."""

    def joints_rad(label: PdsLabel) -> tuple[float, float]:
        group = label.group(*_RSM_GROUPS)
        angles = group.angles_rad()
        readings: list[float] = []
        for names in (azimuth, elevation):
            name = next((n for n in names if n in angles), None)
            if name is None:
                raise InputError(
                    f"{group.where}: ARTICULATION_DEVICE_ANGLE_NAME: expected {' or '.join(names)} with a "
                    f"value, found {', '.join(angles) or 'none'}"
                )
            readings.append(angles[name])
        return readings[0], readings[1]

    return joints_rad
