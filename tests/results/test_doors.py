"""Formats of other programs: each, read by its own published equations, projects as the solution does.

The readers here are written after the formats' definitions, not after our writers. What they do not show:
that the programs themselves take the files, but for COLMAP (test_colmap.py).
"""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pancam_graph import Solution
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Brown, Camera, straight_pixels
from pancam_graph.cli import main
from pancam_graph.data import Site
from pancam_graph.io import read_cahvor, write_traverse
from pancam_graph.results import DOORS, convert, write_results
from pancam_graph.results.formats import Source, source_of
from pancam_graph.rigs import Rig, rig_template
from support.made_solutions import fabricate

POINTS = 1000


def brown_rig(skew_px: float = 0.0) -> Rig:
    """The stereo template with lenses of Brown's, unequal focal lengths and a skew."""
    rig = rig_template("stereo-pan-tilt")
    eyes = []
    for eye in rig.eyes:
        p = eye.camera.pinhole
        lens = Brown(
            width_px=p.width_px,
            height_px=p.height_px,
            fx_px=p.fx_px,
            fy_px=1.003 * p.fx_px,
            cx_px=p.cx_px + 7.3,
            cy_px=p.cy_px - 4.1,
            skew_px=skew_px,
            distortion=(-0.11, 0.02, 4e-4, -3e-4, 0.005),
        )
        eyes.append(replace(eye, camera=lens))
    return replace(rig, eyes=tuple(eyes))


RIGS: dict[str, Callable[[], Rig]] = {
    "pinhole": lambda: rig_template("mer-navcam"),
    "brown": brown_rig,
    "skewed": lambda: brown_rig(0.8),
    "cahvor": lambda: rig_template("msl-navcam"),
}


@cache
def solved(rig: str) -> Solution:
    return fabricate(rig=RIGS[rig](), stops=2, pans=2, points=60)


def seen_points(solution: Solution, image: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) of the world in an image's view, 1 to 200 m away, and their pixels (n, 2)."""
    camera: Camera = solution.image_cameras[image]
    uv = rng.uniform(0, [camera.width_px - 1, camera.height_px - 1], (POINTS, 2))
    rays = camera.unproject(uv)
    assert rays.valid.all()
    points = rays.origin_m + np.exp(rng.uniform(0, np.log(200.0), (POINTS, 1))) * rays.direction
    final = solution.final
    return points @ final.world_R_camera[image].T + final.world_t_camera[image], uv


def written(solution: Solution, folder: Path, to: str) -> Source:
    source = source_of(solution)
    if DOORS[to].is_folder:
        folder.mkdir()
    DOORS[to].writer()(source, folder)
    return source


# --- readers, after the definitions of the formats ---


def radtan(x: FloatArray, y: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
    """OpenCV's distortion, k1, k2, p1, p2, k3."""
    r2 = x**2 + y**2
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
    return (
        x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x**2),
        y * radial + k[2] * (r2 + 2 * y**2) + 2 * k[3] * x * y,
    )


def tsai_pixels(path: Path, points: FloatArray) -> FloatArray:
    """Pixels of a .tsai; the centre of its first pixel is (0, 0)."""
    lines = path.read_text().splitlines()
    assert lines[:2] == ["VERSION_4", "PINHOLE"]
    entries = {
        k.strip(): np.array(v.split(), dtype=float) for k, s, v in (x.partition("=") for x in lines) if s
    }
    assert entries["u_direction"].tolist() == [1, 0, 0]
    assert entries["v_direction"].tolist() == [0, 1, 0]
    q = (points - entries["C"]) @ entries["R"].reshape(3, 3)
    x, y = q[:, 0] / q[:, 2], q[:, 1] / q[:, 2]
    if "TSAI" in lines:
        x, y = radtan(x, y, np.array([entries[n][0] for n in ("k1", "k2", "p1", "p2", "k3")]))
    else:
        assert "NULL" in lines
    pitch = entries["pitch"]
    return np.column_stack(
        [(entries["fu"] * x + entries["cu"]) / pitch, (entries["fv"] * y + entries["cv"]) / pitch]
    )


