"""What an adjustment returns."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np

from pancam_graph.base.choices import expected_one_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, corrected_poses
from pancam_graph.cameras import CALIBRATION_ENTRIES, Camera, projection_matrix
from pancam_graph.data._cross_validation import CrossValidation
from pancam_graph.data._sharing import Quantity
from pancam_graph.data._traverse import Traverse
from pancam_graph.elimination import JointCovariance, relative_pose_covariance
from pancam_graph.rigs import Rig

__all__ = ["Incremental", "Refined", "RigCorrection", "Seconds", "Solution", "State", "rms_px"]


@dataclass(frozen=True, kw_only=True, eq=False)
class RigCorrection:
    """By how much a rig's numbers differ from what the traverse's rig says; 0 where they were held."""

    calibration_px: FloatArray
    """(images, 5) added to fx, fy, skew, cx and cy of each image's camera."""
    mount: FloatArray
    """(images, 6) of each image's `head_T_camera`: rotation vector, radians, and shift, metres, in the
    camera's own frame (geometry.corrected_poses)."""
    pan_T_tilt: FloatArray
    """(stops, 6) the same of the tilt axis."""
    radius_m: FloatArray
    """(images,) added to the radius of the image's circle; model `circle`."""

    @staticmethod
    def to_calibrations(traverse: Traverse, calibration: FloatArray) -> "RigCorrection":
        """That from the rig's calibrations to these, K (images, 3, 3); all else is as the rig has it."""
        n, (row, column) = len(traverse.images), CALIBRATION_ENTRIES
        return RigCorrection(
            calibration_px=(calibration - traverse.calibration)[:, row, column],
            mount=np.zeros((n, 6)),
            pan_T_tilt=np.zeros((len(traverse.stops), 6)),
            radius_m=np.zeros(n),
        )

    def calibration(self, traverse: Traverse) -> FloatArray:
        """K (images, 3, 3) of each image's camera, upper-triangular, without distortion."""
        out: FloatArray = traverse.calibration.copy()
        row, column = CALIBRATION_ENTRIES
        out[:, row, column] += self.calibration_px
        return out


@dataclass(frozen=True, kw_only=True)
class Refined:
    """One free entry of the rig, as the adjustment found it."""

    quantity: Quantity
    entry: str
    camera: str | None
    """Name of the eye; None: of all eyes."""
    stop: str | None
    """Id of the stop that has it for itself; None: of the whole traverse."""
    image: str | None
    """Id of the image that has it for itself; None: of all images of the eye, or of the eye at the stop."""
    nominal: float | None
    """What the rig says; 0 for entries of a pose, 1 for `focal`; None where those who share it differ."""
    change: float
    sigma: float
    """Formal standard deviation, all else marginalised; NaN where a direction is free."""
    prior_sigma: float
    """Of the prior about the rig's value; infinite where there was none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """Values of everything that is estimated, in the order of the traverse's entries."""

    world_T_mast: tuple[gtsam.Pose3, ...]
    """Mast pose of each stop."""
    pan_tilt_rad: FloatArray
    """(frames, 2) pan and tilt of each frame."""
    world_R_camera: FloatArray
    """(images, 3, 3) orientation of each image's camera."""
    world_t_camera: FloatArray
    """(images, 3) centre of each image's camera, metres."""
    landmarks_m: FloatArray
    """(landmarks, 3) terrain points; a row of NaN where there is no usable point."""
    rig: RigCorrection | None = None
    """How the rig differs from the traverse's; None: in nothing."""


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """Wall-clock time of each part."""

    read: float = 0.0
    initialise: float = 0.0
    """First values of cameras and landmarks."""
    solve: float = 0.0
    """Screening, adjustment and uncertainties."""
    report: float = 0.0
    """Tables of residuals, warnings, and writing the results."""


def rms_px(residuals_px: FloatArray) -> float:
    """Root mean square length of residual vectors (n, 2), pixels per observation; 0 for none.

    The length of the vector counts, not each coordinate: sqrt(sum |r|^2 / n).
    """
    return float(np.sqrt(np.mean(np.sum(residuals_px**2, axis=1)))) if len(residuals_px) else 0.0


