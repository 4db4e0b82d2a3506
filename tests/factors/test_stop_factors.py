"""Factors of what is known of masts: values against independent formulas, Jacobians against differences."""

import gtsam
import numpy as np
import pytest

from pancam_graph.factors import Fixed, Key, stop_distance_factor, stop_heading_factor, stop_position_factor

A, B = gtsam.symbol("M", 0), gtsam.symbol("M", 1)
STATES = {"random": (1.0, 5.0), "near identity": (1e-7, 1e-7), "far": (1.0, 1e4)}
UNIT = gtsam.noiseModel.Unit.Create
POSITION = np.array([1.0, -2.0, 0.5])


def drawn(seed: int, angle: float, length: float) -> gtsam.Values:
    rng, values = np.random.default_rng(seed), gtsam.Values()
    for key in (A, B):
        values.insert(key, gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, angle, 3)), rng.normal(0, length, 3)))
    return values


FACTORS = {
    "position": stop_position_factor(UNIT(3), Key(A), position_m=POSITION, axes=np.arange(3)),
    "height": stop_position_factor(UNIT(1), Key(A), position_m=POSITION[2:], axes=np.array([2])),
    "distance": stop_distance_factor(UNIT(1), Key(A), Key(B), distance_m=2.0),
    "distance from a held stop": stop_distance_factor(
        UNIT(1), Fixed(gtsam.Pose3(gtsam.Rot3(), POSITION)), Key(B), distance_m=2.0
    ),
    "heading": stop_heading_factor(UNIT(1), Key(A), heading_rad=0.3),
    "heading behind": stop_heading_factor(UNIT(1), Key(A), heading_rad=3.1),
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("name", FACTORS)
def test_jacobians(name: str, state: str) -> None:
    factor = FACTORS[name]
    for seed in range(4):
        values = drawn(seed, *STATES[state])
        step = min(1e-6, 0.1 * STATES[state][1])
        jacobian = factor.linearize(values).jacobian()[0]
        for i, key in enumerate(factor.keys()):
            for k in range(6):
                ends = []
                for h in (step, -step):
                    delta = gtsam.VectorValues()
                    delta.insert(key, h * np.eye(6)[k])
                    ends.append(factor.unwhitenedError(values.retract(delta)))
                numeric = (ends[0] - ends[1]) / (2 * step)
                # Rounding of coordinates of 1e4 m, or curvature of a distance of 1e-7 m.
                assert jacobian[:, 6 * i + k] == pytest.approx(
                    numeric, abs=1e-2 if state != "random" else 1e-7
                )


def test_values_by_other_formulas() -> None:
    values = drawn(5, 1.0, 5.0)
    a, b = values.atPose3(A), values.atPose3(B)
    assert FACTORS["position"].unwhitenedError(values) == pytest.approx(a.translation() - POSITION)
    assert FACTORS["distance"].unwhitenedError(values)[0] == pytest.approx(a.range(b) - 2.0)
    level = gtsam.Values()
    for heading in (0.4, 3.0, -3.0):
        pose = gtsam.Pose3(gtsam.Rot3.Rz(heading) * gtsam.Rot3.RzRyRx(0.2, -0.4, 0.0), np.zeros(3))
        level = gtsam.Values()
        level.insert(A, pose)
        found = FACTORS["heading behind"].unwhitenedError(level)[0]
        assert found == pytest.approx((heading - 3.1 + np.pi) % (2 * np.pi) - np.pi)


def test_a_vertical_x_axis_has_no_heading() -> None:
    values = gtsam.Values()
    values.insert(A, gtsam.Pose3(gtsam.Rot3.Ry(-np.pi / 2), np.zeros(3)))
    jacobian = FACTORS["heading"].linearize(values).jacobian()[0]
    assert np.all(np.isfinite(jacobian))
