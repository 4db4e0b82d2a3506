"""Mosaics: right place, right brightness, and a seam error that is the pointing error."""

import json
import re
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pancam_graph import Solution, find_observations, read_pds, solve, write_report, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.mosaic import (
    Cylinder,
    Ground,
    MosaicOptions,
    Overlap,
    StopMosaics,
    make_mosaics,
    write_mosaics,
)
from pancam_graph.mosaic._make import StopGround, stop_ground
from pancam_graph.mosaic._phase import WINDOW_PX, displacements
from pancam_graph.mosaic._surface import directions
from pancam_graph.mosaic._warp import largest_gap
from pancam_graph.results import check_out, write_results
from support.mosaic_scenes import MARK_M, PLACE_M, PX_PER_RAD, Scene, brightness, solved, without_file
from support.pictures import read_picture

NEAR = MosaicOptions(ground_radius_m=4.0, ground_m_per_px=0.02)


def made(scene: Scene, folder: Path) -> StopMosaics:
    return make_mosaics(solved(scene, folder), "A/1", "left", NEAR)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Solution:
    return solved(Scene(), tmp_path_factory.mktemp("truth"))


@pytest.fixture(scope="module")
def truth_made(truth: Solution) -> StopMosaics:
    return make_mosaics(truth, "A/1", "left", NEAR)


@pytest.fixture(scope="module")
def truth_ground(truth: Solution) -> StopGround:
    return stop_ground(truth, 0)


def shifted(noise: float, shift: FloatArray, n: int = 40) -> tuple[NDArray[Any], NDArray[Any]]:
    """Windows of a smooth random texture, and of the same displaced, cut from something larger."""
    rng = np.random.default_rng(0)
    side = 2 * WINDOW_PX
    f = np.fft.fftfreq(side)
    spectrum = np.fft.fft2(rng.normal(0, 1, (n, side, side))) * np.exp(-40 * (f[:, None] ** 2 + f**2))
    ramp = np.exp(-2j * np.pi * (f * shift[0] + f[:, None] * shift[1]))
    pair = [np.fft.ifft2(s).real[:, 32:96, 32:96] for s in (spectrum, spectrum * ramp)]
    return pair[0], pair[1] + rng.normal(0, noise * pair[0].std(), pair[1].shape)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.11, -0.07), (0.6, 0.8), (-2.4, 1.3), (12.0, -9.0)])
def test_displacements_of_windows_are_found(shift: tuple[float, float]) -> None:
    found = displacements(*shifted(0.0, np.array(shift)))
    assert np.median(found.shift_px, axis=0) == pytest.approx(shift, abs=0.003 + 0.003 * np.hypot(*shift))
    assert found.coherence.min() > 0.6


def test_displacements_know_how_sure_they_are() -> None:
    found = displacements(*shifted(0.3, np.array([0.2, -0.1]), n=80))
    error = np.abs(found.shift_px - [0.2, -0.1]).max(axis=1) / found.sigma_px
    assert 0.6 < np.median(error) < 1.6
    plain = displacements(*(np.random.default_rng(k).normal(0, 1, (50, 64, 64)) for k in (1, 2)))
    assert np.median(plain.coherence) < 0.3
    flat = displacements(np.full((1, 64, 64), 7.0), np.full((1, 64, 64), 7.0))
    assert np.isfinite(flat.shift_px).all()


def test_runs_that_are_not_covered_go_round() -> None:
    covered = np.array([0, 1, 1, 0, 1, 0, 0, 0], dtype=bool)
    assert largest_gap(covered) == (5, 4)
    assert largest_gap(np.roll(covered, 3)) == (0, 4)
    assert largest_gap(np.ones(5, dtype=bool)) == (0, 0)
    assert largest_gap(np.zeros(5, dtype=bool)) == (0, 5)


def test_the_surface_is_the_plane_and_fades_to_a_far_sky(truth_ground: StopGround) -> None:
    ground = truth_ground
    surface = ground.surfaces["refined"]
    places = np.array([[1.0, 0.3], [2.0, 1.0], [5.0, 0.0], [8.0, -3.0]])
    points = surface.ground_m(places)
    assert points[:, :2] == pytest.approx(places + ground.origin_m[:2])
    assert np.abs(points[:, 2]).max() < 0.05
    assert surface.inverse_range(np.array([[0.0, 0.6, 0.8]])) == pytest.approx(1e-5, abs=1e-4)


