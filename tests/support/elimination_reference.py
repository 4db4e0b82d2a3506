"""Dense least squares with all landmarks in NumPy, which elimination must equal."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.elimination import Panels
from pancam_graph.landmarks import CameraViews, Landmarks, Loss, Measurements
from support import landmark_reference as reference


def whitened(
    landmarks: Landmarks, m: Measurements, views: CameraViews
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Residuals (n, 2), their derivatives (n, 2, 4) by the landmark's vector, whether in front (n,)."""
    i, j = m.image, m.landmark
    to_pixel = views.calibration[i] @ views.world_R_camera[i].transpose(0, 2, 1)
    offset = (landmarks.origin_m[j] - views.world_t_camera[i])[:, :, None]
    projection = to_pixel @ np.concatenate([np.broadcast_to(np.eye(3), (len(i), 3, 3)), offset], axis=2)
    h = np.einsum("nij,nj->ni", projection, landmarks.vector[j])
    uv = h[:, :2] / h[:, 2:]
    d_vector = (projection[:, :2] - uv[:, :, None] * projection[:, 2:]) / h[:, 2:, None]
    off = uv - m.uv_px
    if views.fields is not None:
        off = off + views.fields.at(i, m.uv_px)
    return np.einsum("nij,nj->ni", m.whitening, off), m.whitening @ d_vector, h[:, 2] > 0


@dataclass(frozen=True)
class Dense:
    """The whole least-squares system, cameras (columns of A) and landmarks (columns of B)."""

    A: FloatArray
    B: FloatArray
    r: FloatArray
    landmarks: Landmarks
    tangents: FloatArray

    @property
    def inverse(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.B.T @ self.B))

    @property
    def reduced(self) -> tuple[FloatArray, FloatArray]:
        """S = A'A - E V^-1 E', s = A'r - E V^-1 g."""
        cross = self.A.T @ self.B @ self.inverse
        return self.A.T @ self.A - cross @ self.B.T @ self.A, self.A.T @ self.r - cross @ self.B.T @ self.r

    def followed(self, dx: FloatArray) -> Landmarks:
        """Landmarks after the joint step whose part of the cameras is dx."""
        dp = -self.inverse @ self.B.T @ (self.r + self.A @ dx)
        vector = self.landmarks.vector + np.einsum("jpk,jk->jp", self.tangents, dp.reshape(-1, 3))
        return replace(self.landmarks, vector=vector / np.linalg.norm(vector, axis=1, keepdims=True))


def dense_of(
    views_after: Callable[[FloatArray], CameraViews],
    n_columns: int,
    m: Measurements,
    landmarks: Landmarks,
    loss: Loss,
) -> Dense:
    """The system by fourth-order differences; `views_after` gives the cameras after a step (columns,)."""
    h, columns = 1e-4, []
    for unit in np.eye(n_columns):
        shifted = {k: whitened(landmarks, m, views_after(k * h * unit))[0].ravel() for k in (-2, -1, 1, 2)}
        columns.append((8 * (shifted[1] - shifted[-1]) - (shifted[2] - shifted[-2])) / (12 * h))
    r, d_vector, front = whitened(landmarks, m, views_after(np.zeros(n_columns)))
    tangents = np.array([reference.tangents(v) for v in landmarks.vector])
    B = np.zeros((2 * len(r), 3 * len(tangents)))
    for n, j in enumerate(m.landmark):
        B[2 * n : 2 * n + 2, 3 * j : 3 * j + 3] = d_vector[n] @ tangents[j]
    weight = reference.loss_weight(loss.name, loss.width, np.sum(r**2, axis=1)) * front
    root = np.repeat(np.sqrt(weight), 2)
    A = np.column_stack(columns)
    return Dense(A * root[:, None], B * root[:, None], r.ravel() * root, landmarks, tangents)


def true_cost(landmarks: Landmarks, m: Measurements, views: CameraViews, loss: Loss) -> float:
    r, _, front = whitened(landmarks, m, views)
    cost = reference.loss_cost(loss.name, loss.width, np.sum(r**2, axis=1))
    return float(np.where(front, cost, 0.5 * 1000.0**2).sum())


def whole(panels: Panels) -> tuple[FloatArray, FloatArray]:
    """Dense (S, s) of panels, columns by group."""
    st = panels.structure
    begin = np.concatenate([[0], np.cumsum(st.dim)])
    S, s = np.zeros((begin[-1], begin[-1])), np.zeros(begin[-1])
    for g, panel in enumerate(panels.panel):
        rows = slice(begin[g], begin[g + 1])
        s[rows] = panel[:, -1]
        for h, first, last in zip(st.after[g], st.begin[g][:-1], st.begin[g][1:], strict=True):
            block = panel[:, first:last]
            S[rows, begin[h] : begin[h + 1]] = np.triu(block) if h == g else block
    # The diagonal is infinite in held columns, so it is not taken off again.
    beside = np.triu(S, 1) + np.tril(S, -1)
    return beside + beside.T + np.diag(np.diag(S)), s


def assert_systems_agree(S: FloatArray, s: FloatArray, expected: Dense, *, tolerance: float = 1e-8) -> None:
    """Assert that two reduced systems agree, relative to the norms of the cameras' columns."""
    S_expected, s_expected = expected.reduced
    size = np.linalg.norm(expected.A, axis=0).clip(1.0)  # an image without observations has none
    assert np.abs((S - S_expected) / np.outer(size, size)).max() < tolerance
    length = np.linalg.norm(expected.r)
    assert np.abs((s - s_expected) / size).max() < tolerance * length + 1e-9
