"""Pointing of frames that lost their links to others, found again from what these see.

Where telemetry has a frame's pan or tilt wrong, its observations look like outliers, and without them nothing
corrects the pointing. Here each observation of a point that other frames place says, alone, which pan and
tilt would make it fit. Right observations agree on these; wrong ones scatter over the image.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, compose, pose_arrays, wrap_angle
from pancam_graph.data import State
from pancam_graph.graph import LetGo
from pancam_graph.landmarks import Measurements, rays_of
from pancam_graph.solve._chances import CHANCE, two_sided_limit
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._rejection import Snooping, snoop
from pancam_graph.solve._share_tests import InUse

__all__ = ["pointing_again"]

_LOG = logging.getLogger(__name__)

_LOST = 0.8
"""Part of the usual share of links below which a frame is looked at ..."""
_BY_CHANCE = 0.01
"""... unless chance explains it with this probability or more."""
_LEAST = 4
"""Fewest links of a frame that is looked at, and fewest observations that agree on its pointing."""
_MORE = 1.25
"""A pointing found again must keep this many times the links that the frame has, and ..."""
_SOME = 3
"""... so many more."""
_SPREAD = 3.0
"""Observations agree within this many times the cutoff: the points have errors of their own."""
_MOST_VOTES = 1000
"""Observations of a frame that are asked."""
_WIDER = 3.0
"""Sigma that a wrong pan or tilt is let go to, in units of its correction."""
_STEPS = 8
"""Newton's steps for one observation; from 30 degrees off, five are enough."""
_LONGEST_RAD = 0.3
"""Longest of these steps."""
_NEAREST_M = 1e-9
"""Least distance of a point from a camera."""
_FURTHEST_M = 1e6
"""Where points at infinity are placed."""


def pointing_again(problem: Problem, banned: BoolArray, *, cutoff_sigma: float, scale: float) -> Problem:
    """The problem with frames turned to where more of their links agree; the same object where there is none.

    `banned` (n,) are measurements never to be accepted; `cutoff_sigma` and `scale` as for `snoop`. Of a pan
    or tilt that is turned by more than its sigma explains, the prior is let go.
    """
    for frame in _suspects(problem):
        found = _Frame(problem, frame, banned, cutoff_sigma, scale).turned()
        if found is not None:
            problem = found
    return problem


def _suspects(problem: Problem) -> IntArray:
    """Frames whose pan and tilt are free and that lost links beyond chance, the worst first."""
    t = problem.template.traverse
    if len(t.frames) < 2:
        return np.zeros(0, dtype=np.int64)
    links = InUse.links(problem, t.image_frame, len(t.frames))
    n, used = links.n, links.used
    if np.array_equal(n, used):
        return np.zeros(0, dtype=np.int64)
    is_free = np.array([(f.sigmas_rad > 0).all() for f in t.frames], dtype=bool)
    lost = (
        is_free
        & (n >= _LEAST)
        & (used < _LOST * links.usual * n)
        & (links.chance(np.arange(len(n))) < _BY_CHANCE)
    )
    rows = np.flatnonzero(lost)
    return np.asarray(rows[np.argsort(used[rows] / n[rows], kind="stable")])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Votes:
    """What each of n observations of a frame says of its pan and tilt."""

    pan_tilt_rad: FloatArray
    """(n, 2)"""
    radius_rad: float
    """Distance within which right ones agree."""

    def agreed(self) -> FloatArray | None:
        """The pan and tilt (2,) that most agree on; None if too few do."""
        if len(self.pan_tilt_rad) < _LEAST:
            return None
        # Angles on the sky: a degree of pan is less of an angle where the head looks up or down.
        flat = self.pan_tilt_rad * np.array([np.cos(np.median(self.pan_tilt_rad[:, 1])).clip(0.1), 1.0])
        near = scipy.spatial.cKDTree(flat).query_ball_point(flat, self.radius_rad)
        best = max(near, key=len)
        if len(best) < _LEAST:
            return None
        return np.asarray(np.median(self.pan_tilt_rad[best], axis=0))


