"""Traverse folders: what is written is what is read."""

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pancam_graph import Freedom, Image, Observations, Sharing, Traverse
from pancam_graph.base.errors import InputError
from pancam_graph.cameras import CAHV, Camera, Pinhole
from pancam_graph.io import read_input, read_traverse, write_traverse
from pancam_graph.io._input_format import InputFormat
from pancam_graph.io._pds import PDS3
from pancam_graph.io._traverse_json import TRAVERSE_FOLDER
from pancam_graph.rigs import TEMPLATES
from support import io_samples

from dataclasses import fields, replace  # isort: skip


def assert_same_camera(found: Camera, expected: Camera) -> None:
    assert type(found) is type(expected)
    for name in (f.name for f in fields(expected)):
        a, b = np.asarray(getattr(found, name)), np.asarray(getattr(expected, name))
        # A vector is as exact as its largest number: head frame and camera frame mix them.
        scale = np.abs(b).max(initial=1.0) if b.dtype.kind == "f" else 1.0
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * scale, err_msg=name)


def assert_same(found: Traverse, expected: Traverse) -> None:
    assert (found.name, found.rig.name) == (expected.name, expected.rig.name)
    assert (found.frames, found.images) == (expected.frames, expected.images)
    assert found.sharing == expected.sharing
    for a, b in zip(found.stops, expected.stops, strict=True):
        assert (a.id, a.sigma_rotation_rad, a.sigma_translation_m) == (
            b.id,
            b.sigma_rotation_rad,
            b.sigma_translation_m,
        )
        np.testing.assert_allclose(
            a.world_T_mast.rotation().matrix(), b.world_T_mast.rotation().matrix(), rtol=0, atol=3e-15
        )
        np.testing.assert_array_equal(a.world_T_mast.translation(), b.world_T_mast.translation())
    for eye, other in zip(found.rig.eyes, expected.rig.eyes, strict=True):
        assert eye.name == other.name
        assert_same_camera(eye.camera, other.camera)
        np.testing.assert_allclose(
            eye.head_T_camera.matrix(), other.head_T_camera.matrix(), rtol=0, atol=1e-14
        )
    if expected.observations is None:
        assert found.observations is None
        return
    assert found.observations is not None
    for name in ("image", "track", "uv_px", "sigma_px", "covariance_px2"):
        np.testing.assert_array_equal(getattr(found.observations, name), getattr(expected.observations, name))


def test_all_camera_models_return(tmp_path: Path) -> None:
    expected = io_samples.traverse()
    write_traverse(expected, tmp_path)
    assert_same(read_traverse(tmp_path), expected)
    assert_same(read_input(str(tmp_path)), expected)


def test_a_camera_that_is_not_registered_is_not_written(tmp_path: Path) -> None:
    """As a pinhole, which it inherits from, it would lose what it has of its own."""

    class OwnLens(Pinhole):
        pass

    sample = io_samples.traverse()
    numbers: dict[str, Any] = {"fx_px": 70.0, "fy_px": 71.5, "cx_px": 31.5, "cy_px": 23.25}
    eye = replace(sample.rig.eyes[0], camera=OwnLens(**io_samples.SIZE, **numbers))
    made = replace(sample, rig=replace(sample.rig, eyes=(eye, *sample.rig.eyes[1:])))
    with pytest.raises(InputError) as caught:
        write_traverse(made, tmp_path / "out")
    expected = "camera pinhole: expected pinhole, brown, cahv, cahvor or cahvore, found OwnLens"
    assert str(caught.value) == expected
    assert not (tmp_path / "out").exists()


def test_cahv_vectors_are_written_in_the_head_frame(tmp_path: Path) -> None:
    write_traverse(io_samples.traverse(), tmp_path)
    cameras = json.loads((tmp_path / "traverse.json").read_text())["rig"]["cameras"]
    assert [c["model"] for c in cameras] == ["pinhole", "brown", "cahv", "cahvor", "cahvore"]
    vectors = io_samples.cahv_vectors()
    for camera in cameras[2:]:
        for key, name in (("C_m", "C"), ("A", "A"), ("H_px", "H"), ("V_px", "V")):
            np.testing.assert_allclose(camera[key], vectors[name], rtol=0, atol=1e-13)
    assert set(cameras[4]) - set(cameras[3]) == {"E", "linearity"}
    assert set(cameras[3]) - set(cameras[2]) == {"O", "R"}


