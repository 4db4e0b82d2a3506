"""Camera poses as variables, tied to the mast: the rig as a factor template with flex.

Variables: `M` mast pose per stop (Pose3), `A` pan and tilt per frame (vector of 2), `F` how a frame's head
stands off the mast (vector), where that is free, `X` camera pose per image (Pose3), and the free entries of
the rig (`_rig_variables`). Quantities that telemetry holds (sigma 0) are not variables.
"""

from functools import cached_property

import gtsam
import numpy as np

from pancam_graph.base.geometry import (
    BoolArray,
    FloatArray,
    IntArray,
    pan_tilt_from_rotation,
    pan_tilt_rotation,
    pose_arrays,
    wrap_angle,
)
from pancam_graph.data import FrameSeen, Sharing, State, Traverse
from pancam_graph.elimination import Linkage, Posture
from pancam_graph.factors import (
    CircleOffset,
    Fixed,
    Key,
    Slot,
    circle_factor,
    mast_factor,
)
from pancam_graph.graph._factors import FactorList
from pancam_graph.graph._given import Seat
from pancam_graph.graph._graph_options import RIGID, Flex, Model
from pancam_graph.graph._keys import Kind, index_of, key_of
from pancam_graph.graph._seen_factors import seen_by_camera
from pancam_graph.graph._template import FactorTemplate, diagonal_noise
from pancam_graph.landmarks import CameraViews

__all__ = ["SoftTemplate"]

_STEEP = 0.5
"""Horizontal part of the head's x axis below which pan and tilt are those of the whole rotation: that of 60
degrees of tilt."""
_NEAREST_STEPS = 3
"""Gauss-Newton steps to the nearest pan and tilt."""


