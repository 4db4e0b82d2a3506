"""Keys for callers: which variable each names, and what is said of one that there is not."""

import gtsam
import numpy as np
import pytest

from pancam_graph import Freedom, Sharing, SimulationOptions, SolveOptions, Traverse, graph_keys, simulate
from pancam_graph.base.errors import InputError
from pancam_graph.graph import GraphKeys
from pancam_graph.rigs import mer_navcam

FREE = Sharing(
    calibration=Freedom(scope="all", free=("focal",)),
    mounts=Freedom(scope="eye", free=("rx_rad", "ry_rad")),
    pan_T_tilt=Freedom(scope="stop", free=("rz_rad",)),
)


@pytest.fixture(scope="module")
def traverse() -> Traverse:
    return simulate(mer_navcam(), SimulationOptions(stops=2, pans=3, points_per_image=3), seed=1).traverse


@pytest.fixture(scope="module")
def keys(traverse: Traverse) -> GraphKeys:
    return graph_keys(traverse, SolveOptions(sharing=FREE))


def test_each_stop_frame_and_free_quantity_has_a_key_of_its_own(traverse: Traverse, keys: GraphKeys) -> None:
    eyes = [eye.name for eye in traverse.rig.eyes]
    every = [keys.mast(s.id) for s in traverse.stops] + [keys.angles(f.id) for f in traverse.frames]
    every += [keys.mount(eye) for eye in eyes] + [keys.calibration()]
    every += [keys.tilt_axis(stop=s.id) for s in traverse.stops]
    assert len(set(every)) == len(traverse.stops) * 2 + len(traverse.frames) + len(eyes) + 1
    assert keys.mast(traverse.stops[1].id) == gtsam.symbol("M", 1)
    assert keys.angles(traverse.frames[3].id) == gtsam.symbol("A", 3)
    assert keys.name(keys.mount(eyes[0])) == f"mount of {eyes[0]}"
    assert keys.name(keys.calibration()) == "calibration"
    assert keys.name(keys.tilt_axis(stop=traverse.stops[1].id)) == f"tilt axis at {traverse.stops[1].id}"


def test_entries_name_the_components_in_their_order(traverse: Traverse, keys: GraphKeys) -> None:
    assert keys.entries(keys.mount("left")) == ("rx_rad", "ry_rad")
    assert keys.entries(keys.calibration()) == ("focal",)
    assert keys.entries(keys.angles(traverse.frames[0].id)) == ("pan_rad", "tilt_rad")
    assert keys.entries(keys.mast(traverse.stops[0].id))[3:] == ("x_m", "y_m", "z_m")


def test_what_all_share_is_any_camera_s(traverse: Traverse, keys: GraphKeys) -> None:
    assert {keys.calibration(eye.name) for eye in traverse.rig.eyes} == {keys.calibration()}


def test_an_image_names_the_variable_that_it_has(traverse: Traverse, keys: GraphKeys) -> None:
    for image in traverse.images:
        assert keys.mount(image=image.id) == keys.mount(image.camera)


def said(call: object) -> str:
    with pytest.raises(InputError) as caught:
        call()  # type: ignore[operator]  # a call without arguments
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_an_unknown_name_is_told_with_those_that_there_are_and_the_near_one(
    traverse: Traverse, keys: GraphKeys
) -> None:
    text = said(lambda: keys.mast("stop0009"))
    assert "expected one of stop0000, stop0001; found 'stop0009'; is 'stop000" in text
    text = said(lambda: keys.angles("fram00001"))
    assert text.startswith("frame: expected one of frame00000")
    assert "is 'frame00001' meant?" in text
    assert "expected one of left, right" in said(lambda: keys.mount("lift"))
    assert "is 'left' meant?" in said(lambda: keys.mount("lift"))


def test_several_that_fit_and_none_that_is_free_are_told(traverse: Traverse, keys: GraphKeys) -> None:
    text = said(keys.mount)
    assert "expected one of mount of left, mount of right; found nothing that says which" in text
    assert "found it fixed; Sharing(radius=...) frees it" in said(keys.radius)
    assert "terrain points" in said(lambda: keys.landmark("rock7"))


def test_a_key_of_something_else_is_told_with_its_neighbour(traverse: Traverse, keys: GraphKeys) -> None:
    text = said(lambda: keys.name(int(gtsam.symbol("M", 7)), "factor 2"))
    assert text.startswith("factor 2: expected keys of graph_keys(traverse, options): 2 masts, angles of ")
    assert "found m7" in text.lower()
    assert "is M1, the mast of stop0001, meant?" in text
    assert "terrain points" in said(lambda: keys.name(int(gtsam.symbol("L", 0))))
    assert "no such variable" in said(lambda: keys.name(int(gtsam.symbol("R", 0))))
    assert np.all([keys.dim(keys.mast(s.id)) == 6 for s in traverse.stops])


@pytest.mark.parametrize("key", [3, -1, 1 << 64, (1 << 64) - 1])
def test_a_number_that_is_no_key_is_bad_input(keys: GraphKeys, key: int) -> None:
    for ask in (keys.name, keys.dim, keys.entries):
        with pytest.raises(InputError, match=rf"key: expected keys of graph_keys.*; found {key}$"):
            ask(key)
