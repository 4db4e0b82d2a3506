"""Camera models as .cahvor text: exact both ways, in the order that JPL's readers look for."""

import re
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from pancam_graph import write_cameras
from pancam_graph.base.errors import CameraError, InputError
from pancam_graph.cameras import CAHV, CAHVOR, CAHVORE, Brown, as_cahv
from pancam_graph.data import Solution
from pancam_graph.io import cahvor_text, read_cahvor
from support import io_samples

EYES = {e.name: e for e in io_samples.all_eyes()}
POINTS = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [0.4, 0.3, 0.5] + [0.0, 0.0, 3.0]


def solution_without(*cameras: str) -> Solution:
    """The made-up solution with the images of some cameras only left."""
    made = io_samples.solution()
    t = made.traverse
    eyes = tuple(e for e in t.rig.eyes if e.name not in cameras)
    images = tuple(i for i in t.images if i.camera not in cameras)
    kept = np.array([i.camera not in cameras for i in t.images])
    assert t.observations is not None
    observations = t.observations.select(kept[t.observations.image])
    observations = replace(observations, image=(np.cumsum(kept) - 1)[observations.image])
    rows = kept[t.observations.image]
    final = replace(
        made.final,
        world_R_camera=made.final.world_R_camera[kept],
        world_t_camera=made.final.world_t_camera[kept],
    )
    return replace(
        made,
        traverse=replace(t, rig=replace(t.rig, eyes=eyes), images=images, observations=observations),
        final=final,
        used=made.used[rows],
        reason=tuple(np.array(made.reason)[rows].tolist()),
        residual_final_px=made.residual_final_px[rows],
        residual_initial_px=made.residual_initial_px[rows],
        sigma_px=made.sigma_px[rows],
    )


@pytest.mark.parametrize("name", ["pinhole", "cahv", "cahvor", "cahvore"])
@pytest.mark.parametrize("linearity", [1.0, 0.0, 0.37, -0.2])
def test_a_model_reads_back_bit_for_bit(tmp_path: Path, name: str, linearity: float) -> None:
    model = as_cahv(EYES[name].camera).transformed(
        gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -1.1, 2.0), np.array([1234.5678, -1e-5, 3.0]))
    )
    if isinstance(model, CAHVORE):
        model = replace(model, linearity=linearity)
    path = tmp_path / "a.cahvor"
    path.write_text(cahvor_text(model, ["a comment"]))
    again = read_cahvor(path)
    assert type(again) is type(model)
    assert (again.width_px, again.height_px) == (model.width_px, model.height_px)
    for letter in type(model).__name__:
        assert getattr(again, letter).tolist() == getattr(model, letter).tolist()
    if isinstance(again, CAHVORE):
        assert again.linearity == linearity


@pytest.mark.parametrize("name", ["pinhole", "cahvor", "cahvore"])
def test_readers_that_look_for_keys_in_order_find_them(name: str) -> None:
    """JPL's readers go through the file once, from one key to the next, and want every number."""
    model = as_cahv(EYES[name].camera)
    kind = type(model).__name__
    text, size = cahvor_text(model, ["pancam_graph, image x", "pixels: S: zeros"]), 3 * len(kind)
    counts = {"Model": 0, "Dimensions": 2, **dict.fromkeys(kind, 3), "S": size * size}
    counts |= {"Hs   ": 1, "Hc   ": 1, "Vs   ": 1, "Vc   ": 1, "Theta": 1, "S internal": 25}
    place, found = 0, {}
    for key, count in counts.items():
        place = text.index(f"{key} =", place) + len(key) + 2
        words = text[place:].split()[:count]
        found[key] = [float(w) for w in words]
        assert len(words) == count
    assert found["C"] == model.C.tolist()
    assert found["H"] == model.H.tolist()
    assert found["Hs   "] == [model.fx_px]
    assert found["Vc   "] == [model.cy_px]
    assert found["Theta"][0] == pytest.approx(-np.pi / 2, abs=0.01)
    # The angle is the skew of K: tan of what it exceeds a right angle by.
    p = model.pinhole
    assert np.tan(found["Theta"][0] + np.pi / 2) == pytest.approx(p.skew_px / p.fx_px, abs=1e-9)


