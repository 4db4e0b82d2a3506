"""Geometry of a pair from matches of which many are wrong, where pointing is hardly known."""

from pathlib import Path

import numpy as np
import pytest

from pancam_graph.images import FrontEndOptions
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._verify import PairFit, epipolar_px, fit_pair
from support.image_scenes import SIZE_PX, disturbed, make_traverse
from support.parameters import slow_but_for


@pytest.mark.parametrize("sigma_deg", slow_but_for([20.0], [5.0, 10.0, 20.0, 40.0]))
def test_corrections_that_turn_points_behind_the_camera_end_in_numbers(
    tmp_path: Path, sigma_deg: float
) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(-26.0, 52.0), eyes=("left",))
    options = FrontEndOptions()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        geometry = PairGeometry(disturbed(truth, sigma_deg, seed), 0, 1, 1e-3)
        uv_a, uv_b = rng.uniform(0, SIZE_PX - 1, (2, 12, 2))
        start = PairFit(p=geometry.no_correction, root=np.diag(geometry.sigma))
        fit = fit_pair(geometry, uv_a, uv_b, start, 100.0 * sigma_deg, options)
        assert np.isfinite(fit.p).all()
        assert np.isfinite(fit.root).all()
        distance, inverse_depth = epipolar_px(geometry, fit.p, uv_a, uv_b, options)
        assert not np.isnan(distance).any()
        assert np.isfinite(inverse_depth).all()


def test_what_the_other_camera_cannot_see_is_infinitely_far_from_its_line(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(0.0, 180.0), eyes=("left",))
    geometry = PairGeometry(truth, 0, 1, 1e-3)
    uv = np.full((3, 2), SIZE_PX / 2)
    distance, _ = epipolar_px(geometry, geometry.no_correction, uv, uv, FrontEndOptions())
    assert np.isinf(distance).all()
