"""The joint covariance of a rig's numbers: what it takes, and what it is of some of them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.cameras import FIELD_PER_COEFFICIENT
from pancam_graph.rigs import RIG_ENTRIES, RigCovariance, RigEntry, RigUncertainty

A, B = RigEntry("calibration", "left", "focal"), RigEntry("mounts", "left", "rx_rad")
AXIS = RigEntry("pan_T_tilt", None, "z_m")
MATRIX = [[4.0, 1.0], [1.0, 9.0]]


def covariance(entries: Any = (A, B), matrix: Any = MATRIX) -> RigCovariance:
    return RigCovariance(entries=tuple(entries), matrix=np.array(matrix))


@pytest.mark.parametrize(
    ("entries", "matrix", "sentence"),
    [
        ((A, B), np.eye(3), "expected 2 x 2 numbers, one row an entry; found 3 x 3"),
        ((A, B), [[4.0, np.nan], [np.nan, 9.0]], "expected finite numbers"),
        ((A, B), [[4.0, 1.0], [1.1, 9.0]], "expected a symmetric matrix, found 1 and 1.1 for"),
        ((A, B), [[4.0, 6.1], [6.1, 9.0]], "expected a positive definite matrix"),
        ((A, B), [[4.0, 6.0], [6.0, 9.0]], "expected a positive definite matrix"),
        ((A, B), [[0.0, 0.0], [0.0, 9.0]], "expected variances above 0, found 0 of calibration left focal"),
        ((A, A), MATRIX, "expected different entries, found calibration left focal twice"),
        (
            (A, RigEntry("radius", "left", "radius_m")),
            MATRIX,
            "quantity: expected one of calibration, mounts",
        ),
        ((A, RigEntry("mounts", "left", "cx_px")), MATRIX, "entry: expected one of rx_rad"),
        ((A, RigEntry("mounts", None, "rx_rad")), MATRIX, "expected the name of a camera; found none"),
        ((A, RigEntry("pan_T_tilt", "left", "z_m")), MATRIX, "expected no camera, as all have one tilt axis"),
    ],
)
def test_what_is_no_covariance_is_refused(entries: Any, matrix: Any, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        covariance(entries, matrix)


def test_entries_that_are_not_named_are_independent_with_their_own_sigma() -> None:
    found = covariance().among([AXIS, B, A], np.array([5.0, 100.0, 100.0]))
    np.testing.assert_array_equal(found, [[25.0, 0.0, 0.0], [0.0, 9.0, 1.0], [0.0, 1.0, 4.0]])
    assert covariance().sigma(B) == 3.0
    assert covariance().sigma(AXIS) is None


def test_without_a_covariance_all_sigmas_count() -> None:
    told = RigUncertainty(focal=0.1, mount_rad=0.2, tilt_axis_m=0.3)
    np.testing.assert_allclose(told.covariance_of([A, B, AXIS]), np.diag([0.01, 0.04, 0.09]))
    joint = replace(told, covariance=covariance())
    np.testing.assert_allclose(joint.covariance_of([A, AXIS]), np.diag([4.0, 0.09]))


def test_each_number_of_a_rig_has_a_sigma_of_its_own_name() -> None:
    names = [
        n for n in RigUncertainty().sigmas if not n.startswith(("flex", "field")) and not n.endswith("_scale")
    ]
    for i, name in enumerate(names):
        told = replace(RigUncertainty.exact(), **{name: 1.0 + i})  # type: ignore[arg-type]  # by name
        found = {(q, e) for q, entries in RIG_ENTRIES.items() for e in entries if told.sigma_of(q, e)}
        assert found
        assert {told.sigma_of(q, e) for q, e in found} == {1.0 + i}
    # That of a field is of the whole at a pixel, which many coefficients make.
    told = replace(RigUncertainty.exact(), field_px=0.1)
    assert {told.sigma_of("field", e) for e in RIG_ENTRIES["field"]} == {0.1 / FIELD_PER_COEFFICIENT}


def test_an_exact_number_has_no_covariance() -> None:
    with pytest.raises(InputError, match="expected entries whose own sigma is above 0, found focal of cali"):
        RigUncertainty(focal=0.0, covariance=covariance())
