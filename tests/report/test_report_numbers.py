"""Labels that keep their distance, magnifications, and numbers as they are written."""

import numpy as np
import pytest

from pancam_graph.report._images import magnification
from pancam_graph.report._look import logarithmic
from pancam_graph.report._map import place_labels
from pancam_graph.report._numbers import round_factor, rounded, short, thinned
from pancam_graph.report._scene import label_stops


def test_labels_keep_their_distance() -> None:
    stops = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    assert label_stops(stops, 2.5) == [0, 3, 6, 9]


def test_map_labels_cover_neither_stops_nor_labels() -> None:
    rng = np.random.default_rng(5)
    stops, half = rng.uniform(0, 30, (40, 2)), np.array([2.0, 0.5])
    placed = place_labels(stops, [2 * half] * len(stops), clear_m=0.6)
    assert 10 < len(placed) < 40
    for row, centre in placed.items():
        assert not np.any(np.all(np.abs(stops - centre) < half, axis=1))
        for other, at in placed.items():
            assert other == row or np.any(np.abs(at - centre) >= 2 * half - 1e-9)
    alone = place_labels(np.zeros((1, 2)), [2 * half], clear_m=0.6)
    np.testing.assert_allclose(alone[0], [0.0, -1.1])


@pytest.mark.parametrize(
    ("wanted", "found"), [(0.3, 1), (1, 1), (1.99, 1), (2, 2), (9.9, 5), (10, 10), (730, 500), (np.inf, 1)]
)
def test_round_factors(wanted: float, found: float) -> None:
    assert round_factor(wanted) == found


def test_magnification_of_round_off_is_one() -> None:
    assert magnification(np.full((5, 2), 1e-9), 1024) == 1
    assert magnification(np.full((5, 2), 1.0), 1024) == 20


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.41234, "0.412"),
        (12345.6, "12,346"),
        (1000.4, "1,000"),
        (2.5e-9, "2.50·10⁻⁹"),
        (97_036_128.0, "9.70·10⁷"),
        (float("nan"), "\N{EN DASH}"),
        (150.2, "150"),
    ],
)
def test_short_numbers(value: float, text: str) -> None:
    assert short(value) == text


def test_rounded_has_no_nan_and_no_negative_zero() -> None:
    found = rounded([1.23456, np.nan, -1e-9, np.inf], 2)
    assert found == [1.23, None, 0.0, None]
    assert str(found[2]) == "0.0"


def test_thinned_is_even_and_whole_when_few() -> None:
    assert thinned(5, 10).tolist() == [0, 1, 2, 3, 4]
    assert thinned(100, 4).tolist() == [0, 33, 66, 99]


def test_ticks_of_logarithmic_axes_are_values_and_lie_where_the_values_are() -> None:
    few = logarithmic([0.009, 1.4])
    assert [t for t in few["tickvals"] if 0.009 <= t <= 1.4] == [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    assert few["ticktext"][few["tickvals"].index(0.05)] == "0.05"
    many = logarithmic([1e-4, np.nan, 0.0, 30.0])
    assert [t for t in many["tickvals"] if 1e-4 <= t <= 30] == [1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0]
    assert len(logarithmic([])["tickvals"]) > 3
