"""A rig as a file of its own, and its use for another traverse."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph import Traverse, read_input, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.io import picture_digests, read_rig, rig_json, use_rig
from pancam_graph.rigs import Rig
from support import io_samples

MAST = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.01, -0.02, 0.3), np.array([0.4, 0.1, 1.1]))


def written(folder: Path, rig: Rig, *, passed: bool = True) -> Path:
    path = folder / "rig.json"
    path.write_bytes(rig_json(rig, name="first", passed=passed))
    return path


def sample_rig(pictures: tuple[str, ...] = ()) -> Rig:
    rig = io_samples.with_covariance(io_samples.traverse().rig, pictures)
    eyes = tuple(replace(eye, unit=f"HOST {eye.name} 7") for eye in rig.eyes)
    return replace(rig, eyes=eyes, rover_T_mast=MAST)


def assert_same_rig(found: Rig, rig: Rig) -> None:
    joint, expected = found.uncertainty.covariance, rig.uncertainty.covariance
    assert joint is not None
    assert expected is not None
    assert (joint.entries, joint.pictures) == (expected.entries, expected.pictures)
    np.testing.assert_array_equal(joint.matrix, expected.matrix)
    assert replace(found.uncertainty, covariance=None) == replace(rig.uncertainty, covariance=None)
    np.testing.assert_allclose(found.pan_T_tilt.matrix(), rig.pan_T_tilt.matrix(), rtol=0, atol=1e-12)
    for eye, other in zip(found.eyes, rig.eyes, strict=True):
        assert (eye.name, eye.unit) == (other.name, other.unit)
        np.testing.assert_allclose(
            eye.head_T_camera.matrix(), other.head_T_camera.matrix(), rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(
            eye.camera.pinhole.calibration_matrix,
            other.camera.pinhole.calibration_matrix,
            rtol=1e-12,
            atol=1e-12,
        )


def test_a_rig_comes_back_with_its_covariance(tmp_path: Path) -> None:
    rig = sample_rig(("file:a", "points:b"))
    found = read_rig(written(tmp_path, rig))
    assert_same_rig(found, rig)
    assert found.rover_T_mast is not None
    np.testing.assert_allclose(found.rover_T_mast.matrix(), MAST.matrix(), rtol=0, atol=1e-12)


def test_the_rig_of_a_traverse_has_the_same_form(tmp_path: Path) -> None:
    rig = sample_rig()
    sample = replace(io_samples.traverse(), rig=rig)
    write_traverse(sample, tmp_path)
    assert_same_rig(read_input(tmp_path).rig, rig)
    path = tmp_path / "traverse.json"
    tree = json.loads(path.read_text())
    tree["rig"] = json.loads(rig_json(rig, name="x", passed=True))["rig"]
    path.write_text(json.dumps(tree))
    assert_same_rig(read_input(tmp_path).rig, rig)


def test_a_rig_without_a_covariance_has_no_such_key(tmp_path: Path) -> None:
    write_traverse(io_samples.traverse(), tmp_path)
    rig = json.loads((tmp_path / "traverse.json").read_text())["rig"]
    assert "covariance" not in rig["uncertainty"]
    assert "rover_T_mast" not in rig
    assert all("unit" not in camera for camera in rig["cameras"])


def test_the_rig_of_a_file_takes_the_place_of_the_traverses(tmp_path: Path) -> None:
    other = MAST * gtsam.Pose3(gtsam.Rot3.Rodrigues(0.002, 0.0, -0.003), np.array([0.002, 0.0, -0.001]))
    sample = io_samples.traverse()
    given = replace(sample, rig=replace(sample.rig, rover_T_mast=other, mast_height_m=3.0))
    used = use_rig(given, written(tmp_path, sample_rig()))
    assert_same_rig(used.rig, sample_rig())
    assert used.rig.mast_height_m == 3.0
    assert used.rig.pointing_sigma == given.rig.pointing_sigma
    for stop, before in zip(used.stops, given.stops, strict=True):
        # The rover stands where it stood.
        rover = stop.world_T_mast * MAST.inverse()
        np.testing.assert_allclose(
            rover.matrix(), (before.world_T_mast * other.inverse()).matrix(), rtol=0, atol=1e-12
        )


@pytest.mark.parametrize("known", [True, False])
def test_a_rig_with_axes_of_its_own_zeros_is_refused(tmp_path: Path, known: bool) -> None:
    """As where a reader fitted axes to the labels of one folder: the same angles point elsewhere."""
    sample, turned = io_samples.traverse(), gtsam.Pose3(gtsam.Rot3.Rz(0.05), np.zeros(3))
    rig = replace(sample_rig(), rover_T_mast=MAST if known else None)
    given = replace(sample, rig=replace(sample.rig, rover_T_mast=MAST if known else None))
    assert use_rig(given, written(tmp_path, rig)).rig.name == rig.name
    other = replace(rig, pan_T_tilt=turned * rig.pan_T_tilt)
    with pytest.raises(InputError, match=r"rig.json: rig: expected cameras near those of .*0.05"):
        use_rig(given, written(tmp_path, other))


def with_eye(rig: Rig, **changes: Any) -> Rig:
    return replace(rig, eyes=(replace(rig.eyes[0], **changes), *rig.eyes[1:]))


def test_the_rig_of_another_unit_is_refused(tmp_path: Path) -> None:
    sample, rig = (
        io_samples.traverse(),
        replace(sample_rig(), uncertainty=io_samples.traverse().rig.uncertainty),
    )
    labelled = replace(sample, rig=with_eye(sample.rig, unit="HOST pinhole 8"))
    with pytest.raises(
        InputError, match=r"rig.json: rig.cameras: pinhole: expected the unit HOST pinhole 8 as"
    ):
        use_rig(labelled, written(tmp_path, rig))
    use_rig(sample, written(tmp_path, rig))  # whose labels say nothing
    with pytest.raises(
        InputError, match="expected pinhole, which the traverse has images of; found x, brown"
    ):
        use_rig(sample, written(tmp_path, with_eye(rig, name="x")))
    large = replace(rig.eyes[0].camera, width_px=128)
    with pytest.raises(
        InputError, match="pinhole: expected images of 64 x 48 px as in the traverse, found 128"
    ):
        use_rig(sample, written(tmp_path, with_eye(rig, camera=large)))


def test_the_rig_of_a_solution_that_failed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match="passed: expected the rig of a solution that passed its tests, found"
    ):
        read_rig(written(tmp_path, sample_rig(), passed=False))


def test_pictures_that_a_rig_was_calibrated_with_are_refused(tmp_path: Path) -> None:
    sample = io_samples.traverse()
    digests = picture_digests(sample)
    assert len(set(digests)) == len(digests)
    path = written(tmp_path, sample_rig((digests[3], digests[5])))
    expected = "pictures: expected others than those that the rig was calibrated with, found"
    with pytest.raises(InputError, match=f"rig.json: {expected} {sample.images[3].id} and 1 more"):
        use_rig(sample, path)
    folder = tmp_path / "pasted"
    write_traverse(replace(sample, rig=sample_rig((digests[3],))), folder)
    with pytest.raises(InputError, match=f"traverse.json: rig.uncertainty.covariance: {expected}"):
        read_input(folder)


def test_a_picture_is_known_by_its_file(tmp_path: Path) -> None:
    def digest(content: bytes) -> str:
        (tmp_path / "a.png").write_bytes(content)
        sample = io_samples.traverse(folder=tmp_path)
        first = replace(sample.images[0], file="a.png")
        given: Traverse = replace(sample, images=(first, *sample.images[1:]))
        return picture_digests(given)[0]

    assert digest(b"one") == digest(b"one")
    assert digest(b"one") != digest(b"two")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda c: c["matrix"].pop(), r"covariance: matrix\[0\]: expected 54 numbers, as there are rows"),
        (lambda c: c["entries"].pop(), "covariance: matrix: expected 54 x 54 numbers, one row an entry"),
        (lambda c: c["matrix"][0].__setitem__(1, 1.0), "covariance: matrix: expected a symmetric matrix"),
        (lambda c: c["matrix"][0].__setitem__(0, -1.0), "covariance: matrix: expected variances above 0"),
        (
            lambda c: c["matrix"][0].__setitem__(1, float("nan")),
            r"covariance.matrix\[0\]\[1\]: expected a finite",
        ),
        (lambda c: c["entries"][0].__setitem__("camera", "bown"), "covariance: .*'bown'; is 'brown' meant?"),
    ],
)
def test_a_malformed_covariance_is_refused_in_a_sentence(tmp_path: Path, change: Any, sentence: str) -> None:
    path = written(tmp_path, sample_rig())
    tree = json.loads(path.read_text())
    change(tree["rig"]["uncertainty"]["covariance"])
    path.write_text(json.dumps(tree))
    with pytest.raises(InputError, match=sentence) as refused:
        read_rig(path)
    assert "\n" not in str(refused.value)