def csm_pixels(path: Path, points: FloatArray) -> FloatArray:
    """GroundToImage of a USGS Frame state, samples and lines from the centre of the first pixel."""
    head, _, text = path.read_text().partition("\n")
    state: dict[str, Any] = json.loads(text)
    assert head == state["m_modelName"] == "USGS_ASTRO_FRAME_SENSOR_MODEL"
    values = state["m_currentParameterValue"]
    x, y, z, w = values[3:]
    rotation = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    q = (points - values[:3]) @ rotation
    f = state["m_focalLength"]
    dx, dy = f * q[:, 0] / q[:, 2], f * q[:, 1] / q[:, 2]
    if state["m_distortionType"] == 7:
        nx, ny = radtan(dx / f, dy / f, np.array(state["m_opticalDistCoeffs"]))
        dx, dy = f * nx, f * ny
    else:
        assert state["m_distortionType"] == 0
        assert not any(state["m_opticalDistCoeffs"])
    s, line = state["m_iTransS"], state["m_iTransL"]
    sample = s[0] + s[1] * dx + s[2] * dy + state["m_ccdCenter"][1] - state["m_startingDetectorSample"]
    row = line[0] + line[1] * dx + line[2] * dy + state["m_ccdCenter"][0] - state["m_startingDetectorLine"]
    # Back from pixels to the focal plane, as imageToGround goes.
    back = np.array([state["m_transX"], state["m_transY"]])
    there = np.array([[s[1], s[2]], [line[1], line[2]]])
    assert np.allclose(back[:, [2, 1]] @ there, np.eye(2), atol=1e-14)
    return np.column_stack([sample, row]) - 0.5


def bundler_cameras(folder: Path) -> tuple[list[tuple[float, FloatArray, FloatArray]], list[str]]:
    """Focal length, R and t of each camera, and the other lines."""
    lines = (folder / "bundle.out").read_text().splitlines()
    assert lines[0] == "# Bundle file v0.3"
    n = int(lines[1].split()[0])
    cameras = []
    for i in range(n):
        block = [np.array(x.split(), dtype=float) for x in lines[2 + 5 * i : 7 + 5 * i]]
        assert block[0][1:].tolist() == [0, 0]
        cameras.append((float(block[0][0]), np.array(block[1:4]), block[4]))
    return cameras, [lines[1], *lines[2 + 5 * n :]]


def bundler_pixels(camera: tuple[float, FloatArray, FloatArray], points: FloatArray) -> FloatArray:
    """Pixels from the middle of the image, y up."""
    f, R, t = camera
    p = points @ R.T + t
    return np.asarray(-f * p[:, :2] / p[:, 2:])


def nvm_pixels(words: list[str], points: FloatArray) -> FloatArray:
    """Pixels from the middle of the image, y down."""
    f, w, x, y, z, *centre, radial, last = (float(n) for n in words[1:])
    assert (radial, last) == (0, 0)
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    p = (points - centre) @ R.T
    return np.asarray(f * p[:, :2] / p[:, 2:])


# --- the same projection ---


@pytest.mark.parametrize("rig", ["pinhole", "brown"])
@pytest.mark.parametrize(
    ("to", "suffix", "read"), [("tsai", ".tsai", tsai_pixels), ("csm", ".json", csm_pixels)]
)
def test_a_file_an_image_projects_as_the_solution(
    tmp_path: Path, rig: str, to: str, suffix: str, read: Callable[[Path, FloatArray], FloatArray]
) -> None:
    solution, rng = solved(rig), np.random.default_rng(0)
    source = written(solution, tmp_path / to, to)
    assert not source.warnings
    for row, image in enumerate(solution.traverse.images):
        points, uv = seen_points(solution, row, rng)
        assert np.abs(read(tmp_path / to / f"{image.id}{suffix}", points) - uv).max() < 1e-6


def test_a_csm_state_has_skew(tmp_path: Path) -> None:
    solution = solved("skewed")
    written(solution, tmp_path / "csm", "csm")
    points, uv = seen_points(solution, 1, np.random.default_rng(1))
    assert (
        np.abs(csm_pixels(tmp_path / "csm" / f"{solution.traverse.images[1].id}.json", points) - uv).max()
        < 1e-6
    )


