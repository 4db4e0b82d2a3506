"""Masts of rovers whose images carry PDS labels: axes, zero points of the joints, names in the labels.

The numbers are as published: in the rover frame of the labels (ROVER_NAV_FRAME, on MER ROVER_FRAME),
x forward, y right, z down, azimuth clockwise seen from above. `MastKinematics.chain` turns them to our
z-up frames; nothing else needs to know.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.geometry import Z_DOWN_R_Z_UP, FloatArray, ry, rz
from pancam_graph.rigs._rig import PointingSigma

__all__ = ["MARS2020_MAST", "MER_MAST", "MSL_MAST", "MastKinematics"]

_MER_POINTING = PointingSigma(pan_rad=float(np.deg2rad(0.077)), tilt_rad=float(np.deg2rad(0.077)))
_RSM_POINTING = PointingSigma(pan_rad=float(np.deg2rad(0.063)), tilt_rad=float(np.deg2rad(0.063)))


@dataclass(frozen=True, kw_only=True)
class MastKinematics:
    """A mast with an azimuth joint that carries an elevation joint."""

    name: str
    azimuth_point_m: tuple[float, float, float]
    """A point of the azimuth axis, rover frame (z down)."""
    azimuth_axis: tuple[float, float, float]
    """Direction of the azimuth axis, downwards; turning about it by a positive angle is clockwise."""
    elevation_point_m: tuple[float, float, float]
    """A point of the elevation axis while the azimuth joint reads `elevation_given_at_rad`."""
    elevation_axis: tuple[float, float, float]
    """Direction of the elevation axis at that reading; at home it points to the right."""
    elevation_given_at_rad: float
    """Reading of the azimuth joint for which the elevation axis is given."""
    home_azimuth_rad: float
    """Reading of the azimuth joint where the head looks forward."""
    home_elevation_rad: float
    """Reading of the elevation joint where the head looks level."""
    azimuth_names: tuple[str, ...]
    """Names of the measured azimuth in ARTICULATION_DEVICE_ANGLE_NAME, best first."""
    elevation_names: tuple[str, ...]
    """Names of the measured elevation, best first."""
    pointing_sigma: PointingSigma
    """Accuracy of the measured angles."""
    mast_height_m: float
    """Height of the axes above the ground, for drawings."""
    source: str

    def pan_tilt_rad(self, azimuth_rad: float, elevation_rad: float) -> tuple[float, float]:
        """Pan and tilt of the chain from readings of the joints; pan in [-pi, pi)."""
        pan = self.home_azimuth_rad - azimuth_rad
        return (pan + np.pi) % (2 * np.pi) - np.pi, elevation_rad - self.home_elevation_rad

    def chain(self) -> tuple[gtsam.Pose3, gtsam.Pose3]:
        """`rover_T_mast` and `pan_T_tilt`, z up (rover: x forward, y left, z up).

        The mast's z is the azimuth axis; its origin is the point of that axis nearest to the elevation
        axis, its x the rover's forward direction as far as it is orthogonal to z. The tilt frame's origin
        is the nearest point of the elevation axis, its y runs along that axis.
        """
        z = -_unit(Z_DOWN_R_Z_UP @ np.array(self.azimuth_axis))
        given_axis = -_unit(Z_DOWN_R_Z_UP @ np.array(self.elevation_axis))
        on_z = Z_DOWN_R_Z_UP @ np.array(self.azimuth_point_m)
        given_on_y = Z_DOWN_R_Z_UP @ np.array(self.elevation_point_m)
        # Clockwise from where the elevation axis is given to home; our angles are anticlockwise.
        home = gtsam.Rot3.Expmap(z * -(self.home_azimuth_rad - self.elevation_given_at_rad)).matrix()
        y, on_y = home @ given_axis, on_z + home @ (given_on_y - on_z)
        # The two nearest points: on_z + s z and on_y + t y, apart along z x y.
        st = np.linalg.lstsq(np.column_stack([z, -y]), on_y - on_z, rcond=None)[0]
        origin, tilt_origin = on_z + st[0] * z, on_y + st[1] * y
        forward = np.array([1.0, 0.0, 0.0])
        x = _unit(forward - (forward @ z) * z)
        rover_R_mast = np.column_stack([x, np.cross(z, x), z])
        tilt_x = _unit(np.cross(y, z))
        rover_R_tilt = np.column_stack([tilt_x, y, np.cross(tilt_x, y)])
        rover_T_mast = gtsam.Pose3(gtsam.Rot3(rover_R_mast), origin)
        return rover_T_mast, rover_T_mast.inverse() * gtsam.Pose3(gtsam.Rot3(rover_R_tilt), tilt_origin)

    def rover_T_head(self, azimuth_rad: float, elevation_rad: float) -> gtsam.Pose3:
        """The head at readings of the joints, z up."""
        rover_T_mast, pan_T_tilt = self.chain()
        pan, tilt = self.pan_tilt_rad(azimuth_rad, elevation_rad)
        pan_turn, tilt_turn = (gtsam.Pose3(gtsam.Rot3(turn), np.zeros(3)) for turn in (rz(pan), ry(-tilt)))
        return rover_T_mast * pan_turn * pan_T_tilt * tilt_turn

    def head_T_document(self) -> gtsam.Pose3:
        """The head frame of the mast's documents (RSM_HEAD, RSM_EL) in ours.

        It has the same origin, but is z down and parallel to the rover at home, where ours follows the
        elevation axis.
        """
        at_home = self.rover_T_head(self.home_azimuth_rad, self.home_elevation_rad).rotation().matrix()
        return gtsam.Pose3(gtsam.Rot3(at_home.T @ Z_DOWN_R_Z_UP), np.zeros(3))


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))


MER_MAST = MastKinematics(
    name="mer",
    azimuth_point_m=(0.458, 0.028, -1.097),
    azimuth_axis=(0.0, 0.0, 1.0),
    elevation_point_m=(0.458, 0.028, -1.097),
    elevation_axis=(0.0, 1.0, 0.0),
    elevation_given_at_rad=0.0,
    home_azimuth_rad=0.0,
    home_elevation_rad=0.0,
    azimuth_names=("AZIMUTH-MEASURED",),
    elevation_names=("ELEVATION-MEASURED",),
    pointing_sigma=_MER_POINTING,
    mast_height_m=1.54,
    source="VICAR PigPointMERpmaCamera; labels of Opportunity and Spirit",
)
"""Pancam mast assembly. Both axes meet in one pivot, which each label gives to the millimetre."""

MSL_MAST = MastKinematics(
    name="msl",
    # Published in the mechanical frame; ROVER_NAV_FRAME = that + (0.09002, 0, -1.1205).
    azimuth_point_m=(0.714803 + 0.09002, 0.559424, -1.109344 - 1.1205),
    azimuth_axis=(-0.001, 0.0, 1.0),
    elevation_point_m=(0.714668 + 0.09002, 0.561701, -0.785576 - 1.1205),
    elevation_axis=(-0.022, -1.0, 0.0),
    elevation_given_at_rad=0.0,
    home_azimuth_rad=3.167345,
    home_elevation_rad=1.588171,
    azimuth_names=("AZIMUTH-MEASURED", "AZIMUTH-FINAL"),
    elevation_names=("ELEVATION-MEASURED", "ELEVATION-FINAL"),
    pointing_sigma=_RSM_POINTING,
    mast_height_m=1.97,
    source="VICAR PigPointMSLmastCamera, as-measured values; sign of the elevation axis from labels",
)
"""Remote sensing mast of Curiosity. The elevation axis is published with y = +1, which contradicts the
labels: with y = -1 (it is given at azimuth 0, where the head looks backwards) the head poses in two
Mastcam labels (sols 1664 and 2264) come out to 1 um and 1 urad."""

MARS2020_MAST = MastKinematics(
    name="mars2020",
    azimuth_point_m=(0.804037, 0.559028, -1.91927),
    azimuth_axis=(0.0, 0.0, 1.0),
    elevation_point_m=(0.804037, 0.559028, -1.91927),
    elevation_axis=(0.0, 1.0, 0.0),
    elevation_given_at_rad=2 * np.pi - 3.12414,
    home_azimuth_rad=2 * np.pi - 3.12414,
    home_elevation_rad=np.pi - 1.55334,
    azimuth_names=("AZIMUTH FINAL-RESOLVER", "AZIMUTH-MEASURED", "AZIMUTH FINAL-ENCODER"),
    elevation_names=("ELEVATION FINAL-RESOLVER", "ELEVATION-MEASURED", "ELEVATION FINAL-ENCODER"),
    pointing_sigma=_RSM_POINTING,
    mast_height_m=1.98,
    source="nasa-jpl/m2020-urdf-models (design values)",
)
"""Remote sensing mast of Perseverance, as designed: axes that meet. The label of a Navcam image of sol 629
puts the head 1.1 mm and 1.8 mrad (azimuth), 1.2 mrad (elevation), 2.5 mrad (roll) off these values, so
the flight unit's axes have to be fitted to the labels."""