class _Frame:
    """One frame, the points that others place for it, and how many of its links agree."""

    def __init__(
        self, problem: Problem, frame: int, banned: BoolArray, cutoff_sigma: float, scale: float
    ) -> None:
        self._problem, self._frame = problem, frame
        self._cutoff, self._scale = cutoff_sigma, scale
        m, t = problem.measurements, problem.template.traverse
        mine = (t.image_frame[m.image] == frame) & ~banned
        seen = np.bincount(m.landmark, mine, minlength=m.n_landmarks) > 0
        self._rows = np.flatnonzero(seen[m.landmark] & ~banned)
        """Measurements of the landmarks that the frame sees."""
        self._mine = mine[self._rows]

    def turned(self) -> Problem | None:
        """The problem with the frame turned; None where no other pointing agrees clearly better."""
        votes = self._votes()
        pan_tilt = None if votes is None else votes.agreed()
        if pan_tilt is None:
            return None
        there = _with_pointing(self._problem, self._frame, pan_tilt)
        before, after = self._links(self._problem), self._links(there)
        if after < max(_MORE * before, before + _SOME):
            return None
        t = there.template.traverse
        moved = np.asarray(wrap_angle(pan_tilt - t.pan_tilt_rad[self._frame]))
        _LOG.info(
            "screening: %s turned by %.3g and %.3g degrees from telemetry: %d of its links agree, not %d",
            t.frames[self._frame].id,
            *np.degrees(moved),
            after,
            before,
        )
        stated = t.frames[self._frame].sigmas_rad
        is_wrong = np.abs(moved) > two_sided_limit(2 * len(t.frames), CHANCE) * stated
        let_go = LetGo.nothing(t)
        let_go.angles_rad[self._frame] = np.where(is_wrong, _WIDER * np.abs(moved), 0.0)
        return there.letting_go(there.template.let_go + let_go) if let_go else there

    def _links(self, problem: Problem) -> int:
        """Landmarks that the frame and another both keep."""
        part, snooping = self._snooped(problem, self._rows)
        of_frame, of_others = (
            np.bincount(part.landmark, snooping.accepted & rows, minlength=part.n_landmarks) > 0
            for rows in (self._mine, ~self._mine)
        )
        return int(np.sum(of_frame & of_others))

    def _snooped(self, problem: Problem, rows: IntArray) -> tuple[Measurements, Snooping]:
        """Some measurements judged with the cameras held, all accepted at first."""
        part = problem.measurements.part(rows)
        return part, snoop(
            problem.landmarks.of(np.unique(problem.measurements.landmark[rows])),
            part,
            problem.views,
            np.ones(len(rows), dtype=bool),
            cutoff_sigma=self._cutoff,
            min_scale=self._scale,
            scale=self._scale,
        )

    def _votes(self) -> _Votes | None:
        """What each observation of a point that others place says of the pointing; None if there are few."""
        problem, m = self._problem, self._problem.measurements
        others = self._rows[~self._mine]
        others = others[np.bincount(m.landmark[others], minlength=m.n_landmarks)[m.landmark[others]] >= 2]
        if len(others) == 0:
            return None
        part, placed = self._snooped(problem, others)
        is_placed = np.bincount(part.landmark, placed.accepted, minlength=part.n_landmarks) >= 2
        of = np.full(m.n_landmarks, -1)
        of[np.unique(m.landmark[others])[is_placed]] = np.flatnonzero(is_placed)
        rows = self._rows[self._mine]
        rows = rows[of[m.landmark[rows]] >= 0]
        if len(rows) < _LEAST:
            return None
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _MOST_VOTES)).astype(np.int64)]
        points_m = placed.landmarks.points_m(np.full(part.n_landmarks, _FURTHEST_M))
        focal_px = float(np.median(problem.views.calibration[m.image[rows], 0, 0]))
        return _Votes(
            pan_tilt_rad=self._pointings(rows, points_m[of[m.landmark[rows]]]),
            radius_rad=_SPREAD * self._cutoff * self._scale * m.typical_sigma_px / focal_px,
        )

    def _pointings(self, rows: IntArray, points_m: FloatArray) -> FloatArray:
        """Pan and tilt (n, 2) with which measurements (n,) see their points (n, 3), one by one (Newton)."""
        problem, n = self._problem, len(rows)
        m, views, t = problem.measurements, problem.views, problem.template.traverse
        image = m.image[rows]
        mast = pose_arrays([problem.template.masts(problem.values)[int(t.frame_stop[self._frame])]])
        now = problem.template.state(problem.values, np.zeros((0, 3)), views).pan_tilt_rad[self._frame]
        # Mounts as they are in the estimate, flex included.
        head_R, head_t = compose(mast[0][0], mast[1][0], *t.rig.mast_T_head(now[:1], now[1:]))
        mount_R = head_R[0].T @ views.world_R_camera[image]
        mount_t = (views.world_t_camera[image] - head_t[0]) @ head_R[0]
        _, direction = rays_of(m.part(rows), views)
        ray = np.einsum("nij,ni->nj", views.world_R_camera[image], direction)
        across = _across(ray)
        in_mast = (points_m - mast[1][0]) @ mast[0][0]

        def missed(angles: FloatArray) -> FloatArray:
            """Sines (n, 2) of the angles by which the cameras miss their points."""
            head = t.rig.mast_T_head(angles[:, 0], angles[:, 1])
            R, centre = compose(*head, mount_R, mount_t)
            there = np.einsum("nij,ni->nj", R, in_mast - centre)
            there /= np.linalg.norm(there, axis=1, keepdims=True).clip(_NEAREST_M)
            return np.asarray(np.einsum("nij,nj->ni", across, there))

        angles, small = np.tile(now, (n, 1)), 1e-5
        for _ in range(_STEPS):
            miss = missed(angles)
            J = np.stack([(missed(angles + small * e) - miss) / small for e in np.eye(2)], axis=2)
            step = np.linalg.pinv(J, rcond=1e-3) @ miss[:, :, None]
            angles -= step[:, :, 0].clip(-_LONGEST_RAD, _LONGEST_RAD)
        return np.asarray(angles)


def _across(ray: FloatArray) -> FloatArray:
    """Two unit vectors (n, 2, 3) across each ray (n, 3) of a camera, which looks along z."""
    first = np.cross(ray, np.broadcast_to([0.0, 1.0, 0.0], ray.shape))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(ray, first)], axis=1)


def _with_pointing(problem: Problem, frame: int, pan_tilt_rad: FloatArray) -> Problem:
    """The problem with a frame's head turned, and its cameras with it."""
    template, t = problem.template, problem.template.traverse
    state: State = template.state(problem.values, np.zeros((0, 3)), problem.views)
    angles = state.pan_tilt_rad.copy()
    angles[frame] = pan_tilt_rad
    images = np.flatnonzero(t.image_frame == frame)
    rotations, centres = state.world_R_camera.copy(), state.world_t_camera.copy()
    nominal = t.camera_poses(state.world_T_mast, angles)
    rotations[images], centres[images] = nominal[0][images], nominal[1][images]
    moved = replace(state, pan_tilt_rad=angles, world_R_camera=rotations, world_t_camera=centres)
    return replace(problem, values=template.values(moved))
