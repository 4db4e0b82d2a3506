"""Uncertainties of poses and angles, landmarks marginalised."""

import gtsam
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_array, csc_array

from pancam_graph.errors import SolveError
from pancam_graph.factors import Key
from pancam_graph.geometry import FloatArray, IntArray
from pancam_graph.graph import FactorTemplate
from pancam_graph.solution import State

__all__ = ["covariances"]

_DIMENSION = {"A": 2, "L": 3, "M": 6, "R": 1, "X": 6}


def covariances(
    template: FactorTemplate, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, state: State
) -> tuple[FloatArray, FloatArray]:
    """Covariance of each stop (stops, 6, 6) and sigmas of pan and tilt (frames, 2); 0 where held.

    Formal: from the linearised system at the solution, taking noise models at their word. Raises SolveError
    where a direction is held by nothing.
    """
    t = template.traverse
    stops = np.zeros((len(t.stops), 6, 6))
    sigma = np.zeros((len(t.frames), 2))
    joint = _JointCovariance(graph, values, template.held_components())
    for i in range(len(t.stops)):
        if isinstance(slot := template.mast(i), Key):
            stops[i] = joint.block(slot.key, slot.key)
    if template.model != "mast":
        return stops, _pointing_sigma(template, joint, state)
    for i in range(len(t.frames)):
        if isinstance(slot := template.pan_tilt(i), Key):
            sigma[i] = np.sqrt(np.diag(joint.block(slot.key, slot.key)))
    return stops, sigma


class _JointCovariance:
    """Covariance of everything but the landmarks, which are marginalised by their own 3 x 3 blocks."""

    def __init__(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, held: dict[int, IntArray]
    ) -> None:
        keys = sorted(values.keys())
        dims = np.array([_DIMENSION[chr(gtsam.symbolChr(key))] for key in keys])
        landmark = np.repeat([chr(gtsam.symbolChr(key)) == "L" for key in keys], dims)
        row, column, entry = graph.linearize(values).sparseJacobian_()
        # GTSAM counts from 1, and appends the right-hand side as a last column.
        shape = (int(row.max()), int(dims.sum()) + 1)
        jacobian = csc_array((entry, (row.astype(int) - 1, column.astype(int) - 1)), shape=shape)[:, :-1]
        points, rest = jacobian[:, landmark], jacobian[:, ~landmark]
        weighted = points @ _inverse_of_blocks((points.T @ points).tobsr((3, 3)))
        information = (rest.T @ rest - (weighted.T @ rest).T @ (points.T @ rest)).toarray()
        self.rows: dict[int, IntArray] = {}
        free = np.ones(len(information), dtype=bool)
        end = 0
        for key, dim in zip(keys, dims, strict=True):
            if chr(gtsam.symbolChr(key)) != "L":
                self.rows[key] = np.arange(end, end + dim)
                free[end + held.get(key, np.zeros(0, dtype=np.int64))] = False
                end += dim
        self.matrix: FloatArray = np.zeros_like(information)
        self.matrix[np.ix_(free, free)] = _inverse(information[np.ix_(free, free)])

    def block(self, a: int, b: int) -> FloatArray:
        """Covariance of two variables."""
        return self.matrix[np.ix_(self.rows[a], self.rows[b])]


def _inverse(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix, unit diagonal first: radians and metres differ by much."""
    scale = 1 / np.sqrt(np.diag(information).clip(1e-300))
    try:
        half = cho_factor(information * scale[:, None] * scale, lower=True)
    except (np.linalg.LinAlgError, ValueError) as error:  # not positive, not finite
        raise SolveError(f"covariances: nothing holds a direction of the solution: {error}") from error
    return np.asarray(cho_solve(half, np.diag(scale)) * scale[:, None])


def _pointing_sigma(template: FactorTemplate, joint: _JointCovariance, state: State) -> FloatArray:
    """Sigmas of pan and tilt as a frame's camera poses give them, as the mean over its eyes."""
    t = template.traverse
    variance = np.zeros((len(t.frames), 2))
    for frame in range(len(t.frames)):
        images = np.flatnonzero(t.image_frame == frame)
        if len(images) == 0:
            continue
        stop = int(t.frame_stop[frame])
        mast_R = state.world_T_mast[stop].rotation().matrix()
        pan, tilt = state.pan_tilt_rad[frame]
        # A small turn w of the head, in the mast frame, moves pan by d_pan w and tilt by d_tilt w.
        d_pan = np.array([-np.cos(pan) * np.tan(tilt), -np.sin(pan) * np.tan(tilt), 1.0])
        d_tilt = np.array([np.sin(pan), -np.cos(pan), 0.0])
        d_angles = np.vstack([d_pan, d_tilt])
        rows = [joint.rows[template.camera_key(int(i))][:3] for i in images]
        blocks = [d_angles @ mast_R.T @ state.world_R_camera[i] / len(images) for i in images]
        if isinstance(slot := template.mast(stop), Key):
            rows.append(joint.rows[slot.key][:3])
            blocks.append(-d_angles)
        jacobian, row = np.concatenate(blocks, axis=1), np.concatenate(rows)
        variance[frame] = np.diag(jacobian @ joint.matrix[np.ix_(row, row)] @ jacobian.T)
    return np.sqrt(variance)


def _inverse_of_blocks(matrix: bsr_array) -> bsr_array:
    """Inverse of a block-diagonal information matrix of landmarks.

    A direction that the rays leave free has next to no information and no say in the poses, whatever its
    inverse; its eigenvalue is floored so that rounding does not speak instead.
    """
    matrix.sort_indices()
    values, vectors = np.linalg.eigh(matrix.data)
    values = values.clip(1e-15 * values[:, -1:] + 1e-300)
    inverse = vectors @ (vectors.transpose(0, 2, 1) / values[:, :, None])
    return bsr_array((inverse, matrix.indices, matrix.indptr), shape=matrix.shape)
