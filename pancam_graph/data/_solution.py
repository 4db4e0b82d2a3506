"""The result of an adjustment."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np

from pancam_graph.base.choices import expected_one_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, corrected_poses, wrap_angle
from pancam_graph.base.text import shortened
from pancam_graph.cameras import CALIBRATION_ENTRIES, Camera, projection_matrix, with_added_field
from pancam_graph.data._cross_validation import CrossValidation
from pancam_graph.data._rig_treatment import RigTreatment
from pancam_graph.data._sharing import Quantity, Sharing
from pancam_graph.data._stereo import StereoCovariance
from pancam_graph.data._traverse import Traverse
from pancam_graph.data._verdict import Verdict
from pancam_graph.elimination import JointCovariance, relative_pose_covariance
from pancam_graph.rigs import Rig, RigCovariance

__all__ = ["Incremental", "Refined", "RigCorrection", "Seconds", "Solution", "State", "rms_px"]


@dataclass(frozen=True, kw_only=True, eq=False)
class RigCorrection:
    """Differences between the adjusted rig and the rig of the traverse; 0 where a number was held."""

    calibration_px: FloatArray
    """(images, 5) added to fx, fy, skew, cx and cy of each image's camera."""
    mount: FloatArray
    """(images, 6) correction of each image's `head_T_camera`: rotation vector, radians, and shift, metres, in
    the camera's own frame (geometry.corrected_poses)."""
    pan_T_tilt: FloatArray
    """(stops, 6) correction of the tilt axis, in the same form, in its own frame."""
    radius_m: FloatArray
    """(images,) metres added to the radius of the image's circle; model `circle`."""
    flex: FloatArray | None = None
    """(frames, 4) turn of each frame's head about its forward axis, radians, and shift along its own axes,
    metres; None where the mast is rigid."""
    encoders: FloatArray | None = None
    """(stops, 2) what pans and tilts exceed their readings by, as shares; None where these are exact."""
    field_px: FloatArray | None = None
    """(eyes, *cameras.FIELD_SHAPE) coefficients of each eye's smooth distortion field; None where there is
    none."""

    @staticmethod
    def to_calibrations(traverse: Traverse, calibration: FloatArray) -> "RigCorrection":
        """The correction from the rig's calibrations to K (images, 3, 3); it changes nothing else."""
        n, (row, column) = len(traverse.images), CALIBRATION_ENTRIES
        return RigCorrection(
            calibration_px=(calibration - traverse.calibration)[:, row, column],
            mount=np.zeros((n, 6)),
            pan_T_tilt=np.zeros((len(traverse.stops), 6)),
            radius_m=np.zeros(n),
        )

    def part(self, stops: slice, frames: IntArray, images: IntArray) -> "RigCorrection":
        """The corrections at some stops, and of these frames and images (n,)."""
        return RigCorrection(
            calibration_px=self.calibration_px[images],
            mount=self.mount[images],
            pan_T_tilt=self.pan_T_tilt[stops],
            radius_m=self.radius_m[images],
            flex=None if self.flex is None else self.flex[frames],
            encoders=None if self.encoders is None else self.encoders[stops],
            field_px=self.field_px,
        )

    def calibration(self, traverse: Traverse) -> FloatArray:
        """K (images, 3, 3) of each image's camera, upper-triangular, without distortion."""
        out: FloatArray = traverse.calibration.copy()
        row, column = CALIBRATION_ENTRIES
        out[:, row, column] += self.calibration_px
        return out


