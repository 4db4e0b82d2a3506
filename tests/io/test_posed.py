"""Cameras that other programs placed: read as the formats' own equations say, and taken for a start.

Not shown: files of the programs themselves, but for a binary model that COLMAP's own library writes, where it
is installed.
"""

import struct
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, simulate
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, so3_exp, wrap_angle, wxyz_from_rotation
from pancam_graph.cameras import as_cahv
from pancam_graph.cli import main
from pancam_graph.cli._refine import started
from pancam_graph.data import Traverse
from pancam_graph.initialise import start_from_poses
from pancam_graph.io import cahvor_text, write_traverse
from pancam_graph.io.posed import PosedCamera, images_of, read_posed
from pancam_graph.io.vicar import NavEntry, nav_text
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import Simulation

SCALE, TURN, SHIFT = 0.37, np.array([0.4, -1.1, 2.0]), np.array([3.0, -7.0, 0.5])
"""World of the other program: x' = SCALE exp(TURN) x + SHIFT."""
OPENCV = "7 OPENCV 640 480 500 501 320.5 240.5 -0.1 0.02 0.001 -0.002"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(17)


@pytest.fixture(scope="module")
def drive() -> Simulation:
    options = SimulationOptions(
        stops=2, spacing_m=4.0, pans=4, tilts_rad=(-0.2, 0.1), points_per_image=10, noise_px=0.0
    )
    return simulate(mer_navcam(), options)


@pytest.fixture
def named(drive: Simulation) -> Traverse:
    images = tuple(replace(i, file=f"images/{i.id}.png") for i in drive.traverse.images)
    return replace(drive.traverse, images=images)


def elsewhere(drive: Simulation) -> list[gtsam.Pose3]:
    """True poses of all images in the other world."""
    t, turn = drive.traverse, so3_exp(TURN)
    poses = []
    for image in range(len(t.images)):
        frame = int(t.image_frame[image])
        mast = drive.truth.world_T_mast[int(t.frame_stop[frame])]
        pan_tilt = drive.truth.pan_tilt_rad[frame][None]
        R, c = t.rig.mast_T_camera(pan_tilt, t.image_eye[[image]])
        pose = mast * gtsam.Pose3(gtsam.Rot3(R[0]), c[0])
        rotation = turn @ pose.rotation().matrix()
        poses.append(gtsam.Pose3(gtsam.Rot3(rotation), SCALE * turn @ pose.translation() + SHIFT))
    return poses


