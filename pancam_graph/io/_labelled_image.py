"""One image as its label describes it, whatever the label's format: what all formats of labels fill in."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gtsam

from pancam_graph.cameras import CAHV
from pancam_graph.data import Tile
from pancam_graph.rigs import MastKinematics, PointingSigma, RigUncertainty

__all__ = ["LabelledImage"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledImage:
    """An image as its label describes it, z up; not yet sorted into stops, frames and eyes."""

    file: Path
    """The picture."""
    label_file: Path
    """The file with the label: the picture itself, or one beside it."""
    host: str
    """The rover, as INSTRUMENT_HOST_ID names it."""
    instrument: str
    """The camera, as INSTRUMENT_ID names it."""
    serial: str
    """Serial number of the camera; "" where the label has none."""
    stop: tuple[int, int]
    """Site and drive of the motion counter."""
    mast: MastKinematics
    """The mast, with those of its numbers that the label has."""
    uncertainty_of: Callable[[int], RigUncertainty]
    """How far cameras and axes of the label may be off, by the longer side of the images, pixels."""
    mast_counter: int | None
    """Number of motions of the mast so far; None where the label has no such counter."""
    clock_start: str | None
    """The spacecraft's clock at the start of the exposure; None where the label has none."""
    first_line_sample: tuple[int, int]
    """Where on the detector the first pixel is, counted from 1."""
    sample_bits: int
    pan_tilt_rad: tuple[float, float]
    """Measured pan and tilt of the chain."""
    world_T_rover: gtsam.Pose3
    """The rover in the frame of its site."""
    model: CAHV
    """The camera in the rover frame."""
    told_angles: tuple[float, ...] = ()
    """What tells images of one pointing from others, in radians; empty: `pan_tilt_rad` does."""
    pointing_sigma: PointingSigma | None = None
    """Accuracy of pan and tilt; None: the mast's."""
    remark: str = ""
    """What a user should know of how the label was read; the same for all images that it is true of."""
    levelled: bool = True
    """Whether the label has the rover's attitude; else `world_T_rover` has none."""
    tiles: tuple[Tile, ...] = ()
    """Files that have a part of the picture each; empty: `file` has all of it."""
    placed: bool = True
    """Whether the label has the rover's place; else `world_T_rover` has none."""
    site_before_T_site: gtsam.Pose3 | None = None
    """The image's site in the frame of the site before it, z up; None where the label does not say it."""

    @property
    def unit(self) -> str:
        """The camera that it is: host, instrument and serial number."""
        return " ".join(part for part in (self.host, self.instrument, self.serial) if part)

    def way_from(self, root: Path) -> str:
        """The picture's path relative to a folder that it lies in."""
        return self.file.relative_to(root).as_posix()
