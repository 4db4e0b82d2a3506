"""Points that two eyes of a frame see behind them, as in mirrored images or with swapped eyes."""

from collections.abc import Iterator

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import Traverse, VerdictTest

__all__ = ["points_behind"]

_IN_USE = 0.7
"""Share of observations in use from which points are not looked at: mirrored images leave a third."""
_IN_ONE_PLANE_PX = 3.0
"""Distance of a sight from the other eye's epipolar line up to which both see one point."""
_APART_PX = 5.0
"""Parallax from which it tells on which side two rays meet."""
_BEHIND = 0.05
"""Largest share of sights by two eyes that may meet behind them; wrong matches do in one of 300 by chance."""
_SIGHTS = 50
"""Sights by two eyes below which that is not tested."""


def points_behind(traverse: Traverse, share_in_use: float) -> Iterator[VerdictTest]:
    """That two eyes of a frame do not see points behind them; none where most observations are in use.

    Such sights are left out as outliers. Of wrong matches few lie on one epipolar line; where many do, and
    meet behind the cameras, the images are of another side than told.
    """
    if share_in_use >= _IN_USE:
        return
    first, second = _sights(traverse)
    if len(first) < _SIGHTS:
        return
    share = float(np.mean(_meet_behind(traverse, first, second)))
    says = f"of {len(first)} points that two eyes of a frame see, {share:.0%} lie behind them"
    yield VerdictTest.of(
        "points behind",
        share,
        _BEHIND,
        says,
        f"{says}, where their rays agree: images are mirrored, or the eyes are swapped; check the files and "
        "which camera each is of",
    )


def _sights(t: Traverse) -> tuple[IntArray, IntArray]:
    """Rows (n,), (n,) of the observations by which the two eyes of a frame see one point."""
    o = t.observations
    if o is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    key = o.track * len(t.frames) + t.image_frame[o.image]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    starts = starts[np.diff(starts, append=len(key)) == 2]
    return order[starts], order[starts + 1]


def _meet_behind(t: Traverse, first: IntArray, second: IntArray) -> FloatArray:
    """Whether the rays of two sights (n,) agree, and meet behind the cameras by more than noise tells."""
    direction, origin, pixel_rad = _in_head(t, np.concatenate([first, second]))
    a, b = np.split(direction, 2)
    apart = np.subtract(*np.split(origin, 2)[::-1])
    # With points at s a and r b from their eyes: s a - r b = apart, so s (a x b) = apart x b.
    plane, parallax = np.cross(apart, b), np.cross(a, b)
    off = np.abs(np.einsum("ni,ni->n", a, plane)) / np.linalg.norm(plane, axis=1).clip(1e-300)
    pixel = pixel_rad[: len(first)]
    agree = off < _IN_ONE_PLANE_PX * pixel
    clear = np.linalg.norm(parallax, axis=1) > _APART_PX * pixel
    return np.asarray(agree & clear & (np.einsum("ni,ni->n", plane, parallax) < 0))


def _in_head(t: Traverse, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Directions (n, 3) and origins (n, 3) of observations' rays in the head's frame, width of a pixel (n,).

    NaN where a pixel has no ray.
    """
    o = t.observations
    assert o is not None  # the caller has rows of them
    eye, uv = t.image_eye[o.image[rows]], o.uv_px[rows]
    direction, origin, pixel_rad = (
        np.full((len(rows), 3), np.nan),
        np.zeros((len(rows), 3)),
        np.zeros(len(rows)),
    )
    for e in np.unique(eye):
        of, mount = np.flatnonzero(eye == e), t.rig.eyes[e].head_T_camera
        camera, R = t.rig.eyes[e].camera, mount.rotation().matrix()
        rays = camera.unproject(uv[of])
        direction[of] = np.where(rays.valid[:, None], rays.direction, np.nan) @ R.T
        origin[of] = mount.translation() + rays.origin_m @ R.T
        pixel_rad[of] = 1 / camera.pinhole.calibration_matrix[0, 0]
    return direction, origin, pixel_rad
