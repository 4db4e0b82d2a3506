"""Projection matrices as variables: 12 numbers per image, tied to the mast (thesis eq. 4.2 to 4.4).

Variables: `P` the entries of an image's conditioned projection matrix (vector of 12); `M` and `A` as in the
models with camera poses. Landmark blocks take each matrix as a pose and a calibration: K, R, C and their
derivatives by the entries have closed forms. Images do not depend on the remaining degree of freedom, the
scale factor of P.
"""

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray, pose_arrays
from pancam_graph.cameras import (
    CALIBRATION_ENTRIES,
    Conditioning,
    projection_matrix,
    projection_tangents,
    split_projections,
)
from pancam_graph.data import ENTRIES, FrameSeen, Refined, RigCorrection, State, Traverse
from pancam_graph.elimination import Covariance, Posture
from pancam_graph.factors import Fixed, Key, projective_factor
from pancam_graph.graph._factors import FactorList
from pancam_graph.graph._graph_options import Flex
from pancam_graph.graph._keys import Kind
from pancam_graph.graph._soft import SoftTemplate
from pancam_graph.graph._template import diagonal_noise
from pancam_graph.landmarks import CameraViews

__all__ = ["ProjectiveTemplate"]

_FACTOR_SIGMA = 0.01
"""Relative sigma of the scale factor s of P, on which images do not depend. The sigma is loose enough to let
steps turn a camera, which changes s to second order, and firm enough to keep the system regular."""
_TYPICAL_RANGE_M = 10.0
"""Unit of the conditioned scene. A mast 1.5 m high sees its ground from 2 m on; from 1 to 100 m the number of
iterations is the same, except for poor initial values."""


