"""The names in the labels of one rover; each rover's module fills in one `LabelledRover`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pancam_graph.base.errors import InputError
from pancam_graph.io._pds_label import LabelGroup, PdsLabel
from pancam_graph.rigs import MastKinematics, RigUncertainty

__all__ = ["ROVER_FRAMES", "JointNames", "LabelledRover", "reference_frame"]

ROVER_FRAMES = {"ROVER_FRAME", "ROVER_NAV_FRAME"}
"""Names of the rover's own frame."""
_RSM_GROUPS = ("RSM_ARTICULATION_STATE", "RSM_ARTICULATION_STATE_PARMS")


@dataclass(frozen=True, kw_only=True)
class JointNames:
    """How labels name the readings of the two joints of a remote sensing mast, best first."""

    azimuth: tuple[str, ...]
    elevation: tuple[str, ...]

    def readings_rad(self, angles: Mapping[str, float], where: str) -> tuple[float, float]:
        """The two readings among named angles. Raises InputError at `where` for a missing one."""
        readings: list[float] = []
        for names in (self.azimuth, self.elevation):
            name = next((n for n in names if n in angles), None)
            if name is None:
                raise InputError(
                    f"{where}: expected {' or '.join(names)} with a value, "
                    f"found {', '.join(angles) or 'none'}"
                )
            readings.append(angles[name])
        return readings[0], readings[1]


@dataclass(frozen=True, kw_only=True)
class LabelledRover:
    """A rover whose images carry labels."""

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
    joints: JointNames | Callable[[PdsLabel], tuple[float, float]]
    """Names of the measured readings of both joints; or a function that finds them."""
    mast_of: Callable[[PdsLabel], MastKinematics] | None = None
    """The mast with those numbers that a label has; None: labels have none."""

    def joints_rad(self, label: PdsLabel) -> tuple[float, float]:
        """Measured readings of both joints in a PDS3 label. Raises InputError naming the entry."""
        if not isinstance(self.joints, JointNames):
            return self.joints(label)
        group = label.group(*_RSM_GROUPS)
        return self.joints.readings_rad(group.angles_rad(), f"{group.where}: ARTICULATION_DEVICE_ANGLE_NAME")


def reference_frame(group: LabelGroup, expected: set[str]) -> str:
    """The frame in which a group's numbers are. Raises InputError for another one than expected."""
    frame = group.text("REFERENCE_COORD_SYSTEM_NAME").upper()
    if frame not in expected:
        raise InputError(
            f"{group.where}: REFERENCE_COORD_SYSTEM_NAME: expected {' or '.join(sorted(expected))}, "
            f"found {frame!r}"
        )
    return frame
