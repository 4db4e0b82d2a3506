"""Points that two eyes of a frame see behind them."""

from dataclasses import replace

import numpy as np
import pytest

from pancam_graph import SimulationOptions, Traverse, simulate
from pancam_graph.rigs import TEMPLATES
from pancam_graph.solve._behind import points_behind

MOST_LOST = 0.3
"""Share in use of a drive in which something is wrong."""


def drive(rig: str, *, outliers: float = 0.0) -> Traverse:
    return simulate(TEMPLATES[rig](), SimulationOptions(stops=1, pans=6, outliers=outliers), seed=1).traverse


def mirrored(t: Traverse) -> Traverse:
    assert t.observations is not None
    uv_px = t.observations.uv_px.copy()
    uv_px[:, 0] = t.rig.eyes[0].camera.width_px - 1 - uv_px[:, 0]
    return t.with_observations(replace(t.observations, uv_px=uv_px))


def swapped(t: Traverse) -> Traverse:
    """The left eye's images are said to be the right eye's, and the other way round."""
    assert t.observations is not None
    partner = np.arange(len(t.images))
    of_two = partner[t.image_eye < 2]
    partner[of_two] = of_two.reshape(-1, 2)[:, ::-1].ravel()
    return t.with_observations(replace(t.observations, image=partner[t.observations.image]))


@pytest.mark.parametrize("rig", ["mer-navcam", "exomars-pancam"])
@pytest.mark.parametrize("wrong", [mirrored, swapped])
def test_images_of_another_side_show_points_behind(rig: str, wrong: object) -> None:
    assert callable(wrong)
    (test,) = points_behind(wrong(drive(rig)), MOST_LOST)
    assert not test.passed
    assert test.value is not None
    assert test.value > 0.2
    assert "behind" in test.says


@pytest.mark.parametrize("outliers", [0.0, 0.6])
def test_outliers_are_not_behind(outliers: float) -> None:
    (test,) = points_behind(drive("mer-navcam", outliers=outliers), MOST_LOST)
    assert test.passed
    assert test.value is not None
    assert test.value < 0.01


def test_it_is_not_looked_for_where_most_is_in_use_or_little_is_seen_twice() -> None:
    t = drive("mer-navcam")
    assert t.observations is not None
    assert not list(points_behind(mirrored(t), 0.9))
    one_eye = t.with_observations(t.observations.select(t.image_eye[t.observations.image] == 0))
    assert not list(points_behind(one_eye, MOST_LOST))