@pytest.mark.parametrize(
    ("rig", "to", "suffix", "read"),
    [
        ("cahvor", "tsai", ".tsai", tsai_pixels),
        ("cahvor", "csm", ".json", csm_pixels),
        ("skewed", "tsai", ".tsai", tsai_pixels),
    ],
)
def test_a_lens_without_an_equal_is_as_near_as_the_index_says(
    tmp_path: Path, rig: str, to: str, suffix: str, read: Callable[[Path, FloatArray], FloatArray]
) -> None:
    solution, rng = solved(rig), np.random.default_rng(2)
    source = written(solution, tmp_path / to, to)
    about = {c["camera"]: c for c in json.loads((tmp_path / to / "export.json").read_text())["cameras"]}
    for row, image in enumerate(solution.traverse.images[:2]):
        points, uv = seen_points(solution, row, rng)
        off = np.linalg.norm(read(tmp_path / to / f"{image.id}{suffix}", points) - uv, axis=1)
        said = about[image.camera]
        assert 1e-4 < off.max() < 1.05 * said["max_px"] + 1e-6 < 0.4
        assert abs(np.sqrt(np.mean(off**2)) / said["rms_px"] - 1) < 0.25  # its cells are not these points
    assert bool(source.warnings) == any(c["max_px"] > 0.01 for c in about.values())


@pytest.mark.parametrize("rig", ["pinhole", "brown", "cahvor"])
def test_bundler_and_nvm_project_onto_their_images(tmp_path: Path, rig: str) -> None:
    """A pixel, carried to the undistorted image, is where the file's equations put its point."""
    solution, rng = solved(rig), np.random.default_rng(3)
    for to in ("bundler", "nvm"):
        written(solution, tmp_path / to, to)
    cameras, _ = bundler_cameras(tmp_path / "bundler")
    nvm = (tmp_path / "nvm" / "scene.nvm").read_text().splitlines()
    assert (nvm[0], int(nvm[2])) == ("NVM_V3", len(solution.traverse.images))
    listed = json.loads((tmp_path / "nvm" / "export.json").read_text())["images"]
    for row in range(len(solution.traverse.images)):
        points, uv = seen_points(solution, row, rng)
        camera = solution.image_cameras[row]
        plain = replace(camera.pinhole, skew_px=0.0)
        away = np.linalg.norm(points - solution.final.world_t_camera[row], axis=1)
        carried, _, valid = straight_pixels(camera, plain, uv, away)
        assert valid.all()
        f = cameras[row][0]
        expected = (carried - [plain.cx_px, plain.cy_px]) * [f / plain.fx_px, f / plain.fy_px]
        assert np.abs(bundler_pixels(cameras[row], points) * [1, -1] - expected).max() < 1e-6
        assert np.abs(nvm_pixels(nvm[3 + row].split(), points) - expected).max() < 1e-6
        # The undistorted image has room for all pixels of the image.
        size = np.array([listed[row]["width_px"], listed[row]["height_px"]])
        assert (np.abs(expected) <= (size - 1) / 2 + 1e-6).all()