class SoftTemplate(FactorTemplate):
    """Factors and variables with camera poses tied to the mast; the sigma of the tie is the mast's flex."""

    _camera_kind = Kind.CAMERA
    _camera_dim = 6
    """Dimension of a camera's variable"""
    refines_landmarks = True
    """Independent cameras may move far in directions that images hardly determine; the linear step of a
    landmark is then wrong by more than noise. Three clusters of one eye took up to 81 steps without this
    refinement, and 7 with it."""

    def __init__(self, traverse: Traverse, model: Model, flex: Flex, sharing: Sharing | None = None) -> None:
        super().__init__(traverse, model, sharing)
        self.flex = flex

    def pan_tilt(self, frame: int) -> Slot:
        """Slot of a frame's pan and tilt: fixed where both sigmas are 0."""
        entry = self.traverse.frames[frame]
        if entry.sigma_pan_rad == 0 and entry.sigma_tilt_rad == 0:
            return Fixed(self.traverse.pan_tilt_rad[frame])
        return Key(key_of(Kind.ANGLES, frame))

    def flex_key(self, frame: int) -> int | None:
        """Key of a frame's flex; None where the frame is held, or no head flexes."""
        free = bool(self.head_flex) and isinstance(self.pan_tilt(frame), Key)
        return key_of(Kind.FLEX, frame) if free else None

    @classmethod
    def camera_key(cls, image: int) -> int:
        """Key of an image's camera."""
        return key_of(cls._camera_kind, image)

    @cached_property
    def linkage(self) -> Linkage:
        """One unit per image, which depends on its camera and calibration; ties link other variables."""
        t, free = self.traverse, self.rig_variables
        dim: dict[int, int] = {}
        group: list[int] = []
        for stop in range(len(t.stops)):
            before = len(dim)
            dim |= {self.camera_key(int(i)): self._camera_dim for i in np.flatnonzero(t.image_stop == stop)}
            angles = (self.pan_tilt(int(f)) for f in np.flatnonzero(t.frame_stop == stop))
            dim |= {slot.key: 2 for slot in angles if isinstance(slot, Key)}
            flexes = map(self.flex_key, np.flatnonzero(t.frame_stop == stop).tolist())
            dim |= {key: len(self.head_flex) for key in flexes if key is not None}
            if isinstance(mast := self.mast(stop), Key):
                dim[mast.key] = 6
            dim |= {v.key: len(v.entries) for v in free.of_stop(stop)}
            group += [stop] * (len(dim) - before)
        shared = {v.key: len(v.entries) for v in free.of_stop(None)}
        dim |= shared
        group += [len(t.stops)] * len(shared)
        row, n = {key: i for i, key in enumerate(dim)}, len(t.images)
        variable = np.array([[row[self.camera_key(i)]] for i in range(n)], dtype=np.int64)
        width = np.full((n, 1), self._camera_dim)
        if free.of["calibration"]:
            own_K = np.array([row[v.key] for v in free.of["calibration"]])[free.place("calibration")]
            variable = np.column_stack([variable, own_K])
            width = np.column_stack([width, np.full(n, free.basis("calibration").shape[2])])
        return Linkage(
            key=tuple(dim),
            dim=np.array(list(dim.values()), dtype=np.int64),
            group=np.array(group, dtype=np.int64),
            image_unit=np.arange(n),
            segment_begin=np.arange(n + 1) * variable.shape[1],
            segment_variable=variable.ravel(),
            segment_column=np.zeros(variable.size, dtype=np.int64),
            segment_width=width.ravel(),
            segment_plain=(np.arange(variable.size) % variable.shape[1] == 0)
            & (self._camera_kind is Kind.CAMERA),
        )

    def posture(self, values: gtsam.Values) -> Posture:
        """Cameras at the values; a unit's base is the camera itself."""
        views, n = self.views(values), len(self.traverse.images)
        chain = np.broadcast_to(np.eye(6), (n, 6, 6))
        if self.rig_variables.of["calibration"]:
            basis = self.rig_variables.basis("calibration")
            chain = np.zeros((2 * n, 11, 6))
            chain[::2, :6] = np.eye(6)
            chain[1::2, 6:, : basis.shape[2]] = basis
        return Posture(views=views, unit_R=views.world_R_camera, unit_t=views.world_t_camera, chain=chain)

    def views(self, values: gtsam.Values) -> CameraViews:
        """Cameras of all images at the values."""
        poses = [values.atPose3(self.camera_key(i)) for i in range(len(self.traverse.images))]
        return self.views_of(*pose_arrays(poses), values)

    def angle_factors(self, stop: int) -> FactorList:
        """Priors of a stop's pans and tilts: one a frame, or one of all where they share an error."""
        t = self.traverse
        free = [f for f in np.flatnonzero(t.frame_stop == stop) if isinstance(self.pan_tilt(int(f)), Key)]
        frames = np.array(free, dtype=np.int64)
        common = bool(self.let_go.common_rad[stop].any())
        return [
            self.angle_prior(some, self.angle_noise(stop, some), [key_of(Kind.ANGLES, int(f)) for f in some])
            for some in ([frames] if common and len(frames) else frames[:, None])
        ]

    def flex_factors(self, stop: int) -> FactorList:
        """The priors of how a stop's heads stand off the mast, if they may."""
        keys = map(self.flex_key, np.flatnonzero(self.traverse.frame_stop == stop).tolist())
        return [self.head_flex.prior(key, 1) for key in keys if key is not None]

    def flexes(self, values: gtsam.Values) -> FloatArray | None:
        """As in the base class; 0 for frames whose angles are held."""
        if not self.head_flex:
            return None
        out = np.zeros((len(self.traverse.frames), 6))
        for frame in range(len(out)):
            if (key := self.flex_key(frame)) is not None:
                out[frame, self.head_flex.columns] = values.atVector(key)
        return out

    def flex_seat(self, frame: int) -> Seat:
        """The variable of the frame; fixed where its angles are."""
        key = self.flex_key(frame)
        return (
            Seat.fixed(np.zeros(len(self.head_flex))) if key is None else Seat.same(key, len(self.head_flex))
        )

    def tie_factors(self, images: IntArray) -> FactorList:
        """The ties of some images' camera poses to the mast, in the model `circle` also to their circles.

        All images share one factor: single factors would take most of the time of a solve.
        """
        t, free, flex = self.traverse, self.rig_variables, self.flex
        cameras = [Key(self.camera_key(int(i))) for i in images]
        angles = [self.pan_tilt(int(f)) for f in t.image_frame[images]]
        mast = [self.mast(int(s)) for s in t.image_stop[images]]
        chain = (cameras, mast, angles, [free.mount_slot(int(i)) for i in images])
        axis = [free.axis_slot(int(s)) for s in t.image_stop[images]]
        if self.model != "circle":
            sigmas = np.repeat([flex.rotation_rad, flex.translation_m], 3)
            heads = [self.head_flex.slot(self.flex_key(int(f))) for f in t.image_frame[images]]
            flexed = [slot for slot in heads if slot is not None] or None
            return [mast_factor(diagonal_noise(np.tile(sigmas, len(images))), *chain, axis, flexed)]

        # The chain ties the rotation loosely; the centre is tied by the circle alone.
        tilts = [t.frames[int(f)].tilt_rad for f in t.image_frame[images]]
        circles = np.array(
            [t.rig.circle(int(e), tilt) for e, tilt in zip(t.image_eye[images], tilts, strict=True)]
        )
        radii = [free.radius_slot(int(i)) for i in images]
        offset = CircleOffset(
            height_m=circles[:, 2],
            phase_rad=circles[:, 1],
            radius_m=circles[:, 0] - [reference for _, reference in radii],
        )
        # The measured tilt places the circle; its error moves the centre by the eye's arm.
        arms = [float(np.linalg.norm(e.head_T_camera.translation()[[0, 2]])) for e in t.rig.eyes]
        sigma_tilt = np.array([t.frames[int(f)].sigma_tilt_rad for f in t.image_frame[images]])
        sigma = np.hypot(flex.translation_m, np.array(arms)[t.image_eye[images]] * sigma_tilt)
        loose = diagonal_noise(np.tile(np.repeat([flex.rotation_rad, 1e3], 3), len(images)))
        on_circle = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(sigma, 3))
        return [
            mast_factor(loose, *chain, axis),
            circle_factor(on_circle, cameras, mast, [slot for slot, _ in radii], angles, offset),
        ]

    def telemetry_priors(self) -> FactorList:
        """Priors of masts, then of angles."""
        t = self.traverse
        masts = [factor for i in range(len(t.stops)) for factor in self.stop_factors(i)]
        return masts + [factor for i in range(len(t.stops)) for factor in self.angle_factors(i)]

    def ties(self, *, apart: bool = False) -> FactorList:
        """Ties of cameras to the mast: one factor for each stop, or for each image if `apart`."""
        t = self.traverse
        owner = np.arange(len(t.images)) if apart else t.image_stop
        tied = [np.flatnonzero(owner == i) for i in range(len(t.images) if apart else len(t.stops))]
        return [factor for images in tied if len(images) for factor in self.tie_factors(images)]

    def seen_factor(self, one: FrameSeen) -> gtsam.CustomFactor:
        """As in the base class, but by the camera's own pose, unless the tie makes that the mast's."""
        if self.flex == RIGID:
            return super().seen_factor(one)
        image = self.image_of(one)
        return seen_by_camera(one, self.rig_variables, image, Key(self.camera_key(image)), self.plain_px(one))

    @property
    def has_cameras(self) -> bool:
        """True: each image has a variable for its camera."""
        return True

    def angle_frames(self, key: int) -> IntArray:
        """The frame of the variable."""
        return np.array([index_of(key)])

    def angle_seat(self, frame: int) -> Seat:
        """The variable of the frame; fixed where both sigmas are 0."""
        slot = self.pan_tilt(frame)
        if not isinstance(slot, Key):
            return Seat.fixed(slot.value)
        return Seat.same(slot.key, 2, self._held_angles(frame))

    def values(self, state: State) -> gtsam.Values:
        """The variables at a state."""
        values = gtsam.Values()
        for i, pose in enumerate(state.world_T_mast):
            if isinstance(slot := self.mast(i), Key):
                values.insert(slot.key, pose)
        for i, angles in enumerate(state.pan_tilt_rad):
            if isinstance(slot := self.pan_tilt(i), Key):
                values.insert(slot.key, angles)
        for i, flex in enumerate(self.head_flex.start(state.rig, len(self.traverse.frames))):
            if (key := self.flex_key(i)) is not None:
                values.insert(key, flex)
        self.insert_cameras(values, state)
        self.rig_variables.insert(values, state.rig)
        return values

    def insert_cameras(self, values: gtsam.Values, state: State) -> None:
        """Add the cameras of a state."""
        for i in range(len(self.traverse.images)):
            pose = gtsam.Pose3(gtsam.Rot3(state.world_R_camera[i]), state.world_t_camera[i])
            values.insert(self.camera_key(i), pose)

    def state(self, values: gtsam.Values, landmarks_m: FloatArray, views: CameraViews | None = None) -> State:
        """The state at values of the variables; inverse of `values`.

        In the model `mast` pan and tilt are the variables themselves. In the other models they follow from
        the camera poses relative to the mast, which contain the pointing by the images.
        """
        t, masts, views = self.traverse, self.masts(values), views or self.views(values)
        angles = np.array(
            [
                values.atVector(slot.key) if isinstance(slot := self.pan_tilt(i), Key) else slot.value
                for i in range(len(t.frames))
            ]
        ).reshape(-1, 2)
        if self.model != "mast":
            offset = self.image_pointing_offset(masts, angles, views.world_R_camera)
            angles = angles + _mean_by_frame(t, offset)
        return State(
            world_T_mast=masts,
            pan_tilt_rad=angles,
            world_R_camera=views.world_R_camera,
            world_t_camera=views.world_t_camera,
            landmarks_m=landmarks_m,
            rig=self.correction(values),
        )

    def held_columns(self) -> dict[int, IntArray]:
        """By key, tangent components that telemetry holds while others of the same variable are free."""
        held = self.held_of_stops()
        for i in range(len(self.traverse.frames)):
            if isinstance(slot := self.pan_tilt(i), Key):
                held[slot.key] = self._held_angles(i)
        return held

    def _held_angles(self, frame: int) -> IntArray:
        entry = self.traverse.frames[frame]
        return np.flatnonzero(np.array([entry.sigma_pan_rad, entry.sigma_tilt_rad]) == 0)

    def angle_rows(self, frame: int, state: State) -> tuple[IntArray, FloatArray]:
        """Jacobian of a frame's pan and tilt by the variables of its stop.

        As in `state`, pan and tilt in models other than `mast` are those of the camera poses: the mean over
        the eyes of the frame.
        """
        t, link = self.traverse, self.linkage
        stop = int(t.frame_stop[frame])
        columns, rows = [np.zeros(0, dtype=np.int64)], [np.zeros((2, 0))]

        def add(key: int, jacobian: FloatArray) -> None:
            columns.append(link.columns_of(key).start + np.arange(jacobian.shape[1]))
            rows.append(jacobian)

        images = np.flatnonzero((t.image_frame == frame) & (self.model != "mast"))
        if isinstance(slot := self.pan_tilt(frame), Key):
            is_seen = bool(len(images))
            nominal = self._d_nominal(frame, state.pan_tilt_rad[frame]) if is_seen else np.zeros((2, 2))
            add(slot.key, np.eye(2) - nominal)
        mast_R = state.world_T_mast[stop].rotation().matrix()
        by_mast = np.zeros((2, 3))
        for i in images:
            camera_R = mast_R.T @ state.world_R_camera[i]
            head_R = camera_R @ t.rig.eyes[int(t.image_eye[i])].head_T_camera.rotation().matrix().T
            d_angles = self._d_angles(frame, state.pan_tilt_rad[frame], head_R) / len(images)
            add(self.camera_key(int(i)), d_angles @ camera_R @ self.camera_turn(int(i), state))
            by_mast -= d_angles
        if len(images) and isinstance(slot := self.mast(stop), Key):
            add(slot.key, by_mast)
        return np.concatenate(columns), np.hstack(rows)

    @cached_property
    def _is_steep(self) -> BoolArray:
        """(frames,) whether the head looks so far up or down that its x axis tells little of its pan."""
        return np.asarray(np.hypot(*self._mast_R_head(self.traverse.pan_tilt_rad)[:, :2, 0].T) < _STEEP)

    def _mast_R_head(self, pan_tilt_rad: FloatArray) -> FloatArray:
        return self.traverse.rig.mast_T_head(pan_tilt_rad[:, 0], pan_tilt_rad[:, 1])[0]

    def _turns(self, pan_tilt_rad: FloatArray) -> FloatArray:
        """Rotation vectors (n, 3, 2) of the head in the mast frame per radian of its pan and tilt (n, 2)."""
        pan_R = pan_tilt_rotation(pan_tilt_rad[:, 0], np.zeros(len(pan_tilt_rad)))
        tilt_axis = pan_R @ self.traverse.rig.pan_T_tilt.rotation().matrix()[:, 1]
        return np.stack([np.broadcast_to([0.0, 0.0, 1.0], tilt_axis.shape), -tilt_axis], axis=2)

    def _d_nominal(self, frame: int, pan_tilt_rad: FloatArray) -> FloatArray:
        """Jacobian (2, 2) of the nominal pan and tilt of `image_pointing_offset` by the angles (2,).

        It is the identity where the tilt axis is perpendicular to the pan axis.
        """
        head_R = self._mast_R_head(pan_tilt_rad[None])[0]
        return np.asarray(self._d_angles(frame, pan_tilt_rad, head_R) @ self._turns(pan_tilt_rad[None])[0])

    def _d_angles(self, frame: int, pan_tilt_rad: FloatArray, mast_R_head: FloatArray) -> FloatArray:
        """Jacobian (2, 3) of a frame's pan and tilt by a small rotation of the head in the mast frame."""
        if self._is_steep[frame]:
            return np.asarray(np.linalg.pinv(self._turns(pan_tilt_rad[None])[0]))
        return _d_pan_tilt(mast_R_head)

    def camera_turn(self, image: int, state: State) -> FloatArray:
        """Jacobian (3, k) of a camera's rotation, in its own frame, by the first columns of its variable."""
        return np.eye(3)

    def image_pointing_offset(
        self, masts: tuple[gtsam.Pose3, ...], pan_tilt_rad: FloatArray, world_R_camera: FloatArray
    ) -> FloatArray:
        """(images, 2) pan and tilt of each camera pose relative to its mast, minus those of its frame.

        They are those of the head's x axis; where that is steep (`_is_steep`), those whose head differs from
        the camera's by the smallest rotation, since a twist about a vertical axis looks like a pan.
        """
        t = self.traverse
        masts_R, _ = pose_arrays(masts)
        mounts_R, _ = pose_arrays([e.head_T_camera for e in t.rig.eyes])
        head_R = (
            masts_R[t.image_stop].transpose(0, 2, 1)
            @ world_R_camera
            @ mounts_R[t.image_eye].transpose(0, 2, 1)
        )
        angles = pan_tilt_rad[t.image_frame]
        seen, nominal = pan_tilt_from_rotation(head_R), pan_tilt_from_rotation(self._mast_R_head(angles))
        offset = wrap_angle(np.column_stack([seen[0] - nominal[0], seen[1] - nominal[1]]))
        steep = np.flatnonzero(self._is_steep[t.image_frame])
        offset[steep] = self._nearest(head_R[steep], angles[steep]) - angles[steep]
        return offset

    def _nearest(self, mast_R_head: FloatArray, pan_tilt_rad: FloatArray) -> FloatArray:
        """Angles (n, 2) near the given ones whose heads differ from the given ones by the least rotation."""
        angles = pan_tilt_rad
        for _ in range(_NEAREST_STEPS):
            turned = mast_R_head @ self._mast_R_head(angles).transpose(0, 2, 1)
            rotation = np.array([gtsam.Rot3.Logmap(gtsam.Rot3(one)) for one in turned]).reshape(-1, 3)
            angles = angles + (np.linalg.pinv(self._turns(angles)) @ rotation[:, :, None])[:, :, 0]
        return angles


def _d_pan_tilt(mast_R_head: FloatArray) -> FloatArray:
    """Jacobian (2, 3) of pan and tilt of the head's x axis by a small rotation in the mast frame."""
    pan, tilt = pan_tilt_from_rotation(mast_R_head)
    return np.array(
        [[-np.cos(pan) * np.tan(tilt), -np.sin(pan) * np.tan(tilt), 1.0], [np.sin(pan), -np.cos(pan), 0.0]]
    )


def _mean_by_frame(traverse: Traverse, per_image: FloatArray) -> FloatArray:
    count = np.bincount(traverse.image_frame, minlength=len(traverse.frames)).clip(1)
    sums = [np.bincount(traverse.image_frame, c, minlength=len(traverse.frames)) for c in per_image.T]
    return np.asarray(np.stack(sums, axis=1) / count[:, None])