@pytest.mark.slow
def test_hills_beyond_the_horizon_do_not_pull_the_ground_down(truth: Solution) -> None:
    """Hundreds of landmarks of a far ridge above the horizon leave the plane where near ones have it."""
    landmarks = truth.final.landmarks_m.copy()
    away_m = np.linalg.norm(landmarks[:, :2] - PLACE_M[:2], axis=1)
    seen = np.unique(truth.landmark_row[truth.used])
    ridge = seen[away_m[seen] > np.quantile(away_m[seen], 0.3)]
    out = (landmarks[ridge] - PLACE_M)[:, :2] / away_m[ridge, None]
    landmarks[ridge] = PLACE_M + np.column_stack([out, np.full(len(ridge), 0.03)]) * 800.0
    hilly = replace(
        truth,
        initial=replace(truth.initial, landmarks_m=landmarks),
        final=replace(truth.final, landmarks_m=landmarks),
    )
    ground = stop_ground(hilly, 0)
    plane = ground.surfaces["refined"].plane
    assert 1 / np.linalg.norm(plane) == pytest.approx(ground.origin_m[2], rel=0.02)
    assert len(ridge) > 2 * (len(seen) - len(ridge))


def test_without_landmarks_the_ground_is_the_rigs(truth: Solution) -> None:
    bare = replace(truth, used=np.zeros_like(truth.used))
    point = stop_ground(bare, 0).surfaces["refined"].ground_m(np.array([[3.0, 0.0]]))
    nominal_m = PLACE_M[2] - truth.traverse.rig.mast_height_m
    assert point[0, 2] == pytest.approx(nominal_m, abs=0.01)


def test_true_poses_leave_no_seam_error(truth_made: StopMosaics) -> None:
    seams = truth_made.seams
    assert {o.images for o in seams.overlaps} >= {("f0-left", "f1-left"), ("f1-left", "f2-left")}
    assert seams.used >= 8
    assert seams.median_px("refined") < 0.03
    assert seams.median_px("telemetry") == pytest.approx(seams.median_px("refined"))
    for overlap in seams.overlaps:
        assert overlap.windows == overlap.plain + overlap.unlike + len(overlap.azimuth_deg)


def expected_shift(solution: Solution, row: int, overlap: Overlap) -> FloatArray:
    """How far telemetry draws what an image shows from where it is, at the middles of windows, pixels.

    Exact for the plane: from a direction to the ground, to the pixel that telemetry takes, to the ground
    that this pixel really shows, and back to its direction.
    """
    azimuth, elevation = np.deg2rad(overlap.azimuth_deg), np.deg2rad(overlap.elevation_deg)
    origin = solution.final.world_t_camera.mean(axis=0)
    ray = directions(azimuth, elevation)
    point = origin - ray * (origin[2] / ray[:, 2])[:, None]
    start, end = solution.initial, solution.final
    camera = solution.traverse.rig.eyes[0].camera
    uv, valid = camera.project((point - start.world_t_camera[row]) @ start.world_R_camera[row])
    assert valid.all()
    ray = camera.unproject(uv).direction @ end.world_R_camera[row].T
    shown = end.world_t_camera[row] - ray * (end.world_t_camera[row, 2] / ray[:, 2])[:, None] - origin
    moved_azimuth = azimuth - np.arctan2(shown[:, 1], shown[:, 0])
    moved_elevation = elevation - np.arctan2(shown[:, 2], np.hypot(shown[:, 0], shown[:, 1]))
    right = -np.arctan2(np.sin(moved_azimuth), np.cos(moved_azimuth)) * np.cos(elevation)
    return np.asarray(PX_PER_RAD * np.column_stack([right, -moved_elevation]))