def test_a_file_as_jpl_prints_it(tmp_path: Path) -> None:
    """Nine decimals, the MSL camera of the published test vector."""
    (tmp_path / "n.cahvor").write_text(
        "# from somewhere\n\nModel = CAHVOR = perspective, distortion\n\nDimensions = 1024 1024\n\n"
        "C =      0.953083000      0.737269000     -1.839890000\n"
        "A =      0.618020000     -0.158336000      0.770042000\n"
        "H =    622.069000000   1100.350000000    388.444000000\n"
        "V =   -588.816000000    157.005000000   1176.660000000\n"
        "O =      0.615108000     -0.158211000      0.772395000\n"
        "R =      0.000013579      0.001830740     -0.005755200\n\nS =\n  0.0 0.0\n\nHs    = 1220.3\n"
    )
    model = read_cahvor(tmp_path / "n.cahvor")
    assert isinstance(model, CAHVOR)
    uv, _ = model.project(np.array([[4.517368, 0.544692, 1.752992]]))
    assert uv[0] == pytest.approx([680.20780863, 419.72866434], abs=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("Model = CAHVORE3,0.37 = general", "", "Model: expected a line of this name, found none"),
        ("Model = CAHVORE3,0.37", "Model = CAHVORE3", "expected CAHVORE3 with its linearity after a comma"),
        ("Model = CAHVORE3,0.37", "Model = FISH", "expected CAHV, CAHVOR, CAHVORE1, CAHVORE2 or"),
        ("Dimensions = 64 48", "Dimensions = 64", 'Dimensions: expected 2 numbers, found "64"'),
        ("Dimensions = 64 48", "Dimensions = 0 48", "image size: expected at least 1 x 1 pixel"),
        ("Dimensions = 64 48", "Dimensions = 1000001 48", "image size: expected at most 1000000 pix"),
        ("\nE =", "\nF =", "E: expected a line of this name"),
        ("\nO =", "\nO = 1", "O: expected 3 numbers"),
        ("\nO =", "\nO = nan 0 0\nx =", "O: expected 3 numbers"),
    ],
)
def test_what_is_no_model_is_one_sentence(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = cahvor_text(as_cahv(EYES["cahvore"].camera))
    assert old in text
    path = tmp_path / "a.cahvor"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        read_cahvor(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert words in str(caught.value)


def test_a_pinhole_and_a_radial_lens_are_the_same_camera() -> None:
    pinhole, brown = EYES["pinhole"].camera, EYES["brown"].camera
    assert isinstance(brown, Brown)
    radial = replace(brown, distortion=(-0.1, 0.02, 0.0, 0.0, 0.0))
    for camera, kind in ((pinhole, CAHV), (radial, CAHVOR), (replace(brown, distortion=(0.0,) * 5), CAHV)):
        model = as_cahv(camera)
        assert type(model) is kind
        assert model.project(POINTS)[0] == pytest.approx(camera.project(POINTS)[0], abs=1e-11)
    with pytest.raises(CameraError, match=r"k1 and k2 alone.*p1 0.001, p2 -0.002, k3 0.005"):
        as_cahv(brown)


def test_files_of_a_solution_see_what_its_cameras_see(tmp_path: Path) -> None:
    made = solution_without("brown")
    write_cameras(made, tmp_path / "out")
    assert len(list((tmp_path / "out").glob("*.cahvor"))) == len(made.traverse.images)
    for image, camera, R, t in zip(
        made.traverse.images,
        made.image_cameras,
        made.final.world_R_camera,
        made.final.world_t_camera,
        strict=True,
    ):
        model = read_cahvor(tmp_path / "out" / f"{image.id}.cahvor")
        of_world = POINTS @ R.T + t
        assert model.project(of_world)[0] == pytest.approx(camera.project(POINTS)[0], abs=1e-9)
        comments = re.findall("^# .*$", (tmp_path / "out" / f"{image.id}.cahvor").read_text(), re.M)
        assert "z up" in comments[1]


def test_a_lens_that_the_family_cannot_say_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cahvor: camera brown: distortion: expected k1 and k2 alone"):
        write_cameras(io_samples.solution(), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_an_image_without_a_pose_has_no_file(tmp_path: Path) -> None:
    made = solution_without("brown")
    centres = made.final.world_t_camera.copy()
    centres[0] = np.nan
    write_cameras(replace(made, final=replace(made.final, world_t_camera=centres)), tmp_path / "out")
    assert len(list((tmp_path / "out").glob("*.cahvor"))) == len(made.traverse.images) - 1