@dataclass(frozen=True, kw_only=True)
class Refined:
    """One free entry of the rig after the adjustment."""

    quantity: Quantity
    entry: str
    camera: str | None
    """Name of the eye that the entry belongs to; None if it belongs to all eyes."""
    stop: str | None
    """Id of the stop that the entry belongs to; None if it serves the whole traverse."""
    image: str | None
    """Id of the image that the entry belongs to; None if all images of the eye, or of the eye at the stop,
    share it."""
    nominal: float | None
    """Value in the rig: 0 for entries of a pose, 1 for a factor; None if images that share the entry
    differ."""
    change: float
    """Estimated difference from the rig's value."""
    sigma: float
    """Formal standard deviation, everything else marginalised; NaN if a direction is free."""
    prior_sigma: float
    """Standard deviation of the prior; infinite if there was none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """Values of all estimated quantities, in the order of the traverse's entries."""

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
    """Corrections of the rig; None if the rig is the traverse's."""

    def part(self, stops: slice, frames: IntArray, images: IntArray) -> "State":
        """The state of some stops, and of these frames and images (n,); without landmarks."""
        return State(
            world_T_mast=self.world_T_mast[stops],
            pan_tilt_rad=self.pan_tilt_rad[frames],
            world_R_camera=self.world_R_camera[images],
            world_t_camera=self.world_t_camera[images],
            landmarks_m=np.zeros((0, 3)),
            rig=None if self.rig is None else self.rig.part(stops, frames, images),
        )


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """Wall-clock seconds of each part of a run."""

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
    """Effort of each update of a smoother, in the order of the stops.

    Stops that an earlier run had added count with no time, and with the cost that it ended with.
    """

    seconds_per_stop: tuple[float, ...]
    cost_per_stop: tuple[float, ...]
    """Cost after each update."""
    relinearised_per_stop: tuple[int, ...]
    """Number of variables that were linearised anew."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """An adjusted traverse: its states before and after, its uncertainties, and its warnings."""

    traverse: Traverse
    """The input, observations included."""
    model: str
    landmarks: str
    converged: bool
    stop_reason: str
    """Reason why the iterations ended, in words."""
    iterations: int
    cost_history: tuple[float, ...]
    """Cost after each iteration of the final least-squares stage, its start first.

    It starts where screening for outliers ended; without a loss, at the telemetry."""
    cost_initial: float
    """Half the sum of squares of whitened residuals at the start, priors included."""
    cost_final: float
    """Cost at the end, over the same observations."""
    initial: State
    final: State
    landmark_track: IntArray
    """(landmarks,) track number of each landmark row."""
    used: BoolArray
    """(observations,) whether each observation took part in the final least-squares stage."""
    reason: tuple[str, ...]
    """(observations,) reason for leaving an observation out: "outlier", "single" (its track is seen once,
    or, where cameras are variables, from one place alone), "behind" (its landmark lies behind the camera),
    "outside" (of its camera model's domain); "" if used."""
    residual_initial_px: FloatArray
    """(observations, 2) projected minus measured at the start, raw image pixels; NaN where undefined."""
    residual_final_px: FloatArray
    """(observations, 2) residuals at the end, also of outliers whose landmark exists."""
    sigma_px: FloatArray
    """(observations,) standard deviation in the final weight; the root of the mean variance of
    covariances."""
    stop_covariance: FloatArray
    """(stops, 6, 6) formal covariance of each mast pose, rotation first, body frame, landmarks marginalised.

    0 for a held stop; NaN, with a warning, if the solution leaves a direction free."""
    angle_sigma_rad: FloatArray
    """(frames, 2) formal standard deviation of pan and tilt, landmarks marginalised; NaN as
    `stop_covariance`."""
    covariance_px2: FloatArray | None = None
    """(observations, 2, 2) covariance in the final weight; None if the input has no covariances."""
    landmark_covariance_m2: FloatArray | None = None
    """(landmarks, 3, 3) formal covariance of `final.landmarks_m`, all else marginalised; None unless
    requested."""
    stereo_covariance: StereoCovariance | None = field(default=None, repr=False)
    """Covariances of places that stereo pairs see, due to poses, angles and the rig; None unless requested,
    and where a direction is free or the cameras are variables themselves."""
    mast_covariance: JointCovariance | None = field(default=None, repr=False)
    """Square root of the joint covariance of all masts, for `stop_covariance_between`; None if a direction is
    free."""
    came_back: BoolArray | None = None
    """(observations,) whether an observation is used after it had been set aside; None if not recorded."""
    refined: tuple[Refined, ...] = ()
    """Free entries of the rig (`Sharing`), ordered by quantity and owner."""
    treatment: RigTreatment | None = None
    """What became of the rig's uncertainty; "estimated" also where a sharing of the user's freed numbers of
    the rig, "held" where it freed none. None: not recorded."""
    sharing: Sharing | None = None
    """What of the rig was estimated, with its priors; None: not recorded."""
    rig_covariance: RigCovariance | None = None
    """Joint covariance of the adjusted rig's numbers about their values; None unless the rig was estimated
    within its own uncertainty."""
    method: str = "joint"
    """Name of the method (`SolveOptions.method`)."""
    cross_validation: CrossValidation | None = None
    """Cross-validation of the sigmas; None unless requested."""
    incremental: "Incremental | None" = None
    """Effort of each update, if the solution was made stop by stop; else None."""
    verdict: Verdict | None = None
    """Tests that say whether the numbers can be believed; None if the solution was not tested."""
    warnings: tuple[str, ...] = ()
    seconds: Seconds = field(default_factory=Seconds)

    def __repr__(self) -> str:
        """What was adjusted and what became of it, in five lines."""
        t, used = self.traverse, int(self.used.sum())
        outcome = "converged" if self.converged else f"not converged ({self.stop_reason})"
        if self.verdict is not None:
            failed = ", ".join(test.name for test in self.verdict.failures)
            outcome += f"; its tests {'failed: ' + failed if failed else 'passed'}"
        moved, sigma = (
            _medians_mrad(np.abs(wrap_angle(self.correction_rad))),
            _medians_mrad(self.angle_sigma_rad),
        )
        return (
            f"Solution of {t.name!r}: {outcome}\n"
            f"  {len(t.stops)} stops, {len(t.frames)} frames, {len(t.images)} images, "
            f"{len(self.landmark_track)} landmarks; model {self.model}, {self.iterations} iterations\n"
            f"  RMS {self.rms_initial_px:.3g} -> {self.rms_final_px:.3g} px over {used} of {len(self.used)} "
            "observations\n"
            f"  pan and tilt moved by {moved} mrad, formal sigma {sigma} mrad (medians)\n"
            f"  {len(self.warnings)} warnings{': ' + shortened(self.warnings[0]) if self.warnings else ''}"
        )

    @property
    def passed(self) -> bool:
        """Whether the iterations converged, and no test of the verdict failed."""
        return self.converged and (self.verdict is None or self.verdict.passed)

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
        """The adjusted rig: its tilt axis, and the calibration, smooth field and mount of each eye.

        It has only corrections that serve the whole traverse. Corrections of single stops or images are in
        `final.rig`. If nothing was free, it is the rig of the input.
        """
        rig, correction, t = self.traverse.rig, self.final.rig, self.traverse
        if correction is None:
            return rig
        eyes = []
        for i, eye in enumerate(rig.eyes):
            of_eye = t.image_eye == i
            calibration = _common(correction.calibration_px[of_eye])
            mount = _common(correction.mount[of_eye])
            camera, head_T_camera = eye.camera, eye.head_T_camera
            if correction.field_px is not None:
                camera = with_added_field(camera, correction.field_px[i])
            if calibration.any():
                fx, fy, skew, cx, cy = calibration
                change = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 0.0]])
                camera = camera.with_calibration(camera.pinhole.calibration_matrix + change)
            if mount.any():
                head_T_camera = _corrected(head_T_camera, mount)
            eyes.append(replace(eye, camera=camera, head_T_camera=head_T_camera))
        axis = _common(correction.pan_T_tilt)
        pan_T_tilt = _corrected(rig.pan_T_tilt, axis) if axis.any() else rig.pan_T_tilt
        return replace(rig, eyes=tuple(eyes), pan_T_tilt=pan_T_tilt)

    @property
    def calibration(self) -> FloatArray:
        """(images, 3, 3) adjusted calibration matrix K, upper-triangular, without distortion."""
        correction = self.final.rig
        return self.traverse.calibration if correction is None else correction.calibration(self.traverse)

    @cached_property
    def landmark_row(self) -> IntArray:
        """(observations,) row of the landmark of each observation; -1 if it does not exist."""
        observations, n = self.traverse.observations, len(self.landmark_track)
        if observations is None or n == 0:
            return np.full(len(self.used), -1)
        order = np.argsort(self.landmark_track)
        place = np.searchsorted(self.landmark_track, observations.track, sorter=order)
        row = order[np.minimum(place, n - 1)]
        return np.where(self.landmark_track[row] == observations.track, row, -1)

    @cached_property
    def image_cameras(self) -> tuple[Camera, ...]:
        """Adjusted camera of each image, distortion and smooth field included, in the camera's own frame.

        Images of the same eye and calibration share one object; it is the rig's own if nothing changed.
        """
        t, K, made = self.traverse, self.calibration, dict[tuple[int, bytes], Camera]()
        moved = np.any(t.calibration != K, axis=(1, 2))
        fields = None if self.final.rig is None else self.final.rig.field_px
        for i, eye in enumerate(t.image_eye.tolist()):
            key = (eye, K[i].tobytes())
            if key not in made:
                camera = t.rig.eyes[eye].camera
                camera = camera.with_calibration(K[i]) if moved[i] else camera
                made[key] = camera if fields is None else with_added_field(camera, fields[eye])
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
        """(frames, 2) adjusted pan and tilt less those of telemetry, radians."""
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
        if stop_a == stop_b:
            return np.zeros((6, 6))
        a, b = (self.final.world_T_mast[self._stop_row(stop)] for stop in (stop_a, stop_b))
        return relative_pose_covariance(a, b, joint)

    def _stop_row(self, stop: str) -> int:
        ids = [entry.id for entry in self.traverse.stops]
        if stop not in ids:
            raise InputError(expected_one_of("stop", stop, ids))
        return ids.index(stop)

    def with_seconds(self, **seconds: float) -> "Solution":
        """The same solution with some wall-clock seconds replaced."""
        return replace(self, seconds=replace(self.seconds, **seconds))

    def with_cross_validation(self, cross_validation: CrossValidation) -> "Solution":
        """The same solution with its cross-validation."""
        return replace(self, cross_validation=cross_validation)


def _medians_mrad(angles_rad: FloatArray) -> str:
    """Medians of pan and tilt (frames, 2) in words; those that are not finite do not count."""
    columns = ([v for v in column if np.isfinite(v)] for column in angles_rad.T)
    return " and ".join(f"{1e3 * np.median(column):.3g}" if column else "unknown" for column in columns)


def _common(corrections: FloatArray) -> FloatArray:
    """The common value (m,) of all rows (n, m); 0 if rows differ."""
    same = len(corrections) > 0 and bool(np.all(corrections == corrections[0]))
    return corrections[0] if same else np.zeros(corrections.shape[1])


def _corrected(pose: gtsam.Pose3, correction: FloatArray) -> gtsam.Pose3:
    rotation, translation = corrected_poses(pose.rotation().matrix(), pose.translation(), correction)
    return gtsam.Pose3(gtsam.Rot3(rotation), translation)