def test_bundler_and_nvm_have_the_residuals_of_the_solution(tmp_path: Path) -> None:
    solution = solved("pinhole")  # square pixels: nothing is enlarged
    observations = solution.traverse.observations
    assert observations is not None
    for to in ("bundler", "nvm"):
        written(solution, tmp_path / to, to)
    cameras, rest = bundler_cameras(tmp_path / "bundler")
    n = int(rest[0].split()[1])
    residuals, again = [], []
    for i in range(n):
        xyz = np.array(rest[1 + 3 * i].split(), dtype=float)
        views = np.array(rest[3 + 3 * i].split()[1:], dtype=float).reshape(-1, 4)
        assert len(views) > 1
        for image, _, u, v in views:
            residuals.append(np.linalg.norm(bundler_pixels(cameras[int(image)], xyz[None])[0] - [u, v]))
    nvm = (tmp_path / "nvm" / "scene.nvm").read_text().splitlines()
    first = 4 + len(cameras)
    assert int(nvm[first]) == n
    for line in nvm[first + 1 : first + 1 + n]:
        words = np.array(line.split(), dtype=float)
        for image, _, u, v in words[7:].reshape(-1, 4):
            again.append(np.linalg.norm(nvm_pixels(nvm[3 + int(image)].split(), words[None, :3])[0] - [u, v]))
    views_of = np.bincount(observations.track[solution.used])
    used = solution.used & (views_of[observations.track] > 1)
    expected = np.sort(np.linalg.norm(solution.residual_final_px[used], axis=1))
    assert np.allclose(np.sort(residuals), expected, atol=1e-6)
    assert np.allclose(np.sort(again), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("to", "suffix", "read"), [("tsai", ".tsai", tsai_pixels), ("csm", ".json", csm_pixels)]
)
def test_with_a_site_cameras_are_fixed_to_the_body(
    tmp_path: Path, to: str, suffix: str, read: Callable[[Path, FloatArray], FloatArray]
) -> None:
    """Points are taken to the body by latitude, longitude and height, not by the way of the writer."""
    site = Site(body="Mars", latitude_deg=-4.6, longitude_deg=137.4, height_m=-4500.0, north_rad=0.3)
    made = solved("brown")
    solution = replace(made, traverse=replace(made.traverse, site=site))
    written(solution, tmp_path / to, to)
    points, uv = seen_points(solution, 1, np.random.default_rng(7))
    latitude, longitude = np.radians(site.geographic(points)[:, :2]).T
    height = site.geographic(points)[:, 2]
    a, b = 3396190.0, 3376200.0
    geodetic = latitude  # maps of Mars have the planetocentric one
    for _ in range(20):
        normal = a / np.sqrt(1 - (1 - b**2 / a**2) * np.sin(geodetic) ** 2)
        geodetic = np.arctan2(
            (normal + height) * np.sin(latitude), (normal * b**2 / a**2 + height) * np.cos(latitude)
        )
    across = (normal + height) * np.cos(geodetic)
    z = (normal * b**2 / a**2 + height) * np.sin(geodetic)
    body = np.column_stack([across * np.cos(longitude), across * np.sin(longitude), z])
    away = np.linalg.norm(points - solution.final.world_t_camera[1], axis=1)
    file = tmp_path / to / f"{solution.traverse.images[1].id}{suffix}"
    off = np.abs(read(file, body) - uv).max(axis=1)
    assert (off * away).max() < 1e-4  # a micrometre among millions of metres, seen from each point's range
    if to == "csm":
        state = json.loads(file.read_text().partition("\n")[2])
        assert (state["m_majorAxis"], state["m_minorAxis"], state["m_targetName"]) == (a, b, "Mars")


def test_cahvor_files_project_as_the_solution(tmp_path: Path) -> None:
    solution, rng = solved("cahvor"), np.random.default_rng(4)
    written(solution, tmp_path / "cahvor", "cahvor")
    for row, image in enumerate(solution.traverse.images):
        points, uv = seen_points(solution, row, rng)
        assert (
            np.abs(read_cahvor(tmp_path / "cahvor" / f"{image.id}.cahvor").project(points)[0] - uv).max()
            < 1e-6
        )


# --- from a folder ---


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Solution]:
    """A folder of results and its solution."""
    place = tmp_path_factory.mktemp("refined")
    made = solved("cahvor")
    write_traverse(made.traverse, place / "drive")
    solution = replace(made, traverse=replace(made.traverse, folder=place / "drive"))
    write_results(solution, place / "out", report=False)
    return place / "out", solution


def test_a_folder_of_results_is_written_as_the_solution_is(
    refined: tuple[Path, Solution], tmp_path: Path
) -> None:
    out, solution = refined
    for to in ("cahvor", "nvm", "csm"):
        done = convert(out, tmp_path / to, to=to)
        assert (done.to, done.passed) == (to, True)
    points, uv = seen_points(solution, 2, np.random.default_rng(5))
    name = solution.traverse.images[2].id
    assert np.abs(read_cahvor(tmp_path / "cahvor" / f"{name}.cahvor").project(points)[0] - uv).max() < 1e-6
    written(solution, tmp_path / "memory", "nvm")
    ours = (tmp_path / "nvm" / "scene.nvm").read_text().split()
    memory = (tmp_path / "memory" / "scene.nvm").read_text().split()
    assert len(ours) == len(memory)
    numbers = [(a, b) for a, b in zip(ours, memory, strict=True) if a != b]
    assert all(abs(float(a) - float(b)) < 1e-7 * max(1.0, abs(float(b))) for a, b in numbers)


