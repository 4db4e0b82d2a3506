"""Limits of chance against SciPy's."""

import numpy as np
import pytest
import scipy

from pancam_graph.base.chances import chi_square_limit, normal_limit


@pytest.mark.parametrize("chance", [0.5, 0.4, 1e-3, 1e-10, 1e-200, 1e-307])
def test_a_normal_limit_is_scipys(chance: float) -> None:
    assert normal_limit(chance) == pytest.approx(-scipy.special.ndtri(chance), rel=1e-14, abs=1e-15)


@pytest.mark.parametrize("chance", [0.0, -1e-3, 0.6, np.nan])
def test_other_chances_are_refused(chance: float) -> None:
    with pytest.raises(ValueError, match=r"0\.5 at most"):
        normal_limit(chance)


@pytest.mark.parametrize("chance", [0.9, 0.3, 2e-4, 2e-8, 1e-12, 1e-100])
def test_chi_square_limits_are_scipys(chance: float) -> None:
    freedom = 10.0 ** np.linspace(-0.5, 6, 60).reshape(20, 3)
    found = chi_square_limit(freedom, chance)
    assert found == pytest.approx(scipy.special.chdtri(freedom, chance), rel=1e-11)
    assert float(chi_square_limit(3.0, chance)) == pytest.approx(scipy.special.chdtri(3, chance), rel=1e-12)


def test_chi_square_of_next_to_no_freedom_has_a_limit_too() -> None:
    """As where a group has hardly any observations: a freedom is taken to be 0.001 at least."""
    assert float(chi_square_limit(1e-3, 2e-4)) == pytest.approx(scipy.special.chdtri(1e-3, 2e-4), rel=1e-11)
    # Here the chance of any size above 0 that has digits is less: the limit is 0 but for rounding.
    assert 0 <= float(chi_square_limit(1e-3, 0.3)) < 1e-50


@pytest.mark.parametrize(
    ("freedom", "chance"), [(0.0, 0.1), (-1.0, 0.1), (2.0, 0.0), (2.0, 1.0), (np.nan, 0.1)]
)
def test_what_has_no_limit_is_refused(freedom: float, chance: float) -> None:
    with pytest.raises(ValueError, match="expected"):
        chi_square_limit(freedom, chance)