@pytest.mark.slow
@pytest.mark.parametrize("error", [(-2e-3, 5e-3)])
def test_a_pointing_error_is_the_seam_error(tmp_path: Path, error: tuple[float, float]) -> None:
    solution = solved(Scene(error_rad=((0.0, 0.0), error)), tmp_path)
    seams = make_mosaics(solution, "A/1", "left", NEAR).seams
    assert seams.median_px("refined") < 0.03
    sizes = []
    for overlap in seams.overlaps:
        if "f1-left" in overlap.images:
            # The second image is displaced against the first: the wrong one is second, or first.
            sign = 1 if overlap.images[1] == "f1-left" else -1
            expected = sign * expected_shift(solution, 1, overlap)
            assert overlap.shift_px["telemetry"] == pytest.approx(expected, abs=0.08)
            sizes.append(np.linalg.norm(expected, axis=1))
            assert overlap.median_px("telemetry") == pytest.approx(np.median(sizes[-1]), rel=0.04)
    assert len(sizes) == 2


def test_a_known_point_is_at_the_pixel_that_the_index_says(truth: Solution, tmp_path: Path) -> None:
    write_mosaics(truth, tmp_path, NEAR)
    index = json.loads((tmp_path / "mosaics.json").read_text())
    assert [(e["kind"], e["stop"], e["camera"]) for e in index["mosaics"]] == [
        ("cylinder", "A/1", "left"),
        ("ground", "A/1", "left"),
    ]
    for entry in index["mosaics"]:
        d = MARK_M - entry["origin_m"]
        if entry["kind"] == "cylinder":
            azimuth, elevation = np.rad2deg([np.arctan2(d[1], d[0]), np.arctan2(d[2], np.hypot(d[0], d[1]))])
            column = (entry["left_azimuth_deg"] - azimuth) % 360 * entry["px_per_degree"]
            row = (entry["top_elevation_deg"] - elevation) * entry["px_per_degree"]
        else:
            column = (MARK_M[0] - entry["left_x_m"]) / entry["m_per_px"]
            row = (entry["top_y_m"] - MARK_M[1]) / entry["m_per_px"]
        picture = read_picture(tmp_path / entry["files"]["refined"])
        assert picture.shape == (entry["height_px"], entry["width_px"])
        dark = (picture > 0) & (picture < 20)
        near = np.zeros_like(dark)
        reach = 5
        u, v = round(column), round(row)
        near[v - reach : v + reach + 1, u - reach : u + reach + 1] = True
        v_found, u_found = np.nonzero(dark & near)
        assert (np.mean(u_found), np.mean(v_found)) == pytest.approx((column, row), abs=0.7)


def test_projections_go_to_points_and_back(truth_ground: StopGround) -> None:
    surface = truth_ground.surfaces["refined"]
    u, v = np.array([3.0, 40.5, 90.0]), np.array([60.0, 33.25, 80.0])
    cylinder = Cylinder(
        origin_m=surface.origin_m, width_px=100, height_px=90, px_per_degree=1.5, left_deg=40.0, top_deg=-5.0
    )
    for projection in (cylinder, Ground.around(surface.origin_m, 4.0, 0.05)):
        points = projection.points_m(surface, u, v)
        assert projection.pixels(points) == pytest.approx(np.column_stack([u, v]), abs=1e-6)


@pytest.mark.slow
def test_exposures_are_evened_out(truth_made: StopMosaics, tmp_path: Path) -> None:
    uneven = made(Scene(exposure=(1.5, 1.0, 0.7)), tmp_path)
    same, other = (m.cylinder.pictures["refined"].astype(float) for m in (truth_made, uneven))
    both = (same > 0) & (other > 0)
    assert both.mean() > 0.5
    thirds = np.array_split(np.arange(same.shape[1]), 3)
    gap = [np.median((other - same)[:, c][both[:, c]]) for c in thirds]
    assert np.ptp(gap) < 8  # of 255; unevened it would be a hundred


FIVE = tuple(np.deg2rad([40.0, 20.0, 0.0, -20.0, -40.0]))
RADII = np.linspace(0, 1, 11)


