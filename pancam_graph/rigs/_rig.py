"""A mast rig: the pan-tilt chain and the eyes on it (docs/conventions.md, "Signs")."""

from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import (
    FloatArray,
    IntArray,
    compose,
    corrected_poses,
    pan_tilt_rotation,
    pose_arrays,
)
from pancam_graph.cameras import CAHV, Camera, Pinhole, with_field_of, without_field
from pancam_graph.rigs._uncertainty import RigUncertainty

__all__ = ["Eye", "PointingSigma", "Rig"]


@dataclass(frozen=True, kw_only=True)
class Eye:
    """One camera on the head."""

    name: str
    """Unique within the rig."""
    camera: Camera
    """The camera model in the camera frame: centre at the origin, z forward."""
    head_T_camera: gtsam.Pose3
    """How the eye sits on the head (x forward, y left, z up), which turns with pan and tilt."""
    unit: str = ""
    """The camera that it is among those of its kind: host, instrument and serial number of labels; "": not
    known."""

    @staticmethod
    def from_head_model(name: str, model: Camera) -> "Eye":
        """An eye from a CAHV-family model whose vectors are in the head frame; a field on top stays.

        Raises TypeError as `head_model`.
        """
        lens, head_T_camera = _cahv(name, model).split()
        return Eye(name=name, camera=with_field_of(lens, model), head_T_camera=head_T_camera)

    def head_model(self) -> CAHV:
        """The lens as a CAHV-family model with its vectors in the head frame; inverse of `from_head_model`.

        Raises TypeError for a pinhole or Brown camera, which has no such vectors.
        """
        return _cahv(self.name, self.camera).transformed(self.head_T_camera)


def _cahv(eye: str, camera: Camera) -> CAHV:
    """The lens of a camera; raises TypeError for one that has no CAHV vectors."""
    lens = without_field(camera)
    if not isinstance(lens, CAHV):
        raise TypeError(f"eye {eye}: a {type(lens).__name__} has no CAHV vectors")
    return lens


@dataclass(frozen=True, kw_only=True)
class PointingSigma:
    """Accuracy of the telemetry of pointing, one standard deviation."""

    pan_rad: float
    tilt_rad: float
    twist_rad: float = 1.05e-3
    """About the line of sight; no encoder measures it. Default: 0.06 degrees (VICAR PigPoint*.cc)."""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """A pan-tilt mast with one or more eyes.

    `mast_T_camera = Rz(pan) . pan_T_tilt . Ry(-tilt) . head_T_camera` (docs/conventions.md). At constant
    tilt an eye's centre runs on a circle about the pan axis: thesis eq. 4.8.
    """

    name: str
    pan_T_tilt: gtsam.Pose3
    """Where the tilt axis (y) sits on the pan stage."""
    eyes: tuple[Eye, ...]
    pointing_sigma: PointingSigma = field(
        default_factory=lambda: PointingSigma(pan_rad=1.34e-3, tilt_rad=1.34e-3)
    )
    """Telemetry's accuracy, used where a traverse does not say; default: MER, 0.077 degrees."""
    mast_height_m: float = 1.5
    """Height of the mast frame above the ground, for simulations and drawings only."""
    turns: bool = True
    """Whether the head turns. False for a rigid ring of cameras, whose pan and tilt are 0 and held; for
    simulations only: a traverse says so by the sigmas of its frames."""
    source: str = ""
    """Where the numbers come from."""
    uncertainty: RigUncertainty = None  # type: ignore[assignment]  # __post_init__ puts the default there
    """How far the numbers may be off; default: `RigUncertainty.usual` of the largest image."""
    rover_T_mast: gtsam.Pose3 | None = None
    """The mast frame in the rover frame of labels turned to z up; None: not known, or no rover."""

    def __post_init__(self) -> None:
        """Check that there are eyes, with different names; state an uncertainty."""
        if not self.eyes:
            raise InputError(f"rig {self.name}: expected at least one camera, found none")
        names = [e.name for e in self.eyes]
        for name in names:
            if names.count(name) > 1:
                found = f"{name!r} {names.count(name)} times"
                raise InputError(f"rig {self.name}: expected different camera names, found {found}")
        if self.uncertainty is None:
            object.__setattr__(self, "uncertainty", RigUncertainty.usual(self.longest_side_px))

    @property
    def longest_side_px(self) -> int:
        """Longer side of the largest image."""
        return max(max(e.camera.width_px, e.camera.height_px) for e in self.eyes)

    def eye_index(self, name: str) -> int:
        """Index of an eye by name. Raises InputError for an unknown one."""
        for i, eye in enumerate(self.eyes):
            if eye.name == name:
                return i
        raise InputError(f"camera {name!r}: the rig {self.name} has {', '.join(e.name for e in self.eyes)}")

    @cached_property
    def _mounts(self) -> tuple[FloatArray, FloatArray]:
        return pose_arrays([e.head_T_camera for e in self.eyes])

    @cached_property
    def pinholes(self) -> tuple[Pinhole, ...]:
        """The distortion-free pinhole of each eye."""
        return tuple(e.camera.pinhole for e in self.eyes)

    def mast_T_head(
        self,
        pan_rad: FloatArray,
        tilt_rad: FloatArray,
        pan_T_tilt: tuple[FloatArray, FloatArray] | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Head poses in the mast frame for n pointings: rotations (n, 3, 3), translations (n, 3).

        `pan_T_tilt` are tilt axes (n, 3, 3), (n, 3) in place of the rig's own.
        """
        axis_R, axis_t = pan_T_tilt or (self.pan_T_tilt.rotation().matrix(), self.pan_T_tilt.translation())
        pan_R, tilt_R = pan_tilt_rotation(pan_rad, 0.0), pan_tilt_rotation(0.0, tilt_rad)
        return pan_R @ axis_R @ tilt_R, (pan_R @ axis_t[..., None])[..., 0]

    def mast_T_camera(
        self, pan_tilt_rad: FloatArray, eye: IntArray, flex: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Camera poses in the mast frame for n images: pan and tilt (n, 2), eye index (n,).

        `flex` (n, 4) is how the heads stand off the rigid mast: turned about their forward axis, radians, and
        shifted along their own axes, metres.
        """
        mounts_R, mounts_t = self._mounts
        head = self.mast_T_head(pan_tilt_rad[:, 0], pan_tilt_rad[:, 1])
        if flex is not None:
            head = corrected_poses(*head, np.insert(flex, [1, 1], 0.0, axis=1))
        return compose(*head, mounts_R[eye], mounts_t[eye])

    def circle(self, eye: int, tilt_rad: float) -> tuple[float, float, float]:
        """Circle of an eye's centre at one tilt, in the mast frame: radius, phase, height (thesis eq. 4.8).

        The centre is at `[radius cos(pan + phase), radius sin(pan + phase), height]`; metres, radians.
        """
        _, t = self.mast_T_camera(np.array([[0.0, tilt_rad]]), np.array([eye]))
        x, y, z = (float(c) for c in t[0])
        return float(np.hypot(x, y)), float(np.arctan2(y, x)), z