def row(values: FloatArray) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def write_colmap_text(folder: Path, names: list[str], poses: list[gtsam.Pose3]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(f"# cameras\n{OPENCV}\n")
    lines = ["# images"]
    for n, (name, pose) in enumerate(zip(names, poses, strict=True), 1):
        back = pose.inverse()
        wxyz = row(wxyz_from_rotation(back.rotation().matrix()))
        lines += [f"{n} {wxyz} {row(back.translation())} 7 {name}", "1.5 2.5 -1" if n % 2 else ""]
    (folder / "images.txt").write_text("\n".join([*lines, ""]))
    (folder / "points3D.txt").write_text("")


def write_colmap_binary(folder: Path, names: list[str], poses: list[gtsam.Pose3]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    numbers = [float(word) for word in OPENCV.split()[4:]]
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ8d", 1, 7, 4, 640, 480, *numbers))
    parts = [struct.pack("<Q", len(names))]
    for n, (name, pose) in enumerate(zip(names, poses, strict=True), 1):
        back = pose.inverse()
        numbers = [*wxyz_from_rotation(back.rotation().matrix()), *back.translation()]
        parts += [struct.pack("<I7dI", n, *numbers, 7), name.encode(), b"\0"]
        parts += [struct.pack("<Q", 1), struct.pack("<ddq", 1.5, 2.5, -1)]
    (folder / "images.bin").write_bytes(b"".join(parts))


def write_bundler(folder: Path, names: list[str], poses: list[gtsam.Pose3]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Bundle file v0.3", f"{len(names)} 0"]
    for pose in poses:
        R = np.diag([1.0, -1.0, -1.0]) @ pose.rotation().matrix().T
        lines += ["500.0 -0.1 0.02", *(row(r) for r in R), row(-R @ pose.translation())]
    (folder / "bundle.out").write_text("\n".join([*lines, ""]))
    (folder / "list.txt").write_text("".join(f"{name} 0 500.0\n" for name in names))


def write_cahvor(folder: Path, names: list[str], poses: list[gtsam.Pose3]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    model = as_cahv(mer_navcam().eyes[0].camera)
    for name, pose in zip(names, poses, strict=True):
        text = cahvor_text(model.transformed(pose))
        (folder / f"{Path(name).stem}.cahvor").write_text(text)


WRITERS = {
    "colmap text": write_colmap_text,
    "colmap binary": write_colmap_binary,
    "bundler": write_bundler,
    "cahvor": write_cahvor,
}


@pytest.mark.parametrize("form", WRITERS)
def test_poses_of_every_format_are_a_start(
    form: str, drive: Simulation, named: Traverse, tmp_path: Path
) -> None:
    names = [str(image.file) for image in named.images]
    WRITERS[form](tmp_path, names, elsewhere(drive))
    cameras = read_posed(tmp_path)
    known, warnings = images_of(named, cameras)
    assert sorted(known) == list(range(len(names)))
    assert warnings == []
    start = start_from_poses(named, {k: camera.world_T_camera for k, camera in known.items()})
    off = wrap_angle(start.pan_tilt_rad - drive.truth.pan_tilt_rad)
    for stop in (0, 1):
        of = off[named.frame_stop == stop]
        np.testing.assert_allclose(of[:, 0], of[0, 0], atol=1e-8)  # pans count from the told ones
        np.testing.assert_allclose(of[:, 1], 0, atol=1e-8)
    first = start.world_T_mast[0]
    assert first.equals(named.stops[0].world_T_mast, 1e-9)
    found = start.world_T_mast[0].inverse() * start.world_T_mast[1]
    true = drive.truth.world_T_mast[0].inverse() * drive.truth.world_T_mast[1]
    assert np.linalg.norm(found.translation()) == pytest.approx(np.linalg.norm(true.translation()), rel=0.1)
    # Pans of a stop have telemetry's mean, and its mast is turned back by as much.
    mean = [float(off[named.frame_stop == stop, 0].mean()) for stop in (0, 1)]
    undone = [gtsam.Pose3(gtsam.Rot3.Rz(turn), np.zeros(3)) for turn in mean]
    chain = undone[0].inverse() * found * undone[1]
    np.testing.assert_allclose(chain.rotation().matrix(), true.rotation().matrix(), atol=1e-8)


def test_a_start_from_some_images_keeps_what_is_told_of_the_others(
    drive: Simulation, named: Traverse
) -> None:
    poses = elsewhere(drive)
    first = np.flatnonzero(named.image_stop == 0)
    start = start_from_poses(named, {int(k): poses[k] for k in first[:6]})
    assert start.world_T_mast[1].equals(named.stops[1].world_T_mast, 0)
    others = np.setdiff1d(np.arange(len(named.frames)), named.image_frame[first[:6]])
    np.testing.assert_array_equal(start.pan_tilt_rad[others], named.pan_tilt_rad[others])


def test_colmap_projects_as_its_documentation_says(tmp_path: Path, rng: np.random.Generator) -> None:
    pose = gtsam.Pose3(gtsam.Rot3(so3_exp(TURN)), SHIFT)
    write_colmap_text(tmp_path, ["a b.png"], [pose])
    (found,) = read_posed(tmp_path)
    assert found.name == "a b.png"
    assert found.camera is not None
    points = pose.transformFrom((rng.normal(size=(20, 3)) * [1, 1, 0.5] + [0, 0, 4]).T).T
    inside = found.world_T_camera.transformTo(points.T).T
    uv, valid = found.camera.project(inside)
    assert valid.all()
    x, y = (inside[:, :2] / inside[:, 2:]).T
    r2 = x**2 + y**2
    radial = 1 - 0.1 * r2 + 0.02 * r2**2
    u = 500 * (x * radial + 2 * 0.001 * x * y - 0.002 * (r2 + 2 * x**2)) + 320.5
    v = 501 * (y * radial + 0.001 * (r2 + 2 * y**2) - 2 * 0.002 * x * y) + 240.5
    np.testing.assert_allclose(uv, np.column_stack([u, v]) - 0.5, atol=1e-9)


def test_bundler_looks_as_its_manual_says(tmp_path: Path, rng: np.random.Generator) -> None:
    R, t = so3_exp(np.array([0.3, 2.0, -0.4])), np.array([0.5, 1.0, -4.0])
    lines = ["# Bundle file v0.3", "2 0", "500 0 0", *(row(r) for r in R), row(t), "0 0 0", *["0 0 0"] * 4]
    (tmp_path / "bundle.out").write_text("\n".join([*lines, ""]))
    (tmp_path / "list.txt").write_text("one.jpg\ntwo.jpg\n")
    (found,) = read_posed(tmp_path)  # the second was not placed
    assert found.name == "one.jpg"
    points = rng.normal(size=(20, 3))
    P = points @ R.T + t
    right_up = -P[:, :2] / P[:, 2:]
    inside = found.world_T_camera.transformTo(points.T).T
    ahead = P[:, 2] < 0
    np.testing.assert_array_equal(inside[:, 2] > 0, ahead)
    np.testing.assert_allclose(inside[:, :2] / inside[:, 2:], right_up * [1, -1], atol=1e-12)


def test_a_binary_model_of_colmap_itself(drive: Simulation, named: Traverse, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    names = [str(image.file) for image in named.images]
    write_colmap_text(tmp_path / "text", names, elsewhere(drive))
    (tmp_path / "binary").mkdir()
    pycolmap.Reconstruction(str(tmp_path / "text")).write_binary(str(tmp_path / "binary"))
    text, binary = (read_posed(tmp_path / kind) for kind in ("text", "binary"))
    by_name = {camera.name: camera for camera in binary}
    for camera in text:
        assert camera.world_T_camera.equals(by_name[camera.name].world_T_camera, 1e-9)
        assert camera.camera == by_name[camera.name].camera


def test_names_that_are_of_no_image_or_of_several(named: Traverse) -> None:
    pose = gtsam.Pose3()
    first, second = named.images[:2]
    cameras = [
        PosedCamera(name=f"{Path(str(first.file)).name}", world_T_camera=pose, camera=None),
        PosedCamera(name=f"x/{second.id}.jpg", world_T_camera=pose, camera=None),
        PosedCamera(name="other.png", world_T_camera=pose, camera=None),
    ]
    known, warnings = images_of(named, cameras)
    assert sorted(known) == [0, 1]
    assert warnings == [f"cameras of no picture of {named.name} are left out: other.png"]
    with pytest.raises(InputError, match=r"expected cameras of pictures of .*, found others: other\.png"):
        images_of(named, cameras[2:])
    double = replace(named, images=tuple(replace(i, file=f"{i.camera}/a.png") for i in named.images))
    with pytest.raises(InputError, match=r"found others: a\.png"):
        images_of(double, [PosedCamera(name="a.png", world_T_camera=pose, camera=None)])


def test_cameras_of_another_drive_are_refused(drive: Simulation, named: Traverse) -> None:
    poses = dict(enumerate(elsewhere(drive)))
    shuffled = {k: poses[(7 * k + 3) % len(poses)] for k in poses}
    with pytest.raises(InputError, match="expected cameras that look as telemetry says"):
        start_from_poses(named, shuffled)
    with pytest.raises(InputError, match=r"found all at one place|found them elsewhere"):
        start_from_poses(named, {k: gtsam.Pose3(p.rotation(), np.zeros(3)) for k, p in poses.items()})
    with pytest.raises(InputError, match="found none"):
        start_from_poses(named, {})


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("cameras.txt", "OPENCV", "FISHEYE", r"cameras\.txt: line 2: model: expected one of SIMPLE_PINHOLE"),
        ("cameras.txt", "-0.002", "", r"cameras\.txt: line 2: expected 8 numbers of a OPENCV, found 7"),
        ("cameras.txt", "7 OPENCV", "8 OPENCV", r"images\.txt: line 2: expected the number of a camera"),
        ("cameras.txt", "640", "0", r"cameras\.txt: line 2: expected width and height in pixels"),
        ("images.txt", "1 ", "1 x", r"images\.txt: line 2: expected numbers, found"),
        ("images.txt", " 7 a.png", "", r"images\.txt: line 2: expected IMAGE_ID QW"),
    ],
)
def test_what_is_wrong_with_a_model_is_said(file: str, old: str, new: str, says: str, tmp_path: Path) -> None:
    write_colmap_text(tmp_path, ["a.png"], [gtsam.Pose3()])
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=says):
        read_posed(tmp_path)


def test_folders_without_cameras(tmp_path: Path) -> None:
    for path, says in ((tmp_path, "found none of them"), (tmp_path / "no", "found nothing there")):
        with pytest.raises(InputError, match=says):
            read_posed(path)
    write_colmap_binary(tmp_path / "sparse" / "0", ["a.png"], [gtsam.Pose3()])
    assert [camera.name for camera in read_posed(tmp_path)] == ["a.png"]
    images = tmp_path / "sparse" / "0" / "images.bin"
    images.write_bytes(images.read_bytes()[:60])
    with pytest.raises(InputError, match=r"images\.bin: byte 8: expected 1 entries, found 52 bytes"):
        read_posed(tmp_path)


def test_refine_begins_at_the_cameras_of_a_folder(
    drive: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_traverse(drive.traverse, tmp_path / "in")
    names = [image.id for image in drive.traverse.images]
    write_bundler(tmp_path / "bundle", [*names[:-1], "other"], elsewhere(drive))
    command = ["refine", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--no-report"]
    assert main([*command, "--start", str(tmp_path / "bundle")]) == 0
    assert "cameras of no picture" in capsys.readouterr().err
    assert main([*command, "--start", str(tmp_path / "bundle"), "--incremental"]) == 2
    assert "--start: expected without --incremental" in capsys.readouterr().err


def test_pointings_of_marsnav_are_a_start(drive: Simulation, tmp_path: Path) -> None:
    traverse = drive.traverse
    entries = []
    for frame in traverse.image_frame:
        pan, tilt = np.rad2deg(drive.truth.pan_tilt_rad[frame])
        entries.append(
            NavEntry(unique_id=None, original_deg=(0.0, 0.0), pointing_deg=(-pan % 360.0, float(tilt)))
        )
    (tmp_path / "a.nav").write_text(nav_text(entries))
    same, start = started(traverse, tmp_path / "a.nav", incremental=False)
    np.testing.assert_allclose(wrap_angle(start.pan_tilt_rad - drive.truth.pan_tilt_rad), 0, atol=1e-10)
    np.testing.assert_array_equal(same.pan_tilt_rad, traverse.pan_tilt_rad)
    assert all(a.equals(s.world_T_mast, 0) for a, s in zip(start.world_T_mast, traverse.stops, strict=True))