def test_a_drive_and_a_camera_are_written_too(refined: tuple[Path, Solution], tmp_path: Path) -> None:
    out, solution = refined
    convert(out.parent / "drive", tmp_path / "told", to="cahvor")
    image = solution.traverse.images[1]
    told = read_cahvor(tmp_path / "told" / f"{image.id}.cahvor")
    assert np.allclose(told.C, solution.initial.world_t_camera[1], atol=1e-12)
    convert(tmp_path / "told" / f"{image.id}.cahvor", tmp_path / "one", to="csm")
    points, _ = seen_points(solution, 1, np.random.default_rng(6))
    uv, valid = told.project(points)
    off = np.abs(csm_pixels(tmp_path / "one" / f"{image.id}.json", points) - uv)[valid]
    assert off.max() < 0.01  # a CAHVOR has no equal


def test_nothing_is_replaced_silently(refined: tuple[Path, Solution], tmp_path: Path) -> None:
    out, _ = refined
    convert(out, tmp_path / "tsai", to="tsai")
    before = sorted((tmp_path / "tsai").iterdir())
    with pytest.raises(
        InputError, match="expected a new folder for tsai, found one with files in it; --overwrite"
    ):
        convert(out, tmp_path / "tsai", to="tsai")
    convert(out, tmp_path / "tsai", to="tsai", overwrite=True)
    assert sorted((tmp_path / "tsai").iterdir()) == before
    (tmp_path / "tsai" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match=r"found what others made in it: tsai/mine\.txt"):
        convert(out, tmp_path / "tsai", to="tsai", overwrite=True)
    assert (tmp_path / "tsai" / "mine.txt").exists()
    with pytest.raises(InputError, match="expected a new folder for csm, found a file"):
        convert(out, tmp_path / "tsai" / "mine.txt", to="csm", overwrite=True)


def test_what_cannot_be_converted_is_said_in_a_sentence(
    refined: tuple[Path, Solution], tmp_path: Path
) -> None:
    out, _ = refined
    for path, to, says in (
        (out, "hugin", "to: expected one of .*; found 'hugin'"),
        (out, None, "expected .*a format told by --to"),
        (tmp_path / "none", "csm", "none: expected a folder or a file to convert, found nothing there"),
        (out / "points.ply", "csm", "points.ply: expected text in UTF-8|Model: expected"),
    ):
        with pytest.raises(InputError, match=says):
            convert(path, tmp_path / "x.what", to=to)
        assert not (tmp_path / "x.what").exists()


def test_the_command_writes_or_says_why_not(
    refined: tuple[Path, Solution], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, _ = refined
    assert main(["convert", str(out), str(tmp_path / "net.csv")]) == 0
    assert capsys.readouterr().out.endswith("net.csv: control-network\n")
    assert main(["convert", str(out), str(tmp_path / "net.csv")]) == 2
    error = capsys.readouterr().err
    assert "expected a new file for control-network, found one; --overwrite replaces it" in error
    assert error.count("\n") == 1
    assert main(["convert", str(out), str(tmp_path / "net.csv"), "--overwrite"]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["net.csv"]


def test_a_solution_that_failed_is_written_with_status_1(
    refined: tuple[Path, Solution], tmp_path: Path
) -> None:
    _, solution = refined
    write_results(replace(solution, converged=False), tmp_path / "out", report=False)
    assert main(["convert", str(tmp_path / "out"), str(tmp_path / "tables"), "--to", "tables"]) == 1
    assert (tmp_path / "tables" / "stops.csv").exists()


def test_help_lists_every_format(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", "--help"]) == 0
    words = capsys.readouterr().out.replace(",", " ").split()
    assert set(DOORS) <= set(words)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda data: data[:-3], r"points\.ply: expected the points of a solution .*, found \d+ bytes for"),
        (lambda data: data.replace(b"int track", b"int kcart"), "found the properties x, y, z, kcart"),
        (lambda data: b"ply\n", "found something else"),
    ],
)
def test_damaged_points_are_refused(
    refined: tuple[Path, Solution], tmp_path: Path, change: Callable[[bytes], bytes], says: str
) -> None:
    _, solution = refined
    write_results(solution, tmp_path / "out", report=False)
    points = tmp_path / "out" / "points.ply"
    points.write_bytes(change(points.read_bytes()))
    with pytest.raises(InputError, match=says):
        convert(tmp_path / "out", tmp_path / "cahvor", to="cahvor")
    assert not (tmp_path / "cahvor").exists()
