"""The registry of camera models: what it knows, and that it takes no class for another."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import CAHV, LENSES, MOUNT, Brown, Pinhole, as_cahv, lens_of
from support.lenses import ALL, FAR, NUMBERS, SIZE, pixels


@dataclass(frozen=True, kw_only=True)
class Squeezed(Pinhole):
    """A made-up lens that nobody registered: the middle of the image is squeezed."""

    squeeze: float

    def distort(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        return xy * (1 - self.squeeze), np.broadcast_to(np.eye(2) * (1 - self.squeeze), (len(xy), 2, 2))

    def undistort(self, xy_distorted: FloatArray) -> tuple[FloatArray, BoolArray]:
        return xy_distorted / (1 - self.squeeze), np.ones(len(xy_distorted), dtype=bool)


def test_each_class_has_its_own_lens() -> None:
    assert [lens.name for lens in LENSES] == ["pinhole", "brown", "cahv", "cahvor", "cahvore"]
    assert {name: lens_of(camera).name for name, camera in ALL.items()} == {name: name for name in ALL}


@pytest.mark.parametrize("name", ALL)
def test_the_fields_say_the_whole_camera(name: str) -> None:
    """A camera made anew from the values of its fields sees what the original sees, to the bit."""
    camera = ALL[name]
    lens = lens_of(camera)
    values = {f.attribute: f.of(camera) for f in lens.fields if f != MOUNT}
    arguments = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    again = lens.camera(**SIZE, **arguments)
    rays, expected = again.unproject(pixels()), camera.unproject(pixels())
    np.testing.assert_array_equal(rays.direction, expected.direction)
    np.testing.assert_array_equal(rays.origin_m, expected.origin_m)


@pytest.mark.parametrize("name", [n for n in ALL if n != "brown"])
def test_the_equal_in_the_cahv_family_sees_the_same(name: str) -> None:
    camera = ALL[name]
    points = camera.unproject(pixels()).direction * FAR
    assert as_cahv(camera).project(points)[0] == pytest.approx(camera.project(points)[0], abs=1e-9)


def test_a_class_that_is_not_registered_is_no_pinhole() -> None:
    squeezed = Squeezed(**SIZE, **NUMBERS, squeeze=0.1)
    expected = "expected pinhole, brown, cahv, cahvor or cahvore, found Squeezed"
    with pytest.raises(CameraError, match=expected):
        lens_of(squeezed)
    with pytest.raises(CameraError, match=expected):
        as_cahv(squeezed)


def test_a_lens_without_an_equal_says_why() -> None:
    brown = ALL["brown"]
    assert isinstance(brown, Brown)
    with pytest.raises(CameraError, match="expected k1 and k2 alone, all that CAHVOR can say"):
        as_cahv(brown)
    assert type(as_cahv(replace(brown, distortion=(0.0,) * 5))) is CAHV
