"""Windows of a pair of images: where in one the pixels of the other can lie."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, Traverse, simulate
from pancam_graph.images import FrontEndOptions
from pancam_graph.images._overlap import near_stops, overlapping_pairs
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.rigs import Rig, exomars_pancam, mer_navcam
from support.parameters import slow_but_for

OPTIONS = FrontEndOptions()


def traverse(rig: Rig) -> Traverse:
    return simulate(rig, SimulationOptions(stops=2, pans=6, points_per_image=1), seed=0).traverse


@pytest.mark.parametrize("rig", slow_but_for([mer_navcam], [mer_navcam, exomars_pancam]))
def test_pixels_are_left_out_at_once_only_where_they_have_no_window(rig: Callable[[], Rig]) -> None:
    t = simulate(rig(), SimulationOptions(stops=2, pans=3, points_per_image=1), seed=0).traverse
    pairs = overlapping_pairs(t, OPTIONS, stops=np.ones((2, 2), dtype=bool))
    turned = [replace(p, a=p.b, b=p.a) for p in pairs]
    rng = np.random.default_rng(0)
    quick = 0
    for pair in rng.permutation(np.array([*pairs, *turned], dtype=object))[:12]:
        assert isinstance(pair, PairGeometry)
        uv = rng.uniform(0, 1, (1000, 2)) * [pair.camera_a.width_px - 1, pair.camera_a.height_px - 1]
        window = pair.no_correction, np.diag(pair.sigma), OPTIONS.search_slack_px, OPTIONS
        found, whole = pair.segments(uv, *window), pair._segments(uv, *window)
        assert np.array_equal(found.valid, whole.valid)
        for name, column in vars(whole).items():
            assert np.array_equal(getattr(found, name)[whole.valid], column[whole.valid]), name
        quick += int(not pair._near(uv, *window).all())
    assert quick > 3


@pytest.mark.parametrize(
    ("apart_m", "sigma_m", "near"), [(19, 0, True), (21, 0, False), (24, 2, True), (60, 99, False)]
)
def test_stops_that_telemetry_may_have_put_too_far_apart_are_near(
    apart_m: float, sigma_m: float, near: bool
) -> None:
    t = traverse(mer_navcam())
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([apart_m, 0.0, 0.0]))
    first = replace(t.stops[0], world_T_mast=gtsam.Pose3(), sigma_translation_m=0.0)
    second = replace(t.stops[1], world_T_mast=pose, sigma_translation_m=sigma_m)
    found = near_stops(replace(t, stops=(first, second)), OPTIONS)
    assert found.tolist() == [[False, near], [near, False]]