def test_a_read_eye_projects_as_its_head_model_does(tmp_path: Path) -> None:
    write_traverse(io_samples.traverse(), tmp_path)
    head_points = np.array([[5.0, 0.3, -0.2], [2.0, -0.4, 0.3]])
    eye = read_traverse(tmp_path).rig.eyes[2]
    camera_points = (head_points - eye.head_T_camera.translation()) @ eye.head_T_camera.rotation().matrix()
    expected, _ = CAHV(**io_samples.SIZE, **io_samples.cahv_vectors()).project(head_points)
    np.testing.assert_allclose(eye.camera.project(camera_points)[0], expected, atol=1e-10)


finite = st.floats(-1e6, 1e6, allow_nan=False)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.tuples(quaternions, st.tuples(finite, finite, finite)))
def test_any_pose_returns(tmp_path: Path, pose: tuple[tuple[float, ...], tuple[float, float, float]]) -> None:
    wxyz = np.array(pose[0]) / np.linalg.norm(pose[0])
    world_T_mast = gtsam.Pose3(gtsam.Rot3(*wxyz), np.array(pose[1]))
    expected = io_samples.traverse(poses=(world_T_mast,))
    write_traverse(expected, tmp_path, overwrite=True)
    assert_same(read_traverse(tmp_path), expected)


@pytest.mark.parametrize("template", TEMPLATES)
def test_template_by_name(tmp_path: Path, template: str) -> None:
    rig = TEMPLATES[template]()
    sample = io_samples.traverse()
    images = tuple(
        Image(id=f"{f.id}_{e.name}", frame=f.id, camera=e.name) for f in sample.frames for e in rig.eyes
    )
    assert sample.observations is not None
    observations = sample.observations.select(sample.observations.image < len(images))
    write_traverse(replace(sample, rig=rig, images=images, observations=observations), tmp_path)
    own = read_traverse(tmp_path)
    path = tmp_path / "traverse.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps(data | {"rig": {"template": template}}))
    assert_same(read_traverse(tmp_path), own)


def test_what_may_be_left_out_of_the_file(tmp_path: Path) -> None:
    write_traverse(io_samples.traverse(), tmp_path)
    path = tmp_path / "traverse.json"
    data = json.loads(path.read_text())
    del data["name"], data["rig"]["name"], data["rig"]["cameras"][0]["skew_px"], data["images"][0]["file"]
    path.write_text(json.dumps(data), encoding="utf-8-sig")
    found = read_traverse(tmp_path)
    assert found.name == tmp_path.name
    assert found.rig.pinholes[0].skew_px == 0
    assert found.images[0].file is None


SIGMA = st.floats(1e-300, 1e300) | st.just(np.inf)
MOUNTS = st.fixed_dictionaries({}, optional=dict.fromkeys(("rx_rad", "x_m", "z_m"), SIGMA))
SHARINGS = st.builds(
    Sharing,
    calibration=st.sampled_from(
        [
            Freedom(),
            Freedom(scope="all"),
            Freedom(scope="image", free=("cy_px", "focal"), sigma={"focal": 0.1 + 0.2}),
        ]
    ),
    mounts=MOUNTS.map(lambda sigma: Freedom(scope="stop", free=("z_m", "x_m", "rx_rad"), sigma=sigma)),
    pan_T_tilt=st.sampled_from([Freedom(), Freedom(scope="all", free=("y_m",))]),
    radius=st.sampled_from([None, Freedom(), Freedom(scope="eye", sigma={"radius_m": 1e-3})]),
)


