"""Bad traverse folders: one sentence with file, entry, expected and found; nothing unpickled or written."""

import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.io import read_input, read_traverse, write_traverse
from pancam_graph.results import read_solution_json
from support import io_samples

Change = Callable[[dict[str, Any]], None]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A good traverse folder; the tests spoil it."""
    write_traverse(io_samples.traverse(), tmp_path / "traverse")
    return tmp_path / "traverse"


def refused(folder: Path, *parts: str, kind: type[InputError] = InputError) -> str:
    """The sentence with which a folder is refused, having checked that it has all parts and is one line."""
    before = {p: p.lstat().st_mtime_ns for p in folder.rglob("*")}
    with pytest.raises(kind) as caught:
        read_input(folder)
    assert {p: p.lstat().st_mtime_ns for p in folder.rglob("*")} == before
    text = str(caught.value)
    assert text.startswith(str(folder))
    assert "\n" not in text
    for part in ("expected", "found", *parts):
        assert part in text
    return text


def put(*path: str | int, to: object) -> Change:
    """A change that sets an entry."""

    def change(data: Any) -> None:
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = to

    return change


def drop(*path: str | int) -> Change:
    """A change that removes an entry."""

    def change(data: Any) -> None:
        for key in path[:-1]:
            data = data[key]
        del data[path[-1]]

    return change


CAMERA = ("rig", "cameras", 0)
POSE = ("stops", 1, "world_T_mast")
NOT_A_NUMBER, INFINITY = float("nan"), float("inf")

ENTRIES: dict[str, tuple[Change, str, str]] = {
    # name: change, entry as the sentence names it, what it says was found
    "format": (put("format", to="pancam-graph/solution"), "format", '"pancam-graph/solution"'),
    "no format": (drop("format"), "format", "no such key"),
    "version": (put("version", to=2), "version", "2"),
    "version true": (put("version", to=True), "version", "true"),
    "version text": (put("version", to="1"), "version", '"1"'),
    "missing key": (drop("frames", 3, "sigma_pan_rad"), "frames[3].sigma_pan_rad", "an object without it"),
    "unknown key": (put("frames", 3, "pan_deg", to=3.0), "frames[3].pan_deg", "the unknown key"),
    "number as text": (put("frames", 3, "pan_rad", to="0.1"), "frames[3].pan_rad", '"0.1"'),
    "number true": (put("frames", 3, "tilt_rad", to=True), "frames[3].tilt_rad", "true"),
    "number null": (put("frames", 3, "tilt_rad", to=None), "frames[3].tilt_rad", "null"),
    "not a number": (put("frames", 3, "pan_rad", to=NOT_A_NUMBER), "frames[3].pan_rad", "NaN"),
    "infinite": (put("stops", 1, "sigma_rotation_rad", to=INFINITY), "stops[1].sigma_rotation_rad", "Inf"),
    "infinite position": (put(*POSE, "translation_m", 2, to=-INFINITY), "translation_m[2]", "-Infinity"),
    "huge integer": (put("frames", 3, "pan_rad", to=10**400), "frames[3].pan_rad", "too many digits"),
    "width 64.5": (put(*CAMERA, "width_px", to=64.5), "rig.cameras[0].width_px", "64.5"),
    "width 64.0": (put(*CAMERA, "width_px", to=64.0), "rig.cameras[0].width_px", "64.0"),
    "width 0": (put(*CAMERA, "width_px", to=0), "rig.cameras[0]: image size", "0 x 48"),
    "focal length 0": (put(*CAMERA, "fx_px", to=0), "rig.cameras[0]: focal length", "0.0 and 71.5"),
    "focal length below 0": (put(*CAMERA, "fy_px", to=-71.5), "rig.cameras[0]: focal length", "-71.5"),
    "CAHV focal length 0": (put("rig", "cameras", 2, "H_px", to=[0, 0, 0]), "rig.cameras[2]: focal", "H = ["),
    "CAHV axis 0": (put("rig", "cameras", 3, "A", to=[0, 0, 0]), "rig.cameras[3]: A", "[0.0, 0.0, 0.0]"),
    "CAHVOR axis": (put("rig", "cameras", 3, "O", to=[2, 0, 0]), "rig.cameras[3]: O", "[2.0, 0.0, 0.0]"),
    "mirrored": (
        put("rig", "cameras", 2, "V_px", to=[0, 0, 71]),
        "rig.cameras[2]: A, H, V",
        "a mirrored one",
    ),
    "key of another model": (put(*CAMERA, "C_m", to=[0, 0, 0]), "rig.cameras[0].C_m", "the unknown key"),
    "key of no model": (put("rig", "cameras", 2, "E", to=[0, 0, 0]), "rig.cameras[2].E", "the unknown key"),
    "no vector": (drop("rig", "cameras", 4, "linearity"), "rig.cameras[4].linearity", "without it"),
    "distortion": (put("rig", "cameras", 1, "distortion", to=[0.1]), "rig.cameras[1].distortion", "found 1"),
    "camera model": (put(*CAMERA, "model", to="fisheye"), "rig.cameras[0].model", '"fisheye"'),
    "no camera model": (drop(*CAMERA, "model"), "rig.cameras[0].model", "null"),
    "camera": (put(*CAMERA, to=5), "rig.cameras[0]", "5"),
    "no cameras": (put("rig", "cameras", to=[]), "rig all models", "found none"),
    "camera names": (
        put("rig", "cameras", 1, "name", to="pinhole"),
        "rig all models: expected different camera names",
        "'pinhole' 2 times",
    ),
    "template": (put("rig", to={"template": "lunokhod"}), "rig: template", "'lunokhod'"),
    "template and more": (
        put("rig", to={"template": "mer-navcam", "name": "x"}),
        "rig.name",
        "the unknown key",
    ),
    "template as number": (put("rig", to={"template": 3}), "rig.template", "3"),
    "rig": (put("rig", to="mer-navcam"), "rig", '"mer-navcam"'),
    "quaternion 0": (
        put(*POSE, "rotation_wxyz", to=[0, 0, 0, 0]),
        "stops[1].world_T_mast.rotation_wxyz",
        "[0",
    ),
    "quaternion 0 of mount": (
        put(*CAMERA, "head_T_camera", "rotation_wxyz", to=[0, 0, 0, 0]),
        "rig.cameras[0].head_T_camera.rotation_wxyz",
        "[0.0, 0.0, 0.0, 0.0]",
    ),
    "quaternion 0 of axis": (
        put("rig", "pan_T_tilt", "rotation_wxyz", to=[0, 0, 0, 0]),
        "rig.pan_T_tilt.rotation_wxyz",
        "[0.0, 0.0, 0.0, 0.0]",
    ),
    "quaternion of 3": (put(*POSE, "rotation_wxyz", to=[1, 0, 0]), "world_T_mast.rotation_wxyz", "found 3"),
    "translation of 4": (put(*POSE, "translation_m", to=[1, 0, 0, 0]), "translation_m", "found 4"),
    "pose": (put(*POSE, to=[1, 0, 0]), "stops[1].world_T_mast", "a list of 3"),
    "unknown stop": (put("frames", 3, "stop", to="s9"), "frames: s1f1: stop", "'s9'"),
    "unknown frame": (put("images", 1, "frame", to="f9"), "images: s0f0_brown: frame", "'f9'"),
    "unknown camera": (put("images", 1, "camera", to="hazcam"), "images: s0f0_brown: camera", "'hazcam'"),
    "stop twice": (put("stops", 1, "id", to="s0"), "stops", "'s0' twice"),
    "frame twice": (put("frames", 1, "id", to="s0f0"), "frames", "'s0f0' twice"),
    "image twice": (put("images", 1, "id", to="s0f0_pinhole"), "images", "'s0f0_pinhole' twice"),
    "eye twice": (put("images", 1, "camera", to="pinhole"), "images: frame and camera", "twice"),
    "negative sigma": (put("frames", 3, "sigma_pan_rad", to=-1e-3), "frames: s1f1: sigma_pan_rad", "-0.001"),
    "negative stop sigma": (put("stops", 1, "sigma_translation_m", to=-1), "sigma_translation_m", "-1"),
    "id empty": (put("stops", 1, "id", to=""), "stops[1].id: expected a string of one line", '""'),
    "id as number": (put("stops", 1, "id", to=1), "stops[1].id", "1"),
    "id with half a character": (put("frames", 1, "id", to="\ud800"), "frames[1].id", '"\\ud800"'),
    "id of two lines": (put("images", 1, "id", to="a\nb"), "images[1].id", '"a\\nb"'),
    "huge quaternion": (
        put(*POSE, "rotation_wxyz", 0, to=1e308),
        "stops[1].world_T_mast.rotation_wxyz",
        "1e+308",
    ),
    "no stops": (put("stops", to=[]), "stops", "found none"),
    "no frames": (put("frames", to=[]), "frames", "found none"),
    "no images": (put("images", to=[]), "images", "found none"),
    "stops": (put("stops", to={}), "stops", "an empty object"),
    "no observations key": (drop("observations"), "observations", "an object without it"),
    "no observations": (put("observations", to=None), "observations", "null and no image file"),
    "observations there": (put("observations", to=[]), "observations", "an empty list"),
    "observations absolute": (put("observations", to="/etc/a.npz"), "observations", '"/etc/a.npz"'),
    "observations above": (put("observations", to="../a.npz"), "observations", '"../a.npz"'),
    "observations on a drive": (put("observations", to="C:\\a.npz"), "observations", '"C:\\\\a.npz"'),
    "observations above, Windows": (put("observations", to="..\\a.npz"), "observations", '"..\\\\a.npz"'),
    "observations of no name": (put("observations", to=""), "observations", '""'),
    "NUL in a name": (put("observations", to="a\0.npz"), "observations", '"a\\u0000.npz"'),
    "sharing": (put("sharing", to="eye"), "sharing", '"eye"'),
    "sharing of what": (put("sharing", to={"focal": {"scope": "eye"}}), "sharing.focal", "the unknown key"),
    "sharing without scope": (put("sharing", to={"mounts": {}}), "sharing.mounts.scope", "without it"),
    "sharing scope": (
        put("sharing", to={"mounts": {"scope": "all"}}),
        "sharing: mounts: scope",
        "'all': each eye has its own mount",
    ),
    "fixed and free": (
        put("sharing", to={"calibration": {"scope": "fixed", "free": ["fx_px"]}}),
        "sharing: calibration: expected a scope other than fixed",
        "fixed with fx_px",
    ),
    "unknown entry": (
        put("sharing", to={"calibration": {"scope": "eye", "free": ["k1"]}}),
        "sharing: calibration: free: expected entries of focal, aspect, fx_px, fy_px",
        "'k1'",
    ),
    "sigma as text": (
        put("sharing", to={"mounts": {"scope": "eye", "sigma": {"x_m": "wide"}}}),
        "sharing.mounts.sigma.x_m",
        '"wide"',
    ),
    "sigma below 0": (
        put("sharing", to={"mounts": {"scope": "eye", "sigma": {"x_m": -1.0}}}),
        "sharing: mounts: sigma: x_m",
        "-1.0",
    ),
    "image absolute": (put("images", 0, "file", to="/etc/a.png"), "images[0].file", '"/etc/a.png"'),
    "image above": (put("images", 0, "file", to="a/../../b.png"), "images[0].file", '"a/../../b.png"'),
}


@pytest.mark.parametrize("case", ENTRIES)
def test_entries(folder: Path, case: str) -> None:
    change, entry, found = ENTRIES[case]
    path = folder / "traverse.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    refused(folder, "traverse.json: ", entry, found)


TEXTS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "empty": (lambda _: b"", "an empty file"),
    "blank": (lambda _: b" \n", "an empty file"),
    "truncated": (lambda text: text[: len(text) // 2], "line "),
    "bare word": (lambda _: b"traverse", "line 1, column 1"),
    "more after the end": (lambda text: text + b"}", "Extra data"),
    "list": (lambda _: b"[]", "an empty list"),
    "number": (lambda _: b"1", "found 1"),
    "not UTF-8": (lambda text: text.replace(b"sample", b"\xff"), "UTF-8"),
    "doubled key": (lambda text: text.replace(b'"tilt_rad"', b'"pan_rad"', 1), "frames[0].pan_rad"),
    "doubled key at the top": (lambda text: text.replace(b'"frames"', b'"stops"', 1), "json: stops"),
    "1e999": (lambda text: text.replace(b"-0.2,", b"1e999,", 1), "frames[0].tilt_rad"),
    "NaN": (lambda text: text.replace(b"-0.2,", b"NaN,", 1), "frames[0].tilt_rad"),
    "-Infinity": (lambda text: text.replace(b"-0.2,", b"-Infinity,", 1), "frames[0].tilt_rad"),
    "endless integer": (lambda text: text.replace(b"-0.2,", b"1" * 5000 + b",", 1), "too many digits"),
    "deep": (lambda _: b"[" * 100000, "nested too deeply"),
}


@pytest.mark.parametrize("case", TEXTS)
def test_json_texts(folder: Path, case: str) -> None:
    change, found = TEXTS[case]
    path = folder / "traverse.json"
    path.write_bytes(change(path.read_bytes()))
    refused(folder, "traverse.json: ", found)


def test_more_than_one_error_is_said(folder: Path) -> None:
    path = folder / "traverse.json"
    data = json.loads(path.read_text())
    for frame in data["frames"][1:]:
        frame["pan_rad"] = "east"
    path.write_text(json.dumps(data))
    refused(folder, 'frames[1].pan_rad: expected a number, found "east" (and 2 more such errors)')


class Trap:
    """An object that shows whether somebody unpickled it."""

    sprung = False

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        return spring, ()


def spring() -> None:
    Trap.sprung = True


Arrays = dict[str, Any]
N = 60


def covariance(
    arrays: Arrays,
    change: Callable[[Any], Any] = lambda c: c,
    at: list[list[float]] | None = None,
    sigma_px: FloatArray | None = None,
) -> None:
    """Put covariances in place of sigmas; changed, with another at row 5, or beside sigmas."""
    good = np.tile([[0.1, 0.05], [0.05, 0.7 / 3]], (N, 1, 1))
    if at is not None:
        good[5] = at
    del arrays["sigma_px"]
    arrays["covariance_px2"] = change(good)
    if sigma_px is not None:
        arrays["sigma_px"] = sigma_px


COLUMNS: dict[str, tuple[Callable[[Arrays], object], str, str]] = {
    # name: change, column and row as the sentence names them, what it says was found
    "missing": (lambda a: a.pop("sigma_px"), "sigma_px", "image, track, uv_px"),
    "image short": (
        lambda a: a.update(image=a["image"][1:]),
        "columns: expected one length",
        "image (59,), track (60,)",
    ),
    "track short": (lambda a: a.update(track=a["track"][1:]), "columns: expected one length", "track (59,)"),
    "uv short": (lambda a: a.update(uv_px=a["uv_px"][1:]), "columns: expected one length", "uv_px (59, 2)"),
    "uv transposed": (
        lambda a: a.update(uv_px=a["uv_px"].T),
        "columns: expected one length",
        "uv_px (2, 60)",
    ),
    "uv triples": (lambda a: a.update(uv_px=np.ones((N, 3))), "uv_px: expected shape (60, 2)", "(60, 3)"),
    "sigma of pairs": (lambda a: a.update(sigma_px=a["uv_px"]), "sigma_px: expected shape (60,)", "(60, 2)"),
    "sigma single": (lambda a: a.update(sigma_px=np.array(0.5)), "sigma_px", "a single value"),
    "image floats": (lambda a: a.update(image=a["image"] * 1.0), "image: expected integers", "float64"),
    "track booleans": (lambda a: a.update(track=a["track"] > 1), "track: expected integers", "bool"),
    "track too large": (lambda a: a.update(track=np.full(N, 2**63, np.uint64)), "track", str(2**63)),
    "uv texts": (lambda a: a.update(uv_px=a["uv_px"].astype(str)), "uv_px: expected numbers", "<U"),
    "uv complex": (lambda a: a.update(uv_px=a["uv_px"] + 0j), "uv_px: expected numbers", "complex128"),
    "pickled": (lambda a: a.update(uv_px=np.array([Trap()] * N, object)), "uv_px", "pickled objects"),
    "image beyond": (put("image", 5, to=20), "image, row 5", "found 20"),
    "image below 0": (put("image", 5, to=-1), "image, row 5", "found -1"),
    "track below 0": (put("track", 5, to=-1), "track, row 5", "found -1"),
    "NaN pixel": (put("uv_px", 5, to=[1, np.nan]), "uv_px, row 5", "[1.0, nan]"),
    "infinite pixel": (put("uv_px", 5, to=[np.inf, 1]), "uv_px, row 5", "[inf, 1.0]"),
    "sigma 0": (put("sigma_px", 5, to=0), "sigma_px, row 5", "found 0.0"),
    "sigma NaN": (put("sigma_px", 5, to=np.nan), "sigma_px, row 5", "found nan"),
    "a track twice in an image": (put("track", 1, to=0), "see a track once", "twice"),
    "covariance short": (
        lambda a: covariance(a, lambda c: c[1:]),
        "columns: expected one length",
        "covariance_px2 (59, 2, 2)",
    ),
    "covariance of triples": (
        lambda a: covariance(a, lambda c: np.ones((N, 3))),
        "covariance_px2: expected shape (60, 2, 2)",
        "(60, 3)",
    ),
    "covariance single": (
        lambda a: covariance(a, lambda c: np.array(0.1)),
        "covariance_px2: expected a column",
        "a single value",
    ),
    "covariance texts": (
        lambda a: covariance(a, lambda c: c.astype(str)),
        "covariance_px2: expected numbers",
        "<U",
    ),
    "covariance NaN": (
        lambda a: covariance(a, at=[[0.1, np.nan], [np.nan, 0.1]]),
        "covariance_px2, row 5: expected finite",
        "[[0.1, nan], [nan, 0.1]]",
    ),
    "covariance skewed": (
        lambda a: covariance(a, at=[[0.1, 0.02], [0.01, 0.1]]),
        "covariance_px2, row 5: expected a symmetric",
        "[[0.1, 0.02], [0.01, 0.1]]",
    ),
    "covariance indefinite": (
        lambda a: covariance(a, at=[[0.1, 0.2], [0.2, 0.1]]),
        "covariance_px2, row 5: expected a positive definite",
        "[[0.1, 0.2], [0.2, 0.1]]",
    ),
    "covariance singular": (
        lambda a: covariance(a, at=[[0.4, 0.2], [0.2, 0.1]]),
        "covariance_px2, row 5: expected a positive definite",
        "[[0.4, 0.2], [0.2, 0.1]]",
    ),
    "covariance immense": (
        lambda a: covariance(a, at=[[1e-300, 1e300], [1e300, 1e308]]),
        "covariance_px2, row 5: expected a positive definite",
        "[[1e-300, 1e+300], [1e+300, 1e+308]]",
    ),
    "variance 0": (
        lambda a: covariance(a, at=[[0.1, 0.0], [0.0, 0.0]]),
        "covariance_px2, row 5: expected variances above 0",
        "[[0.1, 0.0], [0.0, 0.0]]",
    ),
    "variance below 0": (
        lambda a: covariance(a, at=[[-0.1, 0.0], [0.0, -0.1]]),
        "covariance_px2, row 5: expected variances above 0",
        "[[-0.1, 0.0], [0.0, -0.1]]",
    ),
    "sigma against covariance": (
        lambda a: covariance(a, sigma_px=np.full(N, 0.3)),
        "sigma_px, row 0: expected 0.408248, the root of the mean variance in covariance_px2",
        "found 0.3",
    ),
    "none": (lambda a: a.update({k: v[:0] for k, v in a.items()}), "at least one", "none"),
}


@pytest.mark.parametrize("case", COLUMNS)
def test_columns(folder: Path, case: str) -> None:
    change, where, found = COLUMNS[case]
    path = folder / "observations.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(path, **arrays)
    refused(folder, "observations.npz: ", where, found)
    assert not Trap.sprung


def test_npz_that_is_none(folder: Path) -> None:
    path = folder / "observations.npz"
    good = path.read_bytes()
    for content in (b"", b"text", pickle.dumps(Trap()), good[: len(good) // 2], b"PK\x03\x04"):
        path.write_bytes(content)
        refused(folder, "observations.npz: expected an .npz archive of arrays", "something else")
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    refused(folder, "observations.npz: expected an .npz archive of arrays", "a single array")
    assert not Trap.sprung


def test_npz_with_damaged_members(folder: Path) -> None:
    path = folder / "observations.npz"
    good = bytearray(path.read_bytes())
    good[good.index(b"uv_px.npy") + 400] ^= 0xFF
    path.write_bytes(good)
    refused(folder, "observations.npz: uv_px: expected a whole array", "CRC")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("image", b"no array")
    refused(folder, "observations.npz: image: expected an array", "other bytes")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("image.npy", pickle.dumps(Trap()))
    refused(folder, "observations.npz: image: expected")
    with zipfile.ZipFile(path, "w"):
        pass
    refused(folder, "observations.npz: image: expected an array of this name", "an empty archive")
    assert not Trap.sprung


CSV = "image,track,u_px,v_px,sigma_px\n0,0,1,2,0.5\n1,0,3,4,0.5\n"

COVARIANCES = (
    "image,track,u_px,v_px,cov_uu_px2,cov_uv_px2,cov_vv_px2\n0,0,1,2,0.1,0,0.1\n1,0,3,4,0.1,0.01,0.2\n"
)

TABLES: dict[str, tuple[bytes, str, str]] = {
    "empty": (b"", "line 1", "an empty line"),
    "header only": (CSV.splitlines()[0].encode(), "at least one", "none"),
    "column missing": (CSV.replace("v_px", "v").encode(), "v_px: expected one such column", "none of this"),
    "column twice": (CSV.replace("v_px", "u_px").encode(), "u_px: expected one such column", "2 times"),
    "text": (CSV.replace("3,4", "three,4").encode(), "u_px, row 1 (line 3): expected a number", '"three"'),
    "blank cell": (CSV.replace("3,4", ",4").encode(), "u_px, row 1 (line 3): expected a number", '""'),
    "image 1.0": (
        CSV.replace("1,0", "1.0,0").encode(),
        "image, row 1 (line 3): expected an integer",
        '"1.0"',
    ),
    "track endless": (CSV.replace("1,0", f"1,{2**63}").encode(), "track, row 1 (line 3)", str(2**63)),
    "cell missing": (CSV.replace("3,4,0.5", "3,4").encode(), "row 1 (line 3): expected 5 cells", "found 4"),
    "NaN": (CSV.replace("3,4", "nan,4").encode(), "uv_px, row 1", "[nan, 4.0]"),
    "covariance column missing": (
        CSV.replace("sigma_px", "cov_uv_px2").encode(),
        "cov_uu_px2: expected one such column",
        "none of this",
    ),
    "covariance column twice": (
        COVARIANCES.replace("cov_uv", "cov_uu").encode(),
        "cov_uu_px2: expected one such column",
        "2 times",
    ),
    "covariance text": (
        COVARIANCES.replace("0.01,0.2\n", "none,0.2\n").encode(),
        "cov_uv_px2, row 1 (line 3): expected a number",
        '"none"',
    ),
    "covariance indefinite": (
        COVARIANCES.replace("0.01,0.2\n", "0.3,0.2\n").encode(),
        "covariance_px2, row 1: expected a positive definite",
        "[[0.1, 0.3], [0.3, 0.2]]",
    ),
    "sigma against covariance": (
        "".join(
            f"{a},{b}\n" for a, b in zip(COVARIANCES.split(), ("sigma_px", "0.3", "0.5"), strict=True)
        ).encode(),
        "sigma_px, row 0: expected 0.316228",
        "found 0.3",
    ),
    "image beyond": (CSV.replace("1,0", "99,0").encode(), "image, row 1", "found 99"),
    "open quote": (CSV.replace("3,4", '"3,4').encode(), "line ", "an error"),
    "not UTF-8": (b"\xff\xfe" + CSV.encode("utf-16-le"), "CSV in UTF-8", "other bytes"),
}


@pytest.mark.parametrize("case", TABLES)
def test_tables(folder: Path, case: str) -> None:
    content, where, found = TABLES[case]
    path = folder / "traverse.json"
    path.write_text(path.read_text().replace("observations.npz", "observations.csv"))
    (folder / "observations.csv").write_bytes(content)
    refused(folder, "observations.csv: ", where, found)


def test_observations_that_cannot_be_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / "observations.npz"
    content = path.read_bytes()
    path.unlink()
    refused(folder, "observations.npz: expected a file, found nothing there")
    path.mkdir()
    refused(folder, "observations.npz: expected a file, found a folder")
    path.rmdir()
    path.write_bytes(content)
    read_bytes = Path.read_bytes

    def forbid(self: Path) -> bytes:
        if self.name == "observations.npz":
            raise PermissionError(13, "Permission denied")
        return read_bytes(self)

    monkeypatch.setattr(Path, "read_bytes", forbid)
    refused(folder, "observations.npz: expected a readable file, found: Permission denied")


def test_observations_of_another_kind(folder: Path) -> None:
    path = folder / "traverse.json"
    path.write_text(path.read_text().replace("observations.npz", "traverse.json"))
    refused(folder, "expected a file that ends in .npz or .csv", "'traverse.json'")


def test_links_that_lead_out(folder: Path) -> None:
    path = folder / "observations.npz"
    path.rename(folder.parent / "elsewhere.npz")
    path.symlink_to("../elsewhere.npz")
    refused(folder, "traverse.json: observations: ", '"observations.npz", a link that leads out of it')
    path.unlink()
    path.symlink_to("observations.npz")
    refused(folder, "observations")
    path.unlink()
    (folder.parent / "elsewhere.npz").rename(folder / "inside.npz")
    path.symlink_to("inside.npz")
    read_traverse(folder)


def test_image_files(folder: Path) -> None:
    path = folder / "traverse.json"
    data = json.loads(path.read_text())
    data["images"][3]["file"] = "a.png"
    path.write_text(json.dumps(data))
    image = folder / "a.png"
    lost = f"image s0f0_cahvor is left out: {image}: expected an image file, found nothing there"
    assert read_input(folder).warnings == (lost,)
    image.mkdir()
    refused(folder, "images[3] (s0f0_cahvor)", "a.png", "a folder", kind=ImageError)
    image.rmdir()
    image.write_bytes(b"no image")
    refused(folder, "images[3] (s0f0_cahvor)", "a.png", kind=ImageError)
    cv2.imwrite(str(image), np.zeros((64, 48), dtype=np.uint8))
    refused(folder, "a.png", "expected 64 x 48 pixels", "found 48 x 64", kind=ImageError)
    image.write_bytes(image.read_bytes()[:100])
    refused(folder, "a.png", kind=ImageError)
    image.unlink()
    (folder.parent / "b.png").write_bytes(b"")
    image.symlink_to("../b.png")
    refused(folder, "images[3].file", '"a.png", a link that leads out of it')


def test_folders_that_are_none(tmp_path: Path) -> None:
    expected = r"expected a folder with traverse.json or with rover images with labels"
    refused(tmp_path / "nowhere", expected, "nothing there")
    refused(tmp_path, expected, "an empty folder")
    (tmp_path / "notes.txt").write_text("")
    refused(tmp_path, expected, "notes.txt")
    (tmp_path / "more.txt").write_text("")
    refused(tmp_path, expected, "more.txt and 1 more")
    refused(tmp_path / "notes.txt", expected, "a file")
    with pytest.raises(InputError, match=f"{expected}.*, found a path that cannot be read"):
        read_input(tmp_path / ("long" * 100))
    (tmp_path / "traverse.json").mkdir()
    refused(tmp_path, "traverse.json: expected a file, found a folder")
    for path, found in ((tmp_path / "nowhere", "nothing there"), (tmp_path / "notes.txt", "a file")):
        with pytest.raises(InputError, match=f"expected a traverse folder with traverse.json, found {found}"):
            read_traverse(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_no_file(folder: Path) -> None:
    (folder / "observations.npz").unlink()
    os.mkfifo(folder / "observations.npz")
    refused(folder, "observations.npz: expected a file", "a pipe")


def test_solution_files_are_checked_too(tmp_path: Path) -> None:
    path = tmp_path / "solution.json"
    path.write_text('{"format": "pancam-graph/solution", "version": 1, "model": "mast"}')
    with pytest.raises(InputError, match=r"solution\.json: landmarks: expected this key, found .* more such"):
        read_solution_json(path)
