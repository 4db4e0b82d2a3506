"""Warnings of images, frames and stops that observations do not connect."""

from collections.abc import Sequence

import numpy as np
import scipy

from pancam_graph.base.geometry import IntArray
from pancam_graph.data import FrameSeen, Traverse
from pancam_graph.landmarks import kernel

__all__ = ["components", "connection_warnings", "listed", "shared_landmarks"]

_NAMED = 6


def components(n_members: int, member: IntArray, landmark: IntArray) -> tuple[int, IntArray]:
    """Connected groups of members (images, frames or stops); common landmarks connect members.

    `member` and `landmark` (n,) are the rows of each observation. Returns the number of groups, and the group
    of each member (members,).
    """
    leader = np.arange(n_members)
    first = np.full(int(landmark.max()) + 1 if len(landmark) else 0, -1)
    kernel.connect(member, landmark, first, leader)
    names, group = np.unique(leader, return_inverse=True)
    return len(names), group


def shared_landmarks(
    shape: tuple[int, int], member: IntArray, landmark: IntArray
) -> "scipy.sparse.csr_array":
    """Number of landmarks (members, members) that each two members (images, frames or stops) see.

    `member` and `landmark` (n,) are the rows of each observation; `shape` is (members, landmarks).
    """
    sees = scipy.sparse.coo_array((np.ones(len(member)), (member, landmark)), shape=shape).tocsr()
    sees.data[:] = 1  # a member sees a landmark once, with however many eyes
    return scipy.sparse.csr_array(sees @ sees.T)


def connection_warnings(traverse: Traverse, image: IntArray, landmark: IntArray) -> list[str]:
    """Warnings of images without observations, separate groups of frames, and stops that nothing connects.

    `image` and `landmark` (n,) are the rows of each observation in use.
    """
    warnings: list[str] = []
    count = np.bincount(image, minlength=len(traverse.images))
    told = {traverse.image_of(one) for one in traverse.constraints if isinstance(one, FrameSeen)}
    empty = [traverse.images[i].id for i in np.flatnonzero(count == 0).tolist() if i not in told]
    if empty:
        warnings.append(
            f"{_number(empty, 'image')} without a used observation: {_names(empty)}; "
            "only telemetry tells where they point"
        )

    # The rig connects the eyes of a frame, so groups consist of frames.
    frame_of = traverse.image_frame
    n, group = components(len(traverse.frames), frame_of[image], landmark)
    seen = np.bincount(frame_of, count, minlength=len(traverse.frames)) > 0
    groups = [np.flatnonzero((group == g) & seen) for g in range(n)]
    groups = sorted((g for g in groups if len(g)), key=lambda g: int(g[0]))
    if len(groups) > 1:
        listed = "; ".join(
            f"({i}) {_names([traverse.frames[f].id for f in g])}"
            for i, g in enumerate(groups[:_NAMED], start=1)
        )
        rest = f"; and {len(groups) - _NAMED} more" if len(groups) > _NAMED else ""
        warnings.append(
            f"{len(groups)} groups of frames share no track: {listed}{rest}; "
            "between them only telemetry joins the panorama"
        )
    if len(traverse.stops) > 1:
        # Frames of a group are connected, and a stop connects its own.
        _, stop_group = components(len(traverse.stops), traverse.frame_stop[seen], group[seen])
        size = np.bincount(stop_group)
        alone = [traverse.stops[s].id for s in np.flatnonzero(size[stop_group] == 1)]
        if alone:
            warnings.append(
                f"{_number(alone, 'stop')} that no track connects to another: {_names(alone)}; "
                "their place is what odometry says"
            )
    return warnings


def listed(names: Sequence[str], what: str) -> str:
    """Number of names and the first few of them, for example "2 tracks (4, 7)"."""
    return f"{_number(names, what)} ({_names(names)})"


def _number(names: Sequence[str], what: str) -> str:
    return f"{len(names)} {what}{'s' if len(names) != 1 else ''}"


def _names(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_NAMED])
    return shown if len(names) <= _NAMED else f"{shown} and {len(names) - _NAMED} more"