def left_over(mosaics: StopMosaics) -> FloatArray:
    """Share of the light that is left at some radii, as the mosaic takes it."""
    return np.asarray(np.exp(np.power(RADII[:, None] ** 2, [1, 2, 3]) @ mosaics.evening.vignetting))


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0.1, 0.35])
def test_vignetting_is_found_and_taken_out(tmp_path: Path, lost: float) -> None:
    exposure = (1.0, 1.3, 0.8, 1.1, 0.9)
    mosaics = made(Scene(pans_rad=FIVE, vignetting=lost, exposure=exposure), tmp_path)
    assert left_over(mosaics) == pytest.approx(1 - lost * RADII**2, rel=0.01)
    gain = np.array([mosaics.evening.gain[k] for k in range(5)]) * exposure
    assert gain / gain.mean() == pytest.approx(np.ones(5), rel=0.005)
    assert mosaics.evening.sigma is not None
    assert mosaics.evening.sigma < 0.005


@pytest.mark.slow
def test_no_vignetting_is_made_up(tmp_path: Path) -> None:
    mosaics = made(Scene(pans_rad=FIVE, exposure=(1.0, 1.3, 0.8)), tmp_path)
    assert not mosaics.evening.vignetting.any()
    assert mosaics.evening.sigma is not None
    assert mosaics.evening.sigma < 0.01


@pytest.mark.slow
def test_vignetting_that_overlaps_do_not_tell_is_left_alone(tmp_path: Path) -> None:
    mosaics = made(Scene(vignetting=0.35), tmp_path)
    assert not mosaics.evening.vignetting.any()
    assert mosaics.evening.sigma is None


@pytest.mark.slow
def test_samples_of_16_bits_are_those_of_the_scene(tmp_path: Path) -> None:
    solution = solved(Scene(pans_rad=FIVE, vignetting=0.2), tmp_path)
    mosaics = make_mosaics(solution, "A/1", "left", NEAR)
    assert mosaics.ground is not None
    assert mosaics.ground.samples is not None
    v, u = np.mgrid[0:400:8, 0:400:8]
    points = mosaics.ground.projection.pixels(np.zeros((1, 3)))  # where the world's origin would be
    xy = np.column_stack([u.ravel() - points[0, 0], points[0, 1] - v.ravel()]) * NEAR.ground_m_per_px
    away_m = np.hypot(*(xy - PLACE_M[:2]).T)
    near = (away_m > 1.2) & (away_m < 3.5)
    found = mosaics.ground.samples["refined"][v.ravel(), u.ravel()][near].astype(float)
    true = brightness(np.resize(xy, (2560, 2)))[: len(xy)][near]
    shown = found > 0
    assert np.count_nonzero(shown) > 200
    ratio = found[shown] / true[shown]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)  # gains are about 1 all together
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.02
    write_mosaics(solution, tmp_path, NEAR)
    for entry in json.loads((tmp_path / "mosaics.json").read_text())["mosaics"]:
        deep = read_picture(tmp_path / entry["files"]["refined_16bit"])
        plain = read_picture(tmp_path / entry["files"]["refined"])
        assert deep.dtype == np.uint16
        assert np.array_equal(deep == 0, plain == 0)
        between = (plain > 1) & (plain < 255)
        level = 1 + 254 * (deep[between] - entry["dark"]) / (entry["bright"] - entry["dark"])
        assert np.abs(level - plain[between]).max() < 1.0


@pytest.mark.slow
def test_images_of_8_bits_have_mosaics_of_8_bits(tmp_path: Path) -> None:
    solution = solved(Scene(bits=8), tmp_path)
    assert make_mosaics(solution, "A/1", "left", NEAR).cylinder.samples is None
    write_mosaics(solution, tmp_path, NEAR)
    for entry in json.loads((tmp_path / "mosaics.json").read_text())["mosaics"]:
        assert not any("16bit" in kind for kind in entry["files"])


