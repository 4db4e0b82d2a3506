"""What must hold of a smoother's state, so that a drive can go on from it."""

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray
from pancam_graph.data import State, Traverse
from pancam_graph.graph import HardTemplate, Kind, kind_of
from pancam_graph.smoother._ledger import Fate
from pancam_graph.smoother._state import SmootherState

__all__ = ["require_consistent"]

_UNIT = 1e-6
"""Largest departure of landmarks from length 1, and of rotations from orthonormal ones."""
_FARTHEST_M = 1e9
"""Largest coordinate of a position; Mars is a hundred times smaller."""


def require_consistent(state: SmootherState) -> None:
    """Raise InputError naming the array for entries that are out of range or contradict each other."""
    _require_shapes(state)
    _require_order(state)
    _require_landmarks(state)
    _require_variables(state)


def _require(holds: bool | np.bool | BoolArray, name: str, expected: str) -> None:
    """Raise InputError where something does not hold of an array, with the first row of which it does not."""
    wrong = np.flatnonzero(~np.atleast_1d(holds))
    if len(wrong):
        row = f", row {wrong[0]}" if np.ndim(holds) else ""
        raise InputError(f"{name}{row}: expected {expected}, found something else")


def _require_shapes(state: SmootherState) -> None:
    observations = state.traverse.observations
    landmarks = state.track.size  # of a single value too, which has no length
    for name, shape in (
        ("after", (len(state.traverse.stops),)),
        ("fate", (0 if observations is None else len(observations),)),
        ("track", (landmarks,)),
        ("home", (landmarks,)),
        ("vector", (landmarks, 4)),
        ("origin_m", (landmarks, 3)),
        ("key", (state.key.size,)),
        ("width", (state.key.size,)),
        ("value", (state.value.size,)),
    ):
        found = getattr(state, name).shape
        if found != shape:
            raise InputError(f"{name}: expected shape {shape}, found {found}")


def _require_order(state: SmootherState) -> None:
    """Stops follow stops before them; frames, images and observations are those of stop after stop."""
    stops = np.arange(len(state.after))
    _require((state.after >= -1) & (state.after < stops), "after", "the number of a stop before, or -1")
    for name, stop in (("frames", state.traverse.frame_stop), ("images", state.traverse.image_stop)):
        _require(bool(np.all(np.diff(stop) >= 0)), f"traverse.{name}", "those of one stop after another")
    fates = [int(fate) for fate in Fate]
    _require(np.isin(state.fate, fates), "fate", f"a number from {min(fates)} to {max(fates)}")


def _require_landmarks(state: SmootherState) -> None:
    """Each track in use has one landmark, and each landmark at least two observations in use."""
    track, observations = state.track, state.traverse.observations
    used = state.fate == int(Fate.USED)
    seen = np.zeros(0, dtype=np.int64) if observations is None else observations.track[used]
    tracks, count = np.unique(seen, return_counts=True)
    _require(len(np.unique(track)) == len(track), "track", "different numbers")
    _require(np.isin(track, tracks[count >= 2]), "track", "a track with two observations in use or more")
    _require(bool(np.isin(tracks, track).all()), "track", "all tracks of observations in use")
    _require((state.home >= 0) & (state.home < len(state.after)), "home", "the number of a stop")
    length = np.linalg.norm(state.vector, axis=1)
    _require(np.abs(length - 1) < _UNIT, "vector", "a vector of length 1")  # which NaN has not
    _require((np.abs(state.origin_m) < _FARTHEST_M).all(axis=1), "origin_m", "a position in metres")


def _require_variables(state: SmootherState) -> None:
    """The variables are those of the drive, with as many numbers each as they have."""
    template = HardTemplate(state.traverse, state.options.sharing_of(state.traverse.rig))
    posed = template.values(_telemetry(state.traverse))
    wanted = {key: len(SmootherState.numbers(posed, key)) for key in posed.keys()}  # noqa: SIM118  not a dictionary
    _require(
        sorted(state.key.tolist()) == sorted(wanted),
        "key",
        f"the keys of the drive's {len(wanted)} variables",
    )
    _require(
        np.equal(state.width, [wanted[key] for key in state.key.tolist()]),
        "width",
        "as many as the variable has",
    )
    _require(len(state.value) == int(state.width.sum()), "value", f"{int(state.width.sum())} numbers")
    _require(np.abs(state.value) < _FARTHEST_M, "value", "a finite number")
    parts = np.split(state.value, np.cumsum(state.width)[:-1])
    for key, numbers in zip(state.key.tolist(), parts, strict=True):
        if kind_of(key) is Kind.MAST:
            rotation = numbers.reshape(3, 4)[:, :3]
            right = np.abs(rotation @ rotation.T - np.eye(3)).max() < _UNIT and np.linalg.det(rotation) > 0
            _require(bool(right), "value", "a rotation in each mast pose")


def _telemetry(traverse: Traverse) -> State:
    world_R_camera, world_t_camera = traverse.camera_poses()
    return State(
        world_T_mast=tuple(stop.world_T_mast for stop in traverse.stops),
        pan_tilt_rad=traverse.pan_tilt_rad,
        world_R_camera=world_R_camera,
        world_t_camera=world_t_camera,
        landmarks_m=np.zeros((0, 3)),
    )
