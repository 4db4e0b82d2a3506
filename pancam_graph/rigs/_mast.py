"""The mast of a rover as its documents give it: two axes, and the readings of the joints.

Numbers of a mast are in the rover frame of the labels (ROVER_NAV_FRAME, on MER ROVER_FRAME): x forward, y
right, z down, azimuth clockwise seen from above. All poses that the mast returns are z up.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, ry, rz
from pancam_graph.rigs._rig import PointingSigma
from pancam_graph.rigs._z_down import Z_UP_T_Z_DOWN, vector_z_up

__all__ = ["MastKinematics"]


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
        z = -_unit(vector_z_up(self.azimuth_axis))
        given_axis = -_unit(vector_z_up(self.elevation_axis))
        on_z = vector_z_up(self.azimuth_point_m)
        given_on_y = vector_z_up(self.elevation_point_m)
        # From the reading at which the elevation axis is given to home. Readings are clockwise, angles not.
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
        at_home = self.rover_T_head(self.home_azimuth_rad, self.home_elevation_rad)
        return gtsam.Pose3(at_home.rotation().inverse(), np.zeros(3)) * Z_UP_T_Z_DOWN


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))
