"""Covariances that differences make: of a relative pose, and along a road whose groups hold each other."""

import gtsam
import numpy as np

from pancam_graph.elimination import Panels, pattern, relative_pose_covariance


def test_covariance_of_a_relative_pose_is_that_of_samples() -> None:
    rng = np.random.default_rng(2)
    a, b = (gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(2))
    half = 1e-3 * rng.normal(size=(12, 12))
    steps = rng.normal(size=(40_000, 12)) @ half.T
    relative = a.between(b)
    moved = np.array(
        [relative.localCoordinates(a.retract(step[:6]).between(b.retract(step[6:]))) for step in steps]
    )
    expected = relative_pose_covariance(a, b, half @ half.T)
    size = np.sqrt(np.diag(expected))
    assert np.abs((moved.T @ moved / len(moved) - expected) / np.outer(size, size)).max() < 0.03


def test_covariances_of_a_long_road_keep_their_digits() -> None:
    # Fifth differences are told a million times better than values: each covariance of a group is what is
    # left of large numbers of the groups after it.
    n, dim, coefficients = 150, 2, [1.0, -5.0, 10.0, -10.0, 5.0, -1.0]
    width = len(coefficients)
    panels = Panels(pattern(np.full(n, dim), [range(i, i + width) for i in range(n - width + 1)]))
    for g in range(n):
        panels.add_block(g, slice(0, dim), g, slice(0, dim), np.eye(dim))
    for i in range(n - width + 1):
        groups = panels.sorted(range(i, i + width))
        rows = np.kron([coefficients[g - i] for g in groups], 1e6 * np.eye(dim))
        panels.add(groups, rows.T @ rows, np.zeros(width * dim))
    root = panels.root()
    covariance = root.covariance()
    for g in range(0, n, 7):
        own = root.inverse_columns(g, slice(0, dim))[dim * g : dim * (g + 1)]
        np.testing.assert_allclose(np.diag(covariance.block(g, g)), np.diag(own), rtol=1e-8)