@dataclass(frozen=True, kw_only=True)
class Incremental:
    """What each update of a smoother took, in the order of the stops."""

    seconds_per_stop: tuple[float, ...]
    cost_per_stop: tuple[float, ...]
    """After each."""
    relinearised_per_stop: tuple[int, ...]
    """Variables that moved to another point of linearisation."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """The adjusted traverse, with what it was before, how sure it is, and what went wrong."""

    traverse: Traverse
    """The input, observations included."""
    model: str
    landmarks: str
    converged: bool
    stop_reason: str
    """Why the iterations ended, in words."""
    iterations: int
    cost_history: tuple[float, ...]
    """Cost after each iteration of the final least-squares stage, its start first.

    It starts where screening for outliers ended; without a loss, at the telemetry."""
    cost_initial: float
    """Half the sum of squares of whitened residuals at the start, priors included."""
    cost_final: float
    """The same at the end, over the same observations."""
    initial: State
    final: State
    landmark_track: IntArray
    """(landmarks,) track number of each landmark row."""
    used: BoolArray
    """(observations,) whether each observation took part in the final least-squares stage."""
    reason: tuple[str, ...]
    """(observations,) why one was left out: "outlier", "single" (a track seen once), "behind"; "" if used."""
    residual_initial_px: FloatArray
    """(observations, 2) projected minus measured at the start, raw image pixels; NaN where undefined."""
    residual_final_px: FloatArray
    """(observations, 2) the same at the end; for outliers too, where their landmark exists."""
    sigma_px: FloatArray
    """(observations,) standard deviation each was weighted with in the end (or of its covariance)."""
    stop_covariance: FloatArray
    """(stops, 6, 6) rotation first, body frame, landmarks marginalised; formal. 0 for a held stop.

    NaN, as the angles' sigmas, where the solution leaves a direction free; a warning says so."""
    angle_sigma_rad: FloatArray
    """(frames, 2) formal standard deviation of pan and tilt, landmarks marginalised."""
    covariance_px2: FloatArray | None = None
    """(observations, 2, 2) covariance each was weighted with in the end, where the input has covariances."""
    landmark_covariance_m2: FloatArray | None = None
    """(landmarks, 3, 3) of `final.landmarks_m`, all else marginalised; formal; where it was asked for."""
    mast_covariance: JointCovariance | None = field(default=None, repr=False)
    """What `stop_covariance_between` works from; None where the solution leaves a direction free."""
    came_back: BoolArray | None = None
    """(observations,) whether each took part in the end after it had been set aside; None: not followed."""
    refined: tuple[Refined, ...] = ()
    """Entries of the rig that were free (`Sharing`), in the order of quantity and owner."""
    method: str = "joint"
    """How it was solved."""
    cross_validation: CrossValidation | None = None
    """What solutions from halves of the tracks say of the sigmas; where it was asked for."""
    incremental: "Incremental | None" = None
    """How it came about, where it was followed stop by stop."""
    warnings: tuple[str, ...] = ()
    seconds: Seconds = field(default_factory=Seconds)

    @property
    def rms_initial_px(self) -> float:
        """RMS residual length of the used observations at the start, raw image pixels."""
        return rms_px(self.residual_initial_px[self.used])

    @property
    def rms_final_px(self) -> float:
        """RMS residual length of the used observations at the end, raw image pixels."""
        return rms_px(self.residual_final_px[self.used])

    @cached_property
    def rig(self) -> Rig:
        """The rig as adjusted: its tilt axis, and each eye's calibration and mount.

        Only what serves the whole traverse: what stops or images have for themselves (`final.rig` has it) is
        left as the input has it. Nothing was free: the input's own.
        """
        rig, found, t = self.traverse.rig, self.final.rig, self.traverse
        if found is None:
            return rig
        eyes = []
        for i, eye in enumerate(rig.eyes):
            own = t.image_eye == i
            calibration, mount = _common(found.calibration_px[own]), _common(found.mount[own])
            camera, head_T_camera = eye.camera, eye.head_T_camera
            if calibration.any():
                fx, fy, skew, cx, cy = calibration
                change = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 0.0]])
                camera = camera.with_calibration(camera.pinhole.calibration_matrix + change)
            if mount.any():
                head_T_camera = _corrected(head_T_camera, mount)
            eyes.append(replace(eye, camera=camera, head_T_camera=head_T_camera))
        axis = _common(found.pan_T_tilt)
        pan_T_tilt = _corrected(rig.pan_T_tilt, axis) if axis.any() else rig.pan_T_tilt
        return replace(rig, eyes=tuple(eyes), pan_T_tilt=pan_T_tilt)

    @property
    def calibration(self) -> FloatArray:
        """(images, 3, 3) K of each image's camera as adjusted, upper-triangular, without distortion."""
        found = self.final.rig
        return self.traverse.calibration if found is None else found.calibration(self.traverse)

    @cached_property
    def landmark_row(self) -> IntArray:
        """(observations,) row in the landmarks of what each observation saw; -1 where there is none."""
        observations, n = self.traverse.observations, len(self.landmark_track)
        if observations is None or n == 0:
            return np.full(len(self.used), -1)
        order = np.argsort(self.landmark_track)
        place = np.searchsorted(self.landmark_track, observations.track, sorter=order)
        row = order[np.minimum(place, n - 1)]
        return np.where(self.landmark_track[row] == observations.track, row, -1)

    @cached_property
    def image_cameras(self) -> tuple[Camera, ...]:
        """Each image's camera as adjusted, distortion included, in its own frame.

        One object for all images of the same eye and calibration; the rig's own where nothing moved.
        """
        t, K, made = self.traverse, self.calibration, dict[tuple[int, bytes], Camera]()
        moved = np.any(t.calibration != K, axis=(1, 2))
        for i, eye in enumerate(t.image_eye.tolist()):
            key = (eye, K[i].tobytes())
            if key not in made:
                camera = t.rig.eyes[eye].camera
                made[key] = camera.with_calibration(K[i]) if moved[i] else camera
        return tuple(made[eye, k.tobytes()] for eye, k in zip(t.image_eye.tolist(), K, strict=True))

    @property
    def projections(self) -> FloatArray:
        """(images, 3, 4) projection matrix of each image's camera as adjusted, without distortion.

        From homogeneous points of the world to those of pixels; the first three entries of the third row have
        length 1.
        """
        camera_R_world = self.final.world_R_camera.transpose(0, 2, 1)
        return projection_matrix(self.calibration, camera_R_world, self.final.world_t_camera)

    @property
    def correction_rad(self) -> FloatArray:
        """(frames, 2) how far pan and tilt moved from the telemetry."""
        return self.final.pan_tilt_rad - self.traverse.pan_tilt_rad

    def stop_covariance_between(self, stop_a: str, stop_b: str) -> FloatArray:
        """Joint covariance (12, 12) of two stops' mast poses, all else marginalised; formal.

        In body-frame tangents, rotation first: those of `stop_a`, then those of `stop_b`; its diagonal blocks
        are `stop_covariance`. 0 where a pose is held, NaN where the solution leaves a direction free. Raises
        InputError for an unknown stop.
        """
        i, j = self._stop_row(stop_a), self._stop_row(stop_b)
        return np.full((12, 12), np.nan) if self.mast_covariance is None else self.mast_covariance.of(i, j)

    def relative_covariance(self, stop_a: str, stop_b: str) -> FloatArray:
        """Covariance (6, 6) of a_T_b, where b's mast is as a's sees it; rotation first, in the frame of b.

        What is wrong with both alike does not count: this is how well images join two stops. See
        `stop_covariance_between`.
        """
        joint = self.stop_covariance_between(stop_a, stop_b)
        a, b = (self.final.world_T_mast[self._stop_row(stop)] for stop in (stop_a, stop_b))
        return relative_pose_covariance(a, b, joint)

    def _stop_row(self, stop: str) -> int:
        ids = [entry.id for entry in self.traverse.stops]
        if stop not in ids:
            raise InputError(expected_one_of("stop", stop, ids))
        return ids.index(stop)

    def with_seconds(self, **seconds: float) -> "Solution":
        """The same solution with some wall-clock times filled in."""
        return replace(self, seconds=replace(self.seconds, **seconds))

    def with_cross_validation(self, found: CrossValidation) -> "Solution":
        """The same solution with a cross-validation of it."""
        return replace(self, cross_validation=found)


def _common(corrections: FloatArray) -> FloatArray:
    """The correction that all rows (n, m) are, (m,); 0 where they differ."""
    same = len(corrections) > 0 and bool(np.all(corrections == corrections[0]))
    return corrections[0] if same else np.zeros(corrections.shape[1])


def _corrected(pose: gtsam.Pose3, correction: FloatArray) -> gtsam.Pose3:
    rotation, translation = corrected_poses(pose.rotation().matrix(), pose.translation(), correction)
    return gtsam.Pose3(gtsam.Rot3(rotation), translation)
