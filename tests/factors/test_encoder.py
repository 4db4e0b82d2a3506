"""Angles against their scaled readings: values written out, and Jacobians against differences."""

import gtsam
import numpy as np
import pytest

from pancam_graph.factors import Fixed, Key, encoder_factor

A, B, S = (gtsam.symbol(c, 0) for c in "ABS")
READING = np.array([3.0, -0.4, -2.5, 0.2, 0.1, 0.0])
NOISE = gtsam.noiseModel.Diagonal.Sigmas(np.array([1.0, 2.0, 0.5, 1.0, 3.0, 1.0]))


def by_scale(entries: tuple[int, ...]) -> np.ndarray:
    """Readings of pan (0) and tilt (1) in the columns of the scales that are free."""
    joint = np.tile([0, 1], 3)
    return np.column_stack([np.where(joint == k, READING, 0.0) for k in entries])


def values_of(scale: np.ndarray, angles: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(A, angles[:4])
    values.insert(B, angles[4:])
    values.insert(S, scale)
    return values


@pytest.mark.parametrize("size", [0.0, 1e-7, 0.1, 10.0])
@pytest.mark.parametrize("entries", [(0,), (1,), (0, 1)])
def test_residual_and_jacobians(entries: tuple[int, ...], size: float) -> None:
    rng = np.random.default_rng(len(entries))
    scale = size * rng.normal(size=len(entries))
    angles = READING + size * rng.normal(size=6)
    values = values_of(scale, angles)
    factor = encoder_factor(NOISE, Key(S), [Key(A), Key(B)], reading=READING, by_scale=by_scale(entries))
    every = np.zeros(2)
    every[list(entries)] = scale
    expected = angles - READING * (1 + np.tile(every, 3))
    assert factor.unwhitenedError(values) == pytest.approx(expected, abs=1e-14 * (1 + size))
    jacobian, column = factor.linearize(values).jacobian()[0], 0
    for key in factor.keys():  # noqa: SIM118  a gtsam factor, not a dictionary
        dim = len(values.atVector(key))
        for i in range(dim):
            errors = []
            for h in (1e-4, -1e-4):
                delta = gtsam.VectorValues()
                delta.insert(key, h * np.eye(dim)[i])
                errors.append(NOISE.whiten(factor.unwhitenedError(values.retract(delta))))
            assert jacobian[:, column] == pytest.approx((errors[0] - errors[1]) / 2e-4, abs=1e-9)
            column += 1


def test_a_scale_that_is_held_is_no_variable() -> None:
    scale = np.array([0.01, -0.02])
    every = by_scale((0, 1))
    free = encoder_factor(NOISE, Key(S), [Key(A), Key(B)], reading=READING, by_scale=every)
    held = encoder_factor(NOISE, Fixed(scale), [Key(A), Key(B)], reading=READING, by_scale=every)
    values = values_of(scale, READING + 0.1)
    assert list(held.keys()) == [A, B]
    np.testing.assert_array_equal(held.unwhitenedError(values), free.unwhitenedError(values))
