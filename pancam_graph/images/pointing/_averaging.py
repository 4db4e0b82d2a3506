"""Rotations of pictures from the turns between pairs of them."""

from collections.abc import Sequence

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray, so3_exp, so3_log

__all__ = ["averaged", "groups_of"]

_SCALES_RAD = (0.5, 0.25, 0.12, 0.06, 0.03, 0.03)
"""Scales of the Cauchy weights, from what a ring that does not close yet leaves to what parallax does."""
_STEPS = 8


def groups_of(pairs: Sequence[tuple[int, int]], count: int) -> list[list[int]]:
    """Numbers below `count` that pairs join, the largest group first; of equal ones that with the lowest."""
    of = list(range(count))
    for a, b in pairs:
        low, high = sorted((of[a], of[b]))
        of = [low if group == high else group for group in of]
    groups = [[i for i in range(count) if of[i] == group] for group in dict.fromkeys(of)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


def averaged(pairs: IntArray, b_R_a: FloatArray, weight: FloatArray, count: int) -> FloatArray:
    """Rotations `world_R_camera` (count, 3, 3) that agree best with turns of pairs (n, 2); the first is I.

    `b_R_a` (n, 3, 3) takes directions of the first picture of a pair to its second, `weight` (n,) are their
    weights. All pictures must be joined. From the strongest tree the rotations are moved by weighted least
    squares, in which turns that disagree lose weight (Chatterjee and Govindu, ICCV 2013).
    """
    rotation = _by_tree(pairs, b_R_a, weight, count)
    a, b = pairs.T
    for scale in _SCALES_RAD:
        for _ in range(_STEPS):
            # world_R_b b_R_a should be world_R_a; rotations move by Exp(w) on the left.
            off = so3_log(rotation[b] @ b_R_a @ np.swapaxes(rotation[a], 1, 2))
            robust = weight / (1 + np.einsum("ni,ni->n", off, off) / scale**2)
            moves = np.zeros((count, count))
            np.add.at(moves, (a, a), robust)
            np.add.at(moves, (b, b), robust)
            np.add.at(moves, (a, b), -robust)
            np.add.at(moves, (b, a), -robust)
            wanted = np.zeros((count, 3))
            np.add.at(wanted, a, robust[:, None] * off)
            np.add.at(wanted, b, -robust[:, None] * off)
            step = np.zeros((count, 3))
            step[1:] = np.linalg.solve(moves[1:, 1:], wanted[1:])
            rotation = so3_exp(step) @ rotation
            if np.abs(step).max() < 1e-10:
                break
    return rotation


def _by_tree(pairs: IntArray, b_R_a: FloatArray, weight: FloatArray, count: int) -> FloatArray:
    """Rotations along the tree of the heaviest pairs, from the first picture on."""
    rotation = np.tile(np.eye(3), (count, 1, 1))
    reached = np.zeros(count, dtype=bool)
    reached[0] = True
    while not reached.all():
        leads = np.flatnonzero(reached[pairs[:, 0]] != reached[pairs[:, 1]])
        heaviest = leads[np.argmax(weight[leads])]
        a, b = pairs[heaviest]
        if reached[a]:
            rotation[b] = rotation[a] @ b_R_a[heaviest].T
        else:
            rotation[a] = rotation[b] @ b_R_a[heaviest]
        reached[[a, b]] = True
    return rotation