@pytest.mark.slow
def test_what_a_mask_covers_is_no_ground_and_shown_last(truth_made: StopMosaics, tmp_path: Path) -> None:
    """The lower two thirds of each image are black in the mask."""
    solution = solved(Scene(), tmp_path)
    mask = np.full((224, 224), 255, np.uint8)
    mask[80:] = 0
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "left.png"), mask)
    masked = make_mosaics(solution, "A/1", "left", NEAR)
    around, before = (m.cylinder.pictures["refined"] > 0 for m in (masked, truth_made))
    assert np.array_equal(around, before)
    assert masked.ground is not None
    assert truth_made.ground is not None
    shown, all_shown = (np.count_nonzero(g.pictures["refined"]) for g in (masked.ground, truth_made.ground))
    assert 0 < shown < 0.75 * all_shown
    cv2.imwrite(str(tmp_path / "masks" / "left.png"), mask[:100])
    with pytest.raises(
        InputError, match=r"left\.png: expected a mask of 224 x 224 pixels .* found 224 x 100"
    ):
        make_mosaics(solution, "A/1", "left", NEAR)


@pytest.mark.slow
def test_wrong_landmarks_do_not_hide_the_ground(truth: Solution) -> None:
    landmarks = truth.final.landmarks_m.copy()
    wrong = np.random.default_rng(2).choice(len(landmarks), 60, replace=False)
    landmarks[wrong] = PLACE_M + (landmarks[wrong] - PLACE_M) * 40.0
    bad = replace(truth, final=replace(truth.final, landmarks_m=landmarks))
    places = np.random.default_rng(3).uniform(-4, 4, (500, 2))
    points = stop_ground(bad, 0).surfaces["refined"].ground_m(places)
    assert np.isfinite(points).all()
    assert np.abs(points[:, 2]).max() < 0.1


@pytest.mark.slow
def test_both_pointings_share_seams_and_exposure(tmp_path: Path) -> None:
    pictures = made(Scene(error_rad=((2e-3, -2e-3),)), tmp_path).cylinder.pictures
    assert pictures["telemetry"].shape == pictures["refined"].shape
    # The last image stands where it stood: nothing of it changes but at its seam.
    last = slice(-60, None)
    assert np.mean(pictures["telemetry"][:, last] == pictures["refined"][:, last]) > 0.99
    assert np.mean(pictures["telemetry"] == pictures["refined"]) < 0.9