@settings(
    max_examples=15,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(SHARINGS)
def test_any_sharing_returns(tmp_path: Path, sharing: Sharing) -> None:
    expected = replace(io_samples.traverse(), sharing=sharing)
    write_traverse(expected, tmp_path, overwrite=True)
    assert_same(read_traverse(tmp_path), expected)


def test_a_sharing_in_the_file(tmp_path: Path) -> None:
    write_traverse(io_samples.traverse(), tmp_path)
    path = tmp_path / "traverse.json"
    data = json.loads(path.read_text())
    assert "sharing" not in data  # where nothing is said, nothing is written
    data["sharing"] = {
        "calibration": {"scope": "eye", "free": ["focal"], "sigma": {"focal": None}},
        "radius": None,
    }
    path.write_text(json.dumps(data))
    assert read_traverse(tmp_path).sharing == Sharing(
        calibration=Freedom(scope="eye", free=("focal",), sigma={"focal": np.inf})
    )


def test_a_quaternion_of_another_length_is_the_same_rotation(tmp_path: Path) -> None:
    write_traverse(io_samples.traverse(), tmp_path)
    path = tmp_path / "traverse.json"
    data = json.loads(path.read_text())
    pose = data["stops"][1]["world_T_mast"]
    pose["rotation_wxyz"] = [-3 * q for q in pose["rotation_wxyz"]]
    path.write_text(json.dumps(data))
    assert_same(read_traverse(tmp_path), io_samples.traverse())


def test_csv_observations(tmp_path: Path) -> None:
    expected = io_samples.traverse()
    write_traverse(expected, tmp_path)
    path = tmp_path / "traverse.json"
    path.write_text(path.read_text().replace("observations.npz", "observations.csv"))
    obs = expected.observations
    assert obs is not None
    with (tmp_path / "observations.csv").open("w", newline="", encoding="utf-8-sig") as file:
        writer = csv.writer(file)
        writer.writerow(["track", "image", "note", "v_px", "u_px", "sigma_px"])
        for row in range(len(obs)):
            u, v = obs.uv_px[row].tolist()
            writer.writerow([obs.track[row], obs.image[row], "a, b", repr(v), repr(u), obs.sigma_px[row]])
    assert_same(read_traverse(tmp_path), expected)


def with_covariances() -> tuple[Traverse, Observations]:
    sample = io_samples.traverse()
    assert sample.observations is not None
    observations = sample.observations.with_covariance(io_samples.covariances(len(sample.observations)))
    return sample.with_observations(observations), observations


def test_covariances_return(tmp_path: Path) -> None:
    expected, obs = with_covariances()
    write_traverse(expected, tmp_path)
    assert_same(read_traverse(tmp_path), expected)
    assert obs.covariance_px2 is not None
    np.savez(  # without sigma_px, which follows from them
        tmp_path / "observations.npz",
        image=obs.image,
        track=obs.track,
        uv_px=obs.uv_px,
        covariance_px2=obs.covariance_px2,
    )
    assert_same(read_traverse(tmp_path), expected)


@pytest.mark.parametrize("with_sigma", [False, True])
def test_csv_covariances(tmp_path: Path, with_sigma: bool) -> None:
    expected, obs = with_covariances()
    write_traverse(expected, tmp_path)
    path = tmp_path / "traverse.json"
    path.write_text(path.read_text().replace("observations.npz", "observations.csv"))
    assert obs.covariance_px2 is not None
    names = ["cov_vv_px2", "image", "track", "u_px", "v_px", "cov_uu_px2", "cov_uv_px2"]
    columns = [
        obs.covariance_px2[:, 1, 1],
        obs.image,
        obs.track,
        *obs.uv_px.T,
        *obs.covariance_px2[:, 0].T,
    ]
    if with_sigma:
        names.append("sigma_px")
        columns.append(obs.sigma_px)
    with (tmp_path / "observations.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows(zip(*(map(repr, c.tolist()) for c in columns), strict=True))
    assert_same(read_traverse(tmp_path), expected)


def test_other_integers_and_floats_are_taken(tmp_path: Path) -> None:
    expected = io_samples.traverse()
    write_traverse(expected, tmp_path)
    obs = expected.observations
    assert obs is not None
    np.savez(
        tmp_path / "observations.npz",
        image=obs.image.astype(np.uint8),
        track=obs.track.astype(">i4"),
        uv_px=np.round(obs.uv_px).astype(np.int16),
        sigma_px=np.ones(len(obs), dtype=np.float32),
        extra=np.array([None], dtype=object),
    )
    found = read_traverse(tmp_path).observations
    assert found is not None
    assert {found.image.dtype, found.track.dtype} == {np.dtype(np.int64)}
    assert {found.uv_px.dtype, found.sigma_px.dtype} == {np.dtype(np.float64)}
    np.testing.assert_array_equal(found.uv_px, np.round(obs.uv_px))


def with_images(folder: Path) -> Traverse:
    """A traverse whose first image has a file, in a folder of its own."""
    (folder / "pictures").mkdir(parents=True)
    cv2.imwrite(str(folder / "pictures" / "a.png"), np.full((48, 64), 7, dtype=np.uint8))
    sample = io_samples.traverse(folder=folder)
    first = replace(sample.images[0], file="pictures/a.png")
    return replace(sample, images=(first, *sample.images[1:]))


def test_observations_to_be_found_in_images(tmp_path: Path) -> None:
    expected = replace(with_images(tmp_path), observations=None)
    write_traverse(expected, tmp_path)
    assert not (tmp_path / "observations.npz").exists()
    found = read_traverse(tmp_path)
    assert_same(found, expected)
    assert found.folder == tmp_path


def test_image_files_are_copied_to_another_folder(tmp_path: Path) -> None:
    expected = with_images(tmp_path / "here")
    write_traverse(expected, tmp_path / "deep" / "there")
    assert_same(read_traverse(tmp_path / "deep" / "there"), expected)
    (tmp_path / "here" / "pictures" / "a.png").unlink()
    with pytest.raises(InputError, match=r"a\.png: .* to copy along, found nothing there"):
        write_traverse(expected, tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_an_older_traverse_is_overwritten_only_on_request(tmp_path: Path) -> None:
    write_traverse(io_samples.traverse(), tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    with pytest.raises(InputError, match=r"traverse\.json: expected a folder without a traverse"):
        write_traverse(replace(io_samples.traverse(), name="other"), tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    write_traverse(replace(io_samples.traverse(), name="other"), tmp_path, overwrite=True)
    assert read_traverse(tmp_path).name == "other"
    assert {p.name for p in tmp_path.iterdir()} == set(before)


def test_writing_where_a_file_is(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="expected a folder to write to"):
        write_traverse(io_samples.traverse(), tmp_path / "file")


@pytest.mark.parametrize("name", ["1N49.IMG", "1n49.img", "1N49.LBL"])
def test_rover_images_go_to_the_pds_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    expected = io_samples.traverse()
    made_up = replace(PDS3, read=lambda root, folders: {tmp_path: expected}[folders[0]])
    monkeypatch.setattr("pancam_graph.io._inputs.FORMATS", (TRAVERSE_FOLDER, made_up))
    (tmp_path / name).write_bytes(b"")
    assert read_input(tmp_path) is expected
    write_traverse(expected, tmp_path)  # a traverse beside the images says what to make of them
    assert read_input(tmp_path) is not expected


def test_a_format_more_is_read_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error says what every format needs, and a folder goes to the first format that takes it."""
    expected = io_samples.traverse()
    made_up = InputFormat(
        needs="a plan", matches=lambda names: "plan.txt" in names, read=lambda root, folders: expected
    )
    monkeypatch.setattr("pancam_graph.io._inputs.FORMATS", (TRAVERSE_FOLDER, made_up))
    (tmp_path / "notes.txt").write_bytes(b"")
    with pytest.raises(InputError, match=r"a folder with traverse\.json or with a plan, found notes\.txt$"):
        read_input(tmp_path)
    (tmp_path / "plan.txt").write_bytes(b"")
    assert read_input(tmp_path) is expected


def test_names_that_the_format_does_not_take(tmp_path: Path) -> None:
    sample = io_samples.traverse()
    odd = replace(sample, images=(replace(sample.images[0], id="a\nb"), *sample.images[1:]))
    with pytest.raises(InputError, match=r'traverse\.json: id: expected a string of one line.*"a\\nb"'):
        write_traverse(odd, tmp_path / "new")
    assert not (tmp_path / "new").exists()
