"""What rays meet: the ground that heights describe, pebbles on it, and the shadows of both."""

import math
from collections.abc import Iterator
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.simulate import RenderOptions, _rays
from pancam_graph.simulate import _scene as scene_module
from pancam_graph.simulate._rays._world import SHADE, Scene
from pancam_graph.simulate._render import _trace
from pancam_graph.simulate._scene import make_deck, make_scene
from support.small_worlds import smaller_worlds

PIXEL_RAD = 8e-4
NO_PEBBLES_RAD = 1.0  # pixels so wide that none is seen
NO_DECK = make_deck(1.5, gtsam.Pose3(), seen=False)
LOW_SUN = RenderOptions(stops=1, rock_abundance=0.0, sun_elevation_rad=math.radians(15.0))


@pytest.fixture(scope="module", autouse=True)
def small_world() -> Iterator[None]:
    with smaller_worlds():
        yield


@pytest.fixture(scope="module")
def bare(small_world: None) -> Scene:
    """Ground without rocks."""
    return make_scene(LOW_SUN, np.zeros((1, 2)), np.random.default_rng(5))


def looking_down(scene: Scene, columns: int = 40, rows: int = 120) -> tuple[FloatArray, FloatArray]:
    """Origin (1, 3) and directions (rows columns, 3) of a camera, from the horizon to the rover's wheels."""
    origin = np.array([[0.0, 0.0, _rays.heights(scene, np.zeros((1, 2)))[0] + 1.5]])
    down, aside = np.meshgrid(np.linspace(-0.02, 0.9, rows), np.linspace(-0.3, 0.3, columns), indexing="ij")
    level = np.cos(down)
    return origin, np.stack([level * np.cos(aside), level * np.sin(aside), -np.sin(down)], -1).reshape(-1, 3)


def distances(
    scene: Scene, origin: FloatArray, direction: FloatArray, pixel_rad: float = PIXEL_RAD
) -> FloatArray:
    width = np.full(len(direction), pixel_rad)
    return _trace(scene, NO_DECK, origin, direction, width, lit=False).distance_m


def test_a_ray_ends_where_it_first_meets_the_ground(bare: Scene) -> None:
    origin, direction = looking_down(bare)
    reached = distances(bare, origin, direction, NO_PEBBLES_RAD)
    hit = reached < 15.0  # on one grid, whose heights are asked for
    assert hit.sum() > 4000
    ends = origin + reached[hit, None] * direction[hit]
    np.testing.assert_allclose(_rays.heights(bare, ends[:, :2]), ends[:, 2], atol=1e-6)
    on_the_way = np.linspace(0.04, 0.999999, 400)[:, None] * reached[hit]
    at = origin + on_the_way[..., None] * direction[hit]
    over = at[..., 2].ravel() - _rays.heights(bare, at[..., :2].reshape(-1, 2))
    assert over.min() > -1e-6


def test_rays_that_begin_where_the_ones_below_ended_meet_the_same(bare: Scene) -> None:
    columns = 40
    origin, direction = looking_down(bare, columns)
    width = np.full(len(direction), PIXEL_RAD)
    below = np.arange(columns, len(direction) + columns)
    below[-columns:] = -1
    helped = _trace(bare, NO_DECK, origin, direction, width, below)
    alone = _trace(bare, NO_DECK, origin, direction, width)
    np.testing.assert_array_equal(np.isfinite(helped.ground_m), np.isfinite(alone.ground_m))
    seen = np.isfinite(alone.ground_m)
    np.testing.assert_allclose(helped.ground_m[seen], alone.ground_m[seen], rtol=1e-9)
    np.testing.assert_allclose(helped.light, alone.light, rtol=1e-6)


def test_pebbles_stand_on_the_ground_and_are_the_same_from_everywhere(bare: Scene) -> None:
    origin, direction = looking_down(bare)
    reached, ground = (distances(bare, origin, direction, p) for p in (PIXEL_RAD, NO_PEBBLES_RAD))
    stone = (reached < ground - 1e-9) & (ground < 6.0)
    assert 0.01 < stone.sum() / (ground < 6.0).sum() < 0.3
    ends = origin + reached[stone, None] * direction[stone]
    high = ends[:, 2] - _rays.heights(bare, ends[:, :2])
    assert high.min() > -1e-3
    assert high.max() < 0.03
    elsewhere = origin + np.array([0.25, 0.3, 0.4])
    rays = ends - elsewhere
    length = np.linalg.norm(rays, axis=1)
    again = distances(bare, elsewhere, rays / length[:, None])
    unseen = again < length - 1e-4  # something stands before it
    assert unseen.mean() < 0.6
    np.testing.assert_allclose(again[~unseen], length[~unseen], atol=2e-3)


def test_ground_lies_in_shadow_where_rays_to_the_sun_meet_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    made = scene_module._mid

    def steeper(*arguments: Any) -> scene_module.Level:
        height, albedo, outcrop = made(*arguments)
        return 6 * height, albedo, outcrop

    monkeypatch.setattr(scene_module, "_mid", steeper)
    scene = make_scene(LOW_SUN, np.zeros((1, 2)), np.random.default_rng(5))
    start, wide, deep = scene.surface_shape[0, 0]
    shade = scene.surface.reshape(-1, _rays.CHANNELS)[start : start + wide * deep, SHADE]
    margin = shade - scene.height_m[: wide * deep]
    assert 0.03 < np.mean(margin > 0) < 0.7
    rng = np.random.default_rng(0)
    node = np.concatenate([rng.choice(np.flatnonzero(c), 400) for c in (margin > 0.01, margin < -0.01)])
    inner = (node % wide > 3) & (node % wide < wide - 4) & (node // wide > 3) & (node // wide < deep - 4)
    node = node[inner]
    xy = scene.frame_m[0, 0, :2] + scene.frame_m[0, 0, 2] * np.stack([node % wide, node // wide], axis=-1)
    origin = np.column_stack([xy, scene.height_m[node]])
    to_sun = np.tile(scene.sun, (len(node), 1))
    dark = np.isfinite(distances(scene, origin, to_sun, NO_PEBBLES_RAD))
    assert np.mean(dark == (margin[node] > 0)) > 0.97


def test_pebbles_throw_shadows(bare: Scene) -> None:
    origin, direction = looking_down(bare)
    reached = distances(bare, origin, direction)
    ends = (origin + reached[:, None] * direction)[reached < 5.0]
    high = ends[:, 2] - _rays.heights(bare, ends[:, :2])
    tops = ends[high > 3e-3]
    shadow = tops - (high[high > 3e-3] / bare.sun[2])[:, None] * bare.sun
    light = [light_from_above(bare, xy) for xy in (shadow[:, :2], shadow[:, :2] + 0.3)]
    assert len(shadow) > 50
    assert np.median(light[0]) < 0.75 * np.median(light[1])


def light_from_above(scene: Scene, xy_m: FloatArray) -> FloatArray:
    above = np.column_stack([xy_m, _rays.heights(scene, xy_m) + 1.0])
    down = np.tile([0.0, 0.0, -1.0], (len(xy_m), 1))
    return _trace(scene, NO_DECK, above, down, np.full(len(xy_m), PIXEL_RAD)).light