@pytest.mark.slow
def test_a_panorama_that_goes_round_has_no_hole_and_no_cut(tmp_path: Path) -> None:
    scene = Scene(pans_rad=tuple(np.deg2rad(np.arange(0, 360, 36.0))), points=8000)
    whole = made(scene, tmp_path)
    picture, projection = whole.cylinder.pictures["refined"], whole.cylinder.projection
    assert isinstance(projection, Cylinder)
    assert projection.closed
    assert projection.width_px / projection.px_per_degree == pytest.approx(360)
    middle = picture[picture.shape[0] // 4 : 3 * picture.shape[0] // 4]
    assert (middle > 0).all()
    step = np.abs(np.diff(middle.astype(float), axis=1)).mean()
    cut = np.abs(middle[:, 0].astype(float) - middle[:, -1]).mean()
    assert cut < 2 * step
    pairs = {o.images for o in whole.seams.overlaps}
    assert ("f0-left", "f9-left") in pairs
    assert whole.seams.median_px("refined") < 0.03
    assert whole.ground is not None
    side = whole.ground.projection.height_px
    ring = [whole.ground.pictures["refined"][v, side // 2] for v in range(0, side // 2 - 130, 20)]
    assert min(ring) > 0


@pytest.mark.slow
def test_scale_is_limited_and_can_be_chosen(truth: Solution) -> None:
    small = make_mosaics(truth, "A/1", "left", replace(NEAR, px_per_degree=1.0)).cylinder.projection
    assert isinstance(small, Cylinder)
    assert small.px_per_degree == pytest.approx(1.0)
    narrow = make_mosaics(truth, "A/1", "left", replace(NEAR, max_width_px=100)).cylinder.projection
    assert 90 <= narrow.width_px <= 100


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"px_per_degree": 0.0}, "px_per_degree: expected a number above 0, found 0.0"),
        ({"ground_m_per_px": -1.0}, "ground_m_per_px: expected a number above 0"),
        ({"ground_radius_m": 100.0}, "20000 pixels"),
        ({"max_width_px": 50_000}, "found 50000"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match="MosaicOptions") as error:
        MosaicOptions(**options)
    assert said in str(error.value)


@pytest.mark.slow
def test_images_that_cannot_be_had_are_warned_of(tmp_path: Path) -> None:
    solution = solved(Scene(pans_rad=tuple(np.deg2rad([60.0, 40.0, 20.0, 0.0, -20.0]))), tmp_path)
    (tmp_path / "f0-left.png").unlink()
    (tmp_path / "f1-left.png").write_bytes(b"no image")
    cv2.imwrite(str(tmp_path / "f2-left.png"), np.ones((10, 12), np.uint8))
    out = tmp_path / "out"
    saved = write_results(without_file(solution, 3), out, mosaics=NEAR)
    assert len(saved.warnings) == 4
    for warning, (name, why) in zip(
        sorted(saved.warnings),
        [
            ("f0", "found nothing there"),
            ("f1", "that are none"),
            ("f2", "found 12 x 10"),
            ("f3", "it has no file"),
        ],
        strict=True,
    ):
        assert warning.startswith(f"mosaic: image {name}-left is left out: ")
        assert why in warning
    index = json.loads((out / "mosaics" / "mosaics.json").read_text())
    assert index["mosaics"][0]["images"] == ["f4-left"]
    assert index["mosaics"][0]["files"]["refined"] in (out / "mosaics" / "mosaics.html").read_text()
    check_out(out)  # a new run may replace it all
    assert index["mosaics"][0]["seam_error"]["refined_px"] is None
    assert "f0-left is left out" in (out / "report.html").read_text()
    assert json.loads((out / "solution.json").read_text())["warnings"] == list(saved.warnings)


@pytest.mark.slow
def test_a_picture_that_is_there_twice_is_shown_once(tmp_path: Path) -> None:
    solution = solved(Scene(), tmp_path)
    picture = read_picture(tmp_path / "f0-left.png").astype(float)
    encoded_anew = cv2.imencode(".jpg", np.rint(255 * picture / picture.max()).astype(np.uint8))[1].tobytes()
    for copy in ((tmp_path / "f0-left.png").read_bytes(), encoded_anew):
        (tmp_path / "f2-left.png").write_bytes(copy)
        mosaics = make_mosaics(solution, "A/1", "left", NEAR)
        assert mosaics.images == ("f0-left", "f1-left")
        (warning,) = mosaics.warnings
    assert warning == (
        "mosaic: image f2-left (f2-left.png) is left out: the same picture as image f0-left (f0-left.png)"
    )


def test_no_image_at_all_is_a_warning(tmp_path: Path) -> None:
    solution = solved(Scene(pans_rad=(0.0,)), tmp_path)
    (tmp_path / "f0-left.png").unlink()
    saved = write_results(solution, tmp_path / "out", mosaics=NEAR)
    (warning,) = saved.warnings
    assert warning.startswith("mosaic: stop A/1, camera left: expected image files, found none that serve")
    assert json.loads((tmp_path / "out" / "mosaics" / "mosaics.json").read_text())["mosaics"] == []
    with pytest.raises(InputError, match="expected the id of a stop, found 'B'"):
        make_mosaics(solution, "B", "left")


@pytest.mark.slow
def test_each_eye_has_its_mosaic_and_the_report_shows_them(tmp_path: Path) -> None:
    solution = solved(Scene(pans_rad=(0.4, -0.1), cameras=("left", "right")), tmp_path)
    out = tmp_path / "out"
    told: list[tuple[str, int, int]] = []
    write_results(solution, out, mosaics=NEAR, progress=lambda *said: told.append(said))
    assert told == [("mosaics", 1, 2), ("mosaics", 2, 2)]
    entries = json.loads((out / "mosaics" / "mosaics.json").read_text())["mosaics"]
    assert [(e["camera"], e["kind"]) for e in entries] == [
        ("left", "cylinder"),
        ("left", "ground"),
        ("right", "cylinder"),
        ("right", "ground"),
    ]
    assert entries[0]["origin_m"] == entries[2]["origin_m"]
    named = {f for e in entries for f in e["files"].values()} | {"mosaics.json", "mosaics.html"}
    assert {p.name for p in (out / "mosaics").iterdir()} == named
    assert {f.rsplit(".", 1)[1] for f in named} == {"png", "pgw", "jpg", "json", "html"}
    page = (out / "report.html").read_text()
    assert page.count('<figure class="blink"') == 2 * 3
    assert page.count("seam error") >= 2
    assert 'id="mosaic-blink"' in page
    assert re.findall(r'<optgroup label="([^"]+)">', page) == [
        f"stop A/1, camera {c}" for c in ("left", "right")
    ]
    assert 'data-before="stop A/1, camera right: telemetry&#x27;s pointing"' in page


@pytest.mark.slow
def test_the_program_writes_mosaics_when_asked(
    scripts_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Scene(error_rad=((1e-3, -1e-3), (-1e-3, 1.5e-3)), points=400)
    write_traverse(without_file(solved(scene, tmp_path), 2).traverse, tmp_path)
    program = str(scripts_folder / "optimize_traverse.py")
    for asked in ([], ["--mosaic"]):
        arguments = [program, str(tmp_path), "--out", str(tmp_path / "out"), "--no-report", *asked]
        monkeypatch.setattr("sys.argv", arguments)
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(program, run_name="__main__")
        assert ended.value.code == 0, capsys.readouterr().err
        assert (tmp_path / "out" / "mosaics").is_dir() == bool(asked)
    entry = json.loads((tmp_path / "out" / "mosaics" / "mosaics.json").read_text())["mosaics"][0]
    assert entry["images"] == ["f0-left", "f1-left"]
    seams = entry["seam_error"]
    assert seams["refined_px"] < 0.1
    assert seams["telemetry_px"] > 0.3
    warnings = json.loads((tmp_path / "out" / "solution.json").read_text())["warnings"]
    assert any(w == "mosaic: image f2-left is left out: it has no file" for w in warnings)


def test_without_mosaics_nothing_is_different(truth: Solution, tmp_path: Path) -> None:
    write_report(truth, tmp_path / "report.html")
    assert "mosaic" not in (tmp_path / "report.html").read_text()
    write_results(truth, tmp_path / "out", report=False)
    assert not (tmp_path / "out" / "mosaics").exists()


@pytest.mark.slow
def test_older_mosaics_are_replaced_and_strangers_kept(truth: Solution, tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_results(truth, out, report=False, mosaics=NEAR)
    write_results(truth, out, report=False, mosaics=NEAR)
    assert (out / "mosaics" / "mosaics.json").exists()
    write_results(truth, out, report=False)
    assert not (out / "mosaics").exists()
    write_results(truth, out, report=False, mosaics=NEAR)
    (out / "mosaics" / "mine.png").write_bytes(b"precious")
    with pytest.raises(InputError, match=r"found other things in it: mosaics/mine\.png"):
        check_out(out)
    (out / "mosaics" / "mine.png").unlink()
    check_out(out)
    (out / "mosaics" / "mosaics.json").write_text("{}")
    with pytest.raises(InputError, match="found other things in it: mosaics/"):
        check_out(out)


@pytest.mark.slow
def test_a_failure_leaves_the_older_results_whole(
    truth: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    write_results(truth, out, report=False, mosaics=NEAR)
    before = sorted(p.relative_to(out) for p in out.rglob("*"))

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pancam_graph.mosaic._stop_files.comparison", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_results(truth, out, report=False, mosaics=NEAR)
    assert sorted(p.relative_to(out) for p in out.rglob("*")) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
def test_opportunity_seams_are_at_least_halved(opportunity_folder: Path) -> None:
    """An independent adjustment went from 0.82 to 0.12, 0.46 to 0.19, 0.60 to 0.21 px."""
    solution = solve(find_observations(read_pds(opportunity_folder)))
    traverse = solution.traverse
    seams = make_mosaics(solution, traverse.stops[0].id, traverse.images[0].camera).seams
    assert len(seams.overlaps) == 3
    for overlap in seams.overlaps:
        assert len(overlap.azimuth_deg) >= 40
        assert overlap.median_px("refined") < 0.21
        assert overlap.median_px("refined") < 0.5 * overlap.median_px("telemetry_own_surface")
        assert overlap.median_px("telemetry_own_surface") < overlap.median_px("telemetry")
    assert seams.median_px("refined") < 0.25 * seams.median_px("telemetry_own_surface")
