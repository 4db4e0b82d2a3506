"""PDS labels to a traverse: images of Opportunity."""

import re
from pathlib import Path

import numpy as np
import pytest

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import rotation_from_wxyz
from pancam_graph.cameras import CAHVOR
from pancam_graph.data import Traverse
from pancam_graph.io import read_pds
from pancam_graph.io._pds_label import read_label
from support.rover_labels import FLIP, misfits


@pytest.fixture(scope="module")
def opportunity(opportunity_folder: Path) -> Traverse:
    return read_pds(opportunity_folder)


def test_opportunity_is_one_stop_five_frames_one_eye(opportunity: Traverse, opportunity_folder: Path) -> None:
    traverse = opportunity
    assert [s.id for s in traverse.stops] == ["site195-drive973"]
    assert (traverse.stops[0].sigma_rotation_rad, traverse.stops[0].sigma_translation_m) == (0.0, 0.0)
    assert [f.id for f in traverse.frames] == [f"195-973-{k}" for k in (25, 26, 28, 29, 30)]
    assert [e.name for e in traverse.rig.eyes] == ["navcam-left"]
    camera = traverse.rig.eyes[0].camera
    assert type(camera) is CAHVOR
    assert (camera.width_px, camera.height_px) == (1024, 1024)
    assert traverse.observations is None
    assert traverse.folder == opportunity_folder
    assert all(i.file and (opportunity_folder / i.file).is_file() for i in traverse.images)
    assert traverse.warnings == ()


def test_opportunity_rig_reproduces_the_labels(opportunity: Traverse) -> None:
    centre, axis, rotation = misfits(opportunity)
    assert centre < 5e-6
    assert axis < 5e-6
    assert rotation < 5e-6


def test_opportunity_angles_are_the_encoders_plus_their_offsets(
    opportunity: Traverse, opportunity_folder: Path
) -> None:
    # Pan is anticlockwise, the label's azimuth clockwise. The encoders' offsets, 0.267 and
    # 3.59 degrees, were measured on these very labels: the test proves signs and names, not the offsets.
    traverse = opportunity
    for frame, image in zip(traverse.frames, traverse.images, strict=True):
        measured = (
            read_label(opportunity_folder / str(image.file)).group("PMA_ARTICULATION_STATE").angles_rad()
        )
        pan = -measured["AZIMUTH-MEASURED"] - np.deg2rad(0.267)
        tilt = measured["ELEVATION-MEASURED"] + np.deg2rad(3.59)
        assert frame.pan_rad == pytest.approx(pan, abs=2e-4)
        assert frame.tilt_rad == pytest.approx(tilt, abs=2e-4)
        assert frame.sigma_pan_rad == pytest.approx(np.deg2rad(0.077))


def test_opportunity_projects_as_its_labels_do(opportunity: Traverse, opportunity_folder: Path) -> None:
    # Through the whole chain: points of the world to pixels, by the rig and by each label's own vectors.
    traverse = opportunity
    rotations, centres = traverse.camera_poses()
    camera = traverse.rig.eyes[0].camera
    pixels = np.array([[100.0, 200.0], [512.0, 512.0], [900.0, 1000.0], [50.0, 980.0]])
    for image, rotation, centre in zip(traverse.images, rotations, centres, strict=True):
        label = read_label(opportunity_folder / str(image.file))
        group, rover = label.group("GEOMETRIC_CAMERA_MODEL"), label.group("ROVER_COORDINATE_SYSTEM")
        c, a, h, v, o, r = (group.numbers(f"MODEL_COMPONENT_{k}", 3) for k in range(1, 7))
        model = CAHVOR(width_px=1024, height_px=1024, C=c, A=a, H=h, V=v, O=o, R=r)
        points = centre + 20 * (camera.unproject(pixels).direction @ rotation.T)
        site_R_rover = rotation_from_wxyz(rover.numbers("ORIGIN_ROTATION_QUATERNION", 4))
        in_rover = (points @ FLIP - rover.numbers("ORIGIN_OFFSET_VECTOR", 3)) @ site_R_rover
        found, valid = model.project(in_rover)
        assert valid.all()
        np.testing.assert_allclose(found, pixels, atol=0.02)


def test_truncated_opportunity_image_is_named(opportunity_folder: Path, tmp_path: Path) -> None:
    name = "1N491020376ILFCNY9P0706L0M1.IMG"
    (tmp_path / name).write_bytes((opportunity_folder / name).read_bytes()[:-1])
    said = rf"{name}: \^IMAGE: expected 2140160 bytes or more .* found 2140159"
    with pytest.raises(ImageError, match=said):
        read_pds(tmp_path)
    for other in sorted(opportunity_folder.glob("*.IMG"))[1:3]:
        (tmp_path / other.name).write_bytes(other.read_bytes())
    rest = read_pds(tmp_path)
    assert len(rest.images) == 2
    assert re.fullmatch(rf"image {Path(name).stem} is left out: .*{said}.*", rest.warnings[0])


def test_opportunity_label_without_camera_model_is_named(opportunity_folder: Path, tmp_path: Path) -> None:
    name = "1N491020376ILFCNY9P0706L0M1.IMG"
    data = (opportunity_folder / name).read_bytes()
    (tmp_path / name).write_bytes(data.replace(b"GEOMETRIC_CAMERA_MODEL", b"GEOMETRIC_CAMERA_OTHER"))
    with pytest.raises(InputError, match=f"{name}: expected a group GEOMETRIC_CAMERA_MODEL"):
        read_pds(tmp_path)
