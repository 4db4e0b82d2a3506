"""Directions that cameras do not determine, in words: exact ambiguities of the chain first, then the rest."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray, correction_twists, pan_tilt_rotation, twists_in_parent
from pancam_graph.rigs.fit._solve import Optimum
from pancam_graph.rigs.fit._system import Equations

__all__ = ["FreeDirection", "free_directions"]

_INDEPENDENT = 0.01
"""Least new part of a direction of length 1 that makes it independent of those before; small, as the axis
with its small sigma has the largest part in most ambiguities."""
_SHOWN = 0.15
"""Components smaller than this share of the largest are not named."""

_BY_PAN = "undone by pan_T_tilt"
_BY_TILT = "undone by every head_T_camera"
_MAST_AND_AXIS = (
    (2, f"zero point of pan: a turn of the mast about the pan axis, {_BY_PAN}"),
    (5, f"height: a shift of the mast along the pan axis, {_BY_PAN}"),
    (0, f"direction of the pan axis: a turn of the mast about its x, {_BY_PAN} (pans as good as equal)"),
    (1, f"direction of the pan axis: a turn of the mast about its y, {_BY_PAN} (pans as good as equal)"),
    (3, f"place of the pan axis: a shift of the mast along its x, {_BY_PAN} (pans as good as equal)"),
    (4, f"place of the pan axis: a shift of the mast along its y, {_BY_PAN} (pans as good as equal)"),
)
_AXIS_AND_MOUNTS = (
    (1, f"zero point of tilt: a turn of pan_T_tilt about the tilt axis, {_BY_TILT}"),
    (4, f"place along the tilt axis: a shift of pan_T_tilt along it, {_BY_TILT}"),
    (0, f"direction of the tilt axis: a turn of pan_T_tilt about its x, {_BY_TILT} (tilts as good as equal)"),
    (2, f"direction of the tilt axis: a turn of pan_T_tilt about its z, {_BY_TILT} (tilts as good as equal)"),
    (3, f"place of the tilt axis: a shift of pan_T_tilt along its x, {_BY_TILT} (tilts as good as equal)"),
    (5, f"place of the tilt axis: a shift of pan_T_tilt along its z, {_BY_TILT} (tilts as good as equal)"),
)
_OFFSETS = (
    (0, 2, -1.0, "offset of pan: undone by a turn of the mast about the pan axis"),
    (1, 7, 1.0, "offset of tilt: undone by a turn of pan_T_tilt about the tilt axis"),
)
"""Offset, the pose component that undoes it (as the chain counts them), its sign, words."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeDirection:
    """A direction in which the chain can move without a change of the cameras."""

    text: str
    """The number that moves, and the one that compensates for it."""
    step: FloatArray
    """(numbers,) how each number of `RigFit.names` moves along it, radians and metres; in the units of the
    reference's sigmas it has length 1."""


def free_directions(equations: Equations, optimum: Optimum) -> tuple[FreeDirection, ...]:
    """The free directions at the optimum, as many as there are, each independent of the others.

    Directions that are free for reasons of the chain alone (or of equal pans or tilts) are named. Other
    free directions, which exist with few cameras, are described by their largest components.
    """
    sought, sigma = equations.unknowns.sought, equations.unknowns.sigma
    jacobian, free = optimum.system.jacobian, optimum.directions[optimum.rank :]
    directions: list[FreeDirection] = []
    basis = np.zeros((len(free), 0))

    def accept(text: str, in_units: FloatArray) -> None:
        nonlocal basis
        inside = free @ in_units
        rest = inside - basis @ (basis.T @ inside)
        if np.linalg.norm(rest) > _INDEPENDENT:
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
            step = np.zeros(len(sigma))
            step[sought] = sigma[sought] * in_units
            directions.append(FreeDirection(text=text, step=step))

    for text, step in _ambiguities(equations, optimum):
        if np.any(step[~sought] != 0):  # a held number cannot compensate for another
            continue
        in_units = step[sought] / sigma[sought]
        in_units /= np.linalg.norm(in_units)
        if np.linalg.norm(jacobian @ in_units) < 1:
            accept(text, in_units)
    while basis.shape[1] < len(free):
        left = free.T @ (np.eye(len(free)) - basis @ basis.T)
        direction = left[:, np.argmax(np.linalg.norm(left, axis=0))]
        direction = direction / np.linalg.norm(direction)
        accept(_described(equations, direction), direction)
    return tuple(directions)


def _ambiguities(equations: Equations, optimum: Optimum) -> list[tuple[str, FloatArray]]:
    """Steps (numbers,) that do not move the cameras: at all angles, at one pan, or at one tilt."""
    chain, angles = equations.chain(optimum.place), equations.pan_tilt_rad(optimum.place)
    # In body-frame twists first; they are turned to corrections below.
    twists: list[tuple[str, FloatArray, FloatArray]] = []
    n_poses, none = len(chain.rotation), np.zeros(2)
    pan, tilt = (float(np.angle(np.exp(1j * a).mean())) for a in angles.T)
    for component, text in _MAST_AND_AXIS:
        twist = np.zeros((n_poses, 6))
        twist[0, component] = 1.0
        at_axis = _carried(pan_tilt_rotation(pan, 0.0).T, np.zeros(3), twist[0])
        twist[1] = -_carried(*_inverse(*chain.axis), at_axis)
        twists.append((text, twist, none))
    for component, text in _AXIS_AND_MOUNTS:
        twist = np.zeros((n_poses, 6))
        twist[1, component] = 1.0
        at_head = _carried(pan_tilt_rotation(0.0, tilt).T, np.zeros(3), twist[1])
        for eye in range(n_poses - 2):
            twist[2 + eye] = -_carried(*_inverse(chain.mounts[0][eye], chain.mounts[1][eye]), at_head)
        twists.append((text, twist, none))
    for offset, component, sign, text in _OFFSETS:
        twist = np.zeros((n_poses, 6))
        twist.flat[component] = sign
        twists.append((text, twist, np.eye(2)[offset]))
    by_correction = correction_twists(optimum.place.unknowns[:-2].reshape(-1, 6))
    return [
        (text, np.concatenate([np.linalg.solve(by_correction, twist[..., None]).ravel(), offsets]))
        for text, twist, offsets in twists
    ]


def _carried(a_R_b: FloatArray, a_t_b: FloatArray, twist: FloatArray) -> FloatArray:
    return np.asarray(twists_in_parent(a_R_b, a_t_b, twist[:, None])[:, 0])


def _inverse(rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray]:
    return rotation.T, -rotation.T @ translation


def _described(equations: Equations, in_units: FloatArray) -> str:
    names = np.array(equations.unknowns.names)[equations.unknowns.sought]
    order = np.argsort(-np.abs(in_units), kind="stable")
    largest = [i for i in order if abs(in_units[i]) > _SHOWN * abs(in_units[order[0]])]
    sign = np.sign(in_units[order[0]])
    parts = (f"{sign * in_units[i]:+.2f} {names[i]}" for i in largest)
    return f"a combination, in sigmas of the reference: {', '.join(parts)}"