class ProjectiveTemplate(SoftTemplate):
    """Projection matrices as variables: flex ties their poses to the mast, a loose sigma their calibrations.

    The tie fixes the gauge of a projective reconstruction, 15 degrees of freedom, and the scale factor of
    each matrix. A projective transformation of the world changes no pixel, so the tie alone limits the length
    of steps, and landmarks must be refined after each (Hong et al., Projective bundle adjustment from
    arbitrary initialization using the variable projection method, 2016). Without `normalise` the variables
    are the entries of P in pixels and metres, about the world's origin, for comparison: the optimum is the
    same.
    """

    _camera_kind = Kind.PROJECTION
    _camera_dim = 12

    def __init__(self, traverse: Traverse, flex: Flex, *, normalise: bool = True) -> None:
        super().__init__(traverse, "projective", flex)
        n = len(traverse.images)
        self.conditioning = _conditioning(traverse) if normalise else Conditioning.none(n)

    def seen_factor(self, one: FrameSeen) -> gtsam.CustomFactor:
        """Raise InputError: a matrix has no lens."""
        raise InputError(
            f"constraints ({one.about}): expected the model mast, circle or free, found projective"
        )

    def _split(self, values: gtsam.Values) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """K, camera_R_world, centre relative to `origin_m`, and scale factor of all images."""
        entries = [values.atVector(self.camera_key(i)) for i in range(len(self.traverse.images))]
        return split_projections(self.conditioning.undo(np.array(entries)))

    def views(self, values: gtsam.Values) -> CameraViews:
        """Cameras of all images at the values."""
        return self._views(*self._split(values)[:3])

    def _views(self, K: FloatArray, camera_R_world: FloatArray, centre_m: FloatArray) -> CameraViews:
        return CameraViews(
            world_R_camera=np.ascontiguousarray(camera_R_world.transpose(0, 2, 1)),
            world_t_camera=centre_m + self.conditioning.origin_m,
            calibration=K,
            lenses=self.lenses,
            fields=self.fields,
        )

    def posture(self, values: gtsam.Values) -> Posture:
        """Cameras at the values; a unit's base is the camera itself, and its calibration moves too."""
        split = self._split(values)
        views = self._views(*split[:3])
        tangents = projection_tangents(*split) @ self.conditioning.d_undo
        return Posture(
            views=views,
            unit_R=views.world_R_camera,
            unit_t=views.world_t_camera,
            chain=tangents[:, :11],
        )

    def tie_factors(self, images: IntArray) -> FactorList:
        """The ties of some images' matrices to the mast and to the rig's calibration, as one factor."""
        t, flex = self.traverse, self.flex
        pose = np.repeat([flex.rotation_rad, flex.translation_m], 3)
        sigmas = [np.concatenate([pose, self._calibration_sigma_px(int(i)), [_FACTOR_SIGMA]]) for i in images]
        return [
            projective_factor(
                diagonal_noise(np.concatenate(sigmas)),
                [Key(self.camera_key(int(i))) for i in images],
                [self.mast(int(s)) for s in t.image_stop[images]],
                [self.pan_tilt(int(f)) for f in t.image_frame[images]],
                [Fixed(t.rig.eyes[int(e)].head_T_camera) for e in t.image_eye[images]],
                [Fixed(t.rig.pan_T_tilt)] * len(images),
                t.calibration[images],
                self.conditioning.of(images),
            )
        ]

    def insert_cameras(self, values: gtsam.Values, state: State) -> None:
        """Add the conditioned matrices, of scale factor 1, of a state's cameras."""
        K, camera_R_world, centre = self._cameras(state)
        projections = projection_matrix(K, camera_R_world, centre)
        for i, entries in enumerate(self.conditioning.condition(projections)):
            values.insert(self.camera_key(i), entries)

    def camera_turn(self, image: int, state: State) -> FloatArray:
        """Jacobian (3, 12) of the rotation of a camera, in its own frame, by the entries of its matrix."""
        K, camera_R_world, centre = (part[image : image + 1] for part in self._cameras(state))
        tangents = projection_tangents(K, camera_R_world, centre, np.ones(1))[0]
        return np.asarray(tangents[:3] @ self.conditioning.d_undo[image])

    def _cameras(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """K, camera_R_world and centre relative to `origin_m` of a state's cameras."""
        t, rig = self.traverse, state.rig
        return (
            t.calibration if rig is None else rig.calibration(t),
            state.world_R_camera.transpose(0, 2, 1),
            state.world_t_camera - self.conditioning.origin_m,
        )

    # --- calibrations of the matrices ---

    def correction(self, values: gtsam.Values) -> RigCorrection:
        """Corrections of the rig that give the calibrations of the matrices."""
        return RigCorrection.to_calibrations(self.traverse, self._split(values)[0])

    def rig_sigmas(self, covariance: Covariance, values: gtsam.Values) -> list[FloatArray]:
        """Standard deviations (5,) of fx, fy, skew, cx and cy of each image."""
        t, link, numbers = self.traverse, self.linkage, self.posture(values).chain[:, 6:]
        out = []
        for i, jacobian in enumerate(numbers):
            stop, columns = int(t.image_stop[i]), link.columns_of(self.camera_key(i))
            block = covariance.block(stop, stop)[columns, columns]
            out.append(np.sqrt(np.einsum("ij,jk,ik->i", jacobian, block, jacobian)))
        return out

    def refined(self, values: gtsam.Values, sigmas: list[FloatArray] | None) -> tuple[Refined, ...]:
        """The five entries of K of every image; sigmas are NaN where None is given."""
        t, change = self.traverse, self.correction(values).calibration_px
        row, column = CALIBRATION_ENTRIES
        return tuple(
            Refined(
                quantity="calibration",
                entry=entry,
                camera=image.camera,
                stop=t.stops[int(t.image_stop[i])].id,
                image=image.id,
                nominal=float(t.calibration[i, row[j], column[j]]),
                change=float(change[i, j]),
                sigma=np.nan if sigmas is None else float(sigmas[i][j]),
                prior_sigma=float(self._calibration_sigma_px(i)[j]),
            )
            for i, image in enumerate(t.images)
            for j, entry in enumerate(ENTRIES["calibration"])
        )

    def _calibration_sigma_px(self, image: int) -> FloatArray:
        """(5,) sigmas of the tie of fx, fy, skew, cx, cy: along u in units of fx, along v in units of fy."""
        along = self.traverse.calibration[image][[0, 1, 0, 0, 1], [0, 1, 0, 0, 1]]
        return np.asarray(self.flex.calibration * along)


def _conditioning(traverse: Traverse) -> Conditioning:
    """Conditioning of pixels about the middle of their image, of the scene about the mast by telemetry.

    Hartley's conditioning takes mean and spread of the observed points. Here both are those of points spread
    evenly over the image: outliers do not change them, and an image without points has them too. The mean
    distance of a pixel from the centre is then about sqrt(2).
    """
    cameras = [eye.camera for eye in traverse.rig.eyes]
    size = np.array([[c.width_px, c.height_px] for c in cameras], dtype=float)[traverse.image_eye]
    _, stops_m = pose_arrays([s.world_T_mast for s in traverse.stops])
    n = len(traverse.images)
    return Conditioning(
        centre_px=(size - 1) / 2,
        # Pixels spread evenly over w columns have a variance of w^2 / 12.
        extent_px=np.sqrt(np.sum(size**2, axis=1) / 24),
        origin_m=stops_m[traverse.image_stop],
        extent_m=np.full(n, _TYPICAL_RANGE_M),
    )
