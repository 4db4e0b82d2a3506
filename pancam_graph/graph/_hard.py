"""Camera poses computed from the mast: the rig as a factor template without flex.

Variables: `M` mast pose per stop (Pose3), `A` pan and tilt of a stop's frames, stacked (vector). What
telemetry holds (sigma 0) is not a variable.
"""

from functools import cached_property

import gtsam
import numpy as np

from pancam_graph.elimination import Covariance, Linkage, Posture
from pancam_graph.factors import Key
from pancam_graph.geometry import FloatArray, IntArray, compose, pan_tilt_rotation, pose_arrays
from pancam_graph.graph._template import Factors, FactorTemplate, diagonal_noise
from pancam_graph.landmarks import CameraViews
from pancam_graph.solution import State
from pancam_graph.traverse import Traverse

__all__ = ["HardTemplate"]


class HardTemplate(FactorTemplate):
    """The rigid mast: world_T_camera = world_T_mast . Rz(pan) . pan_T_tilt . Ry(-tilt) . head_T_camera."""

    def __init__(self, traverse: Traverse) -> None:
        super().__init__(traverse, "mast")
        sigmas = np.array([[f.sigma_pan_rad, f.sigma_tilt_rad] for f in traverse.frames])
        self._sigmas = sigmas
        free = sigmas.any(axis=1)
        self._frames = tuple(
            np.flatnonzero((traverse.frame_stop == stop) & free) for stop in range(len(traverse.stops))
        )

    @staticmethod
    def angles_key(stop: int) -> int:
        """Key of the pan and tilt of those frames of a stop that are not held."""
        return int(gtsam.symbol("A", stop))

    @cached_property
    def linkage(self) -> Linkage:
        """One unit per frame, for its eyes are rigid to each other; it hangs on its angles and its mast."""
        t = self.traverse
        keys: list[int] = []
        dims: list[int] = []
        group: list[int] = []
        angles: dict[int, int] = {}
        masts: dict[int, int] = {}
        for stop, frames in enumerate(self._frames):
            if len(frames):
                angles[stop] = len(keys)
                keys.append(self.angles_key(stop))
                dims.append(2 * len(frames))
                group.append(stop)
            if isinstance(slot := self.mast(stop), Key):
                masts[stop] = len(keys)
                keys.append(slot.key)
                dims.append(6)
                group.append(stop)
        place = {int(f): i for frames in self._frames for i, f in enumerate(frames)}
        begin, variable, column, width = [0], [], [], []
        for frame, stop in enumerate(t.frame_stop.tolist()):
            if frame in place:
                variable.append(angles[stop])
                column.append(2 * place[frame])
                width.append(2)
            if stop in masts:
                variable.append(masts[stop])
                column.append(0)
                width.append(6)
            begin.append(len(variable))
        return Linkage(
            key=tuple(keys),
            dim=np.array(dims, dtype=np.int64),
            group=np.array(group, dtype=np.int64),
            image_unit=t.image_frame,
            segment_begin=np.array(begin, dtype=np.int64),
            segment_variable=np.array(variable, dtype=np.int64),
            segment_column=np.array(column, dtype=np.int64),
            segment_width=np.array(width, dtype=np.int64),
            segment_plain=np.array(width, dtype=np.int64) == 6,  # a mast's
        )

    def posture(self, values: gtsam.Values) -> Posture:
        """Cameras at the values; a unit's base is the mast of its stop."""
        t, angles = self.traverse, self._angles(values)
        masts = pose_arrays(self.masts(values))
        chain = np.zeros((len(self.linkage.segment_width), 6, 6))
        is_mast = self.linkage.segment_width == 6
        chain[is_mast] = np.eye(6)
        free = self._sigmas.any(axis=1)
        chain[~is_mast, :, :2] = _angle_twists(t, angles[free])
        return Posture(
            views=self._views(masts, angles),
            unit_R=masts[0][t.frame_stop],
            unit_t=masts[1][t.frame_stop],
            chain=chain,
        )

    def views(self, values: gtsam.Values) -> CameraViews:
        """Cameras of all images at the values."""
        return self._views(pose_arrays(self.masts(values)), self._angles(values))

    def _views(self, masts: tuple[FloatArray, FloatArray], angles: FloatArray) -> CameraViews:
        t = self.traverse
        # Once per frame, not once per image: the eyes share their head.
        head = compose(masts[0][t.frame_stop], masts[1][t.frame_stop], *t.rig.mast_T_head(*angles.T))
        mounts = pose_arrays([e.head_T_camera for e in t.rig.eyes])
        image, eye = t.image_frame, t.image_eye
        return self.views_of(*compose(head[0][image], head[1][image], mounts[0][eye], mounts[1][eye]))

    def _angles(self, values: gtsam.Values) -> FloatArray:
        angles: FloatArray = self.traverse.pan_tilt_rad.copy()
        for stop, frames in enumerate(self._frames):
            if len(frames):
                angles[frames] = values.atVector(self.angles_key(stop)).reshape(-1, 2)
        return angles

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """Priors of the masts and of the angles."""
        graph = gtsam.NonlinearFactorGraph()
        for stop in range(len(self.traverse.stops)):
            for factor in (*self.stop_factors(stop), *self.angle_factors(stop)):
                graph.push_back(factor)
        return graph

    def angle_factors(self, stop: int) -> Factors:
        """The prior of a stop's pan and tilt angles."""
        frames = self._frames[stop]
        if not len(frames):
            return []
        measured, noise = (
            self.traverse.pan_tilt_rad[frames].ravel(),
            diagonal_noise(self._sigmas[frames].ravel()),
        )
        return [gtsam.PriorFactorVector(self.angles_key(stop), measured, noise)]

    def values(self, state: State) -> gtsam.Values:
        """The variables at a state."""
        values = gtsam.Values()
        for stop, frames in enumerate(self._frames):
            if len(frames):
                values.insert(self.angles_key(stop), state.pan_tilt_rad[frames].ravel())
            if isinstance(slot := self.mast(stop), Key):
                values.insert(slot.key, state.world_T_mast[stop])
        return values

    def state(self, values: gtsam.Values, landmarks_m: FloatArray) -> State:
        """The state at values of the variables; inverse of `values`."""
        views = self.views(values)
        return State(
            world_T_mast=self.masts(values),
            pan_tilt_rad=self._angles(values),
            world_R_camera=views.world_R_camera,
            world_t_camera=views.world_t_camera,
            landmarks_m=landmarks_m,
        )

    def held_columns(self) -> dict[int, IntArray]:
        """By key, tangent components that telemetry holds while others of the same variable are free."""
        held = self.held_of_stops()
        for stop, frames in enumerate(self._frames):
            if len(frames):
                held[self.angles_key(stop)] = np.flatnonzero(self._sigmas[frames].ravel() == 0)
        return held

    def angle_rows(self, frame: int, state: State) -> tuple[IntArray, FloatArray]:
        """A frame's pan and tilt are variables: columns (2,), rows (2, 2); no columns where they are held."""
        if not self._sigmas[frame].any():
            return np.zeros(0, dtype=np.int64), np.zeros((2, 0))
        stop = int(self.traverse.frame_stop[frame])
        place = int(np.searchsorted(self._frames[stop], frame))
        begin = self.linkage.columns_of(self.angles_key(stop)).start + 2 * place
        return np.arange(begin, begin + 2), np.eye(2)

    def angle_sigma_rad(self, covariance: Covariance, state: State) -> FloatArray:
        """As in the base class, but all frames of a stop at once: a hundred times faster."""
        sigma = np.zeros((len(self.traverse.frames), 2))
        for stop, frames in enumerate(self._frames):
            if len(frames):
                rows = self.linkage.columns_of(self.angles_key(stop))
                variance = np.diag(covariance.block(stop, stop)[rows, rows])
                sigma[frames] = np.sqrt(variance).reshape(-1, 2)
        return sigma


def _angle_twists(traverse: Traverse, pan_tilt_rad: FloatArray) -> FloatArray:
    """Twists of the mast frame (n, 6, 2), rotation first, that move the head as its pan and tilt do.

    Pan turns about the mast's z. Tilt turns about minus the tilt axis y, which stands at pan_T_tilt on the
    pan stage; at the mast's origin such a turn w about a point p moves by p x w.
    """
    axis_T = traverse.rig.pan_T_tilt
    pan = pan_tilt_rad[:, 0]
    axis_R, axis_t = axis_T.rotation().matrix(), axis_T.translation()
    pan_R = pan_tilt_rotation(pan, np.zeros_like(pan))
    turn, place = -(pan_R @ axis_R[:, 1]), pan_R @ axis_t
    twists = np.zeros((len(pan), 6, 2))
    twists[:, 2, 0] = 1.0
    twists[:, :3, 1] = turn
    twists[:, 3:, 1] = np.cross(place, turn)
    return twists
