"""Masks: the user's files, missing and saturated pixels, sky, and the rover that drives along."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from scipy import ndimage

from pancam_graph import RenderOptions, Traverse, read_traverse, render, write_traverse
from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import rz
from pancam_graph.cameras import Pinhole
from pancam_graph.images import FrontEndOptions, ImageMask, Reason, find_masks, find_observations
from pancam_graph.images._masks import elevation_rad, saturated
from pancam_graph.images._sky import find_sky
from pancam_graph.io import mask_file, read_image, read_pds
from pancam_graph.rigs import mer_navcam
from support.image_scenes import QUICK, SIZE_PX, Scene, as_bytes, found_in, make_traverse
from support.pictures import read_picture

ROWS = np.arange(SIZE_PX)[:, None]
SECOND = gtsam.Pose3(gtsam.Rot3(rz(0.15)), np.array([0.3, 0.5, 0.0]))


def write_mask(path: Path, mask: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), mask)


def left_half_black() -> np.ndarray:
    mask = np.full((SIZE_PX, SIZE_PX), 255, np.uint8)
    mask[:, : SIZE_PX // 2] = 0
    return mask


def lowest_u_px(traverse: Traverse) -> dict[str, float]:
    obs = found_in(traverse)
    return {im.id: float(obs.uv_px[obs.image == i, 0].min()) for i, im in enumerate(traverse.images)}


# --- the user's ---


def test_nothing_is_observed_where_a_mask_is_black_nor_moved_by_what_it_covers(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(0.0, 8.0), eyes=("left",))
    plain = lowest_u_px(find_observations(truth, QUICK))
    assert max(plain.values()) < SIZE_PX // 2 - 30
    write_mask(tmp_path / "half.png", left_half_black())
    masked = replace(truth, images=(replace(truth.images[0], mask="half.png"), truth.images[1]))
    found = find_observations(masked, QUICK)
    assert lowest_u_px(found)["s0-f0-left"] > SIZE_PX // 2 + 3
    # Whatever is behind the mask: the same pixels, refined ones too.
    file = tmp_path / str(truth.images[0].file)
    grey = read_picture(file)
    obs = found_in(found)
    near = obs.uv_px[obs.image == 0, 0] < SIZE_PX // 2 + 8
    assert obs.covariance_px2 is not None
    # A feature's own place is as sure along u as along v; a patch's never is.
    refined = (obs.covariance_px2[:, 0, 0] != obs.covariance_px2[:, 1, 1])[obs.image == 0]
    assert np.count_nonzero(near) > 3
    assert not (near & refined).any()
    assert np.count_nonzero(refined) > 30
    assert grey.shape == (SIZE_PX, SIZE_PX)


@pytest.mark.slow
def test_a_mask_of_zeros_and_ones_means_the_same(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(0.0, 8.0), eyes=("left",))
    masked = replace(truth, images=tuple(replace(i, mask="mask.png") for i in truth.images))
    write_mask(tmp_path / "mask.png", left_half_black())
    first = as_bytes(found_in(find_observations(masked, QUICK)))
    write_mask(tmp_path / "mask.png", left_half_black() // 255)
    assert as_bytes(found_in(find_observations(masked, QUICK))) == first


def test_masks_are_found_by_name_image_before_pointing_before_camera(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(-26.0, 0.0), eyes=("left", "right"))
    white = np.full((SIZE_PX, SIZE_PX), 255, np.uint8)
    names = ("left", "left_pan-26.3_tilt0", "left_pan-26.1_tilt0.2", "s0-f1-right", "left_pan-20_tilt0")
    for name in names:
        write_mask(tmp_path / "masks" / f"{name}.png", white)
    write_mask(tmp_path / "named.png", white)
    found = [mask_file(truth, row) for row in range(4)]
    assert [None if f is None else f.stem for f in found] == [
        "left_pan-26.1_tilt0.2",
        None,
        "left",
        "s0-f1-right",
    ]
    named = replace(truth, images=tuple(replace(i, mask="named.png") for i in truth.images))
    assert {mask_file(named, row) for row in range(4)} == {tmp_path / "named.png"}


def test_a_written_traverse_takes_its_masks_along(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    truth, _ = make_traverse(tmp_path / "a", pans_deg=(0.0,))
    write_mask(tmp_path / "a" / "named.png", left_half_black())
    write_mask(tmp_path / "a" / "masks" / "right.png", left_half_black())
    masked = replace(truth, images=(replace(truth.images[0], mask="named.png"), truth.images[1]))
    write_traverse(masked, tmp_path / "b")
    again = read_traverse(tmp_path / "b")
    assert [i.mask for i in again.images] == ["named.png", None]
    assert mask_file(again, 1) == tmp_path / "b" / "masks" / "right.png"
    assert '"mask": null' not in (tmp_path / "b" / "traverse.json").read_text()


@pytest.mark.parametrize("place", ["named.png", "masks/left.png"])
def test_a_mask_of_another_size_is_refused_by_name(tmp_path: Path, place: str) -> None:
    (tmp_path / "a").mkdir()
    truth, _ = make_traverse(tmp_path, pans_deg=(0.0,), eyes=("left",))
    write_mask(tmp_path / place, np.zeros((100, SIZE_PX), np.uint8))
    mask = place if place == "named.png" else None
    write_traverse(replace(truth, images=(replace(truth.images[0], mask=mask),)), tmp_path / "b")
    message = rf"{place}: expected a mask of 240 x 240 pixels as of image s0-f0-left\.png, found 240 x 100"
    with pytest.raises(ImageError, match=r"images\[0\] \(s0-f0-left\): .*" + message):
        read_traverse(tmp_path / "b")
    with pytest.raises(ImageError, match=message):
        find_observations(
            replace(truth, folder=tmp_path / "b", images=(replace(truth.images[0], mask=mask),))
        )


def test_a_missing_mask_and_one_outside_the_folder_are_refused(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(0.0,), eyes=("left",))
    write_traverse(truth, tmp_path, overwrite=True)
    path = tmp_path / "traverse.json"
    plain = path.read_text()
    path.write_text(plain.replace('"camera": "left",', '"camera": "left", "mask": "no.png",'))
    with pytest.raises(
        ImageError, match=r"images\[0\].*no\.png: expected an image file, found nothing there"
    ):
        read_traverse(tmp_path)
    path.write_text(plain.replace('"camera": "left",', '"camera": "left", "mask": "../no.png",'))
    with pytest.raises(InputError, match=r"images\[0\]\.mask: expected a path inside the traverse folder"):
        read_traverse(tmp_path)


# --- saturated ---


def test_saturated_blocks_are_found_at_full_scale_and_at_the_images_own_limit() -> None:
    rng = np.random.default_rng(1)
    grey = ndimage.gaussian_filter(rng.normal(size=(200, 200)), 3)
    grey = 100 + 400 * grey
    for limit, dtype in ((255, np.uint8), (4095, np.uint16), (180, np.uint8)):
        scaled = grey * (limit / 130)
        image = np.clip(np.rint(scaled), 0, limit).astype(dtype)
        found = saturated(image)
        assert 0.02 < found.mean() < 0.4
        assert int(image[found].min()) >= 0.98 * limit
        assert np.mean(found[ndimage.binary_erosion(scaled > limit, iterations=2)]) == 1
    unclipped = np.rint(180 * (grey - grey.min()) / np.ptp(grey)).astype(np.uint8)
    assert not saturated(unclipped).any()
    assert not saturated(np.full((50, 50), 90, np.uint8)).any()
    single = unclipped.copy()
    single[20, 20] = single[90, 30:32] = 255
    assert not saturated(single).any()
    assert saturated(np.full((50, 50), 255, np.uint8)).all()


# --- sky ---


def skyline_image(*, noise: float, roll: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A hazy ridge under a sky with vignetting, textured ground below; which pixels are sky; elevations."""
    rng = np.random.default_rng(5)
    v, u = np.mgrid[:256, :256].astype(float)
    elevation = np.deg2rad(0.1) * (90 - v + roll * (u - 128))
    ridge = 70 + 8 * np.sin(u / 30) - roll * (u - 128)
    ground = 120 - roll * (u - 128)
    texture = ndimage.gaussian_filter(rng.normal(size=v.shape), 1.5) * 120
    grey = np.where(v < ridge, 150.0, np.where(v < ground, 138.0, 110 + texture))
    grey = grey * (1 - 0.25 * ((u - 128) ** 2 + (v - 128) ** 2) / 128**2 / 2)
    grey = np.clip(np.rint(grey + rng.normal(scale=noise, size=v.shape)), 0, 255).astype(np.uint8)
    return grey, v < ridge, elevation


@pytest.mark.parametrize("noise", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("roll", [0.0, 0.15])
def test_sky_ends_above_a_smooth_ridge(noise: float, roll: float) -> None:
    image, sky, elevation = skyline_image(noise=noise, roll=roll)
    found = find_sky(image, elevation)
    assert not (found & ~sky).any()
    assert np.mean(found[ndimage.binary_erosion(sky, iterations=20, border_value=1)]) > 0.9


def test_a_hot_pixel_belongs_to_the_sky_and_a_slope_above_the_horizontal_does_not() -> None:
    image, _, elevation = skyline_image(noise=1.0)
    image[30, 100:103] = 255
    assert find_sky(image, elevation)[30, 101]
    upside = np.ascontiguousarray(image[::-1])
    assert not find_sky(upside, elevation).any()


def test_a_view_without_sky_has_none_and_one_of_sky_alone_has_nothing_else() -> None:
    image, _, elevation = skyline_image(noise=1.0)
    assert not find_sky(image[130:], elevation[:126]).any()
    assert not find_sky(image, elevation - np.deg2rad(20)).any()
    assert find_sky(image[:40], elevation[:40]).mean() > 0.9


def test_opportunity_sky_is_above_the_crater_rim(opportunity_folder: Path) -> None:
    traverse = read_pds(opportunity_folder)
    share, deepest = [], []
    for row, image in enumerate(traverse.images):
        found = find_sky(read_image(opportunity_folder / str(image.file)), elevation_rad(traverse, row))
        share.append(float(found.mean()))
        deepest.append(found[:, 300].sum() if found.any() else 0)
    # By eye: the far rim is at rows 121 and 107 of column 300 of two; a corner of the third is sky.
    assert share == pytest.approx([0.127, 0.136, 0.019, 0, 0], abs=0.015)
    assert 105 < deepest[0] < 121
    assert 90 < deepest[1] < 107


# --- the rover ---


def deck_truth(truth: Traverse, scene: Scene, row: int) -> np.ndarray:
    v, u = np.mgrid[:SIZE_PX, :SIZE_PX]
    on = scene.points_m(truth, row, np.column_stack([u.ravel(), v.ravel()]).astype(float))[1]
    return np.asarray(on.reshape(SIZE_PX, SIZE_PX))


@pytest.mark.slow
def test_what_drives_along_is_masked_between_stops_and_nothing_else(tmp_path: Path) -> None:
    truth, scene = make_traverse(
        tmp_path,
        pans_deg=(-13.0, 13.0),
        tilt_deg=-18.0,
        stops=(gtsam.Pose3(), SECOND),
        eyes=("left",),
        deck=True,
    )
    masks = find_masks(truth, QUICK)
    for row, mask in enumerate(masks):
        assert mask is not None
        rover = mask.reasons & Reason.ROVER > 0
        deck = deck_truth(truth, scene, row)
        assert 0.05 < deck.mean() < 0.6
        assert np.mean(rover[ndimage.binary_erosion(deck, iterations=8)]) > 0.9
        assert np.mean(rover[~ndimage.binary_dilation(deck, iterations=12)]) < 0.01
        assert np.mean(mask.usable(between_stops=False)[deck]) > 0.85
    obs = found_in(find_observations(truth, QUICK))
    stop = truth.image_stop[obs.image]
    tracks = range(int(obs.track.max()) + 1)
    linking = np.array([len(set(stop[obs.track == t].tolist())) > 1 for t in tracks])[obs.track]
    on_deck = np.zeros(len(obs), dtype=bool)
    for row in range(len(truth.images)):
        k = obs.image == row
        on_deck[k] = scene.points_m(truth, row, obs.uv_px[k])[1]
    assert np.count_nonzero(linking) > 40
    assert not (on_deck & linking).any()
    assert np.count_nonzero(on_deck & ~linking) > 40
    assert all(
        m is not None and m.share(Reason.ROVER) == 0 for m in find_masks(truth, replace(QUICK, masks="user"))
    )


def test_a_rover_that_hardly_moved_is_not_told_from_terrain(tmp_path: Path) -> None:
    beside = gtsam.Pose3(gtsam.Rot3(rz(0.004)), np.array([0.01, 0.01, 0.0]))
    truth, _ = make_traverse(
        tmp_path, pans_deg=(0.0,), tilt_deg=-18.0, stops=(gtsam.Pose3(), beside), eyes=("left",), deck=True
    )
    assert all(m is not None and m.share(Reason.ROVER) == 0 for m in find_masks(truth, QUICK))


@pytest.mark.slow
def test_rendered_deck_is_masked(tmp_path: Path) -> None:
    rig = mer_navcam()
    size = 384
    eyes = tuple(
        replace(
            e,
            camera=Pinhole(
                width_px=size,
                height_px=size,
                fx_px=e.camera.pinhole.fx_px * size / 1024,
                fy_px=e.camera.pinhole.fy_px * size / 1024,
                cx_px=(size - 1) / 2,
                cy_px=(size - 1) / 2,
            ),
        )
        for e in rig.eyes[:1]
    )
    options = RenderOptions(
        spacing_m=3, pans=6, sweep_rad=2 * np.pi * 5 / 6, tilts_rad=(np.deg2rad(-35),), deck=True
    )
    small = replace(rig, eyes=eyes)
    rendering, bare = (render(small, replace(options, deck=deck), seed=3) for deck in (True, False))
    (tmp_path / "images").mkdir()
    truths = []
    for row, image in enumerate(rendering.traverse.images):
        seen = rendering.image(row)
        cv2.imwrite(str(tmp_path / str(image.file)), seen)
        uv = np.column_stack([x.ravel() for x in np.meshgrid(np.arange(size), np.arange(size))]).astype(float)
        apart = rendering.points(row, uv)[0] - bare.points(row, uv)[0]
        truths.append((np.linalg.norm(apart, axis=1) > 0.05).reshape(size, size))
    masks = find_masks(replace(rendering.traverse, folder=tmp_path))
    found = []
    for deck, mask in zip(truths, masks, strict=True):
        assert isinstance(mask, ImageMask)
        rover = mask.reasons & Reason.ROVER > 0
        if deck.mean() > 0.05:
            found.append(np.mean(rover[ndimage.binary_erosion(deck, iterations=5)]))
        # Its shadow's edge may count as well, and is near it.
        assert np.mean(rover[~ndimage.binary_dilation(deck, iterations=30)]) < 0.01
    assert len(found) >= 6
    assert np.median(found) > 0.98
    # Straight ahead, ground moves so little in the image that nothing is said of the deck before it.
    assert min(found) > 0.9


def test_options_of_masks_are_checked() -> None:
    with pytest.raises(InputError, match="masks: expected automatic or user, found 'none'"):
        FrontEndOptions(masks="none")  # type: ignore[arg-type]  # that is what is tested


def test_the_example_of_a_mask_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of docs/files.md masks that camera and pointing, and no other."""
    page = Path(__file__).resolve().parents[2] / "docs" / "files.md"
    if not page.exists():
        pytest.skip("no docs: they are part of the repository, not of the installed package")
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    folder = tmp_path / "TRAVERSE"
    folder.mkdir()
    truth, _ = make_traverse(folder, pans_deg=(-10.0, 10.0))
    write_traverse(truth, folder, overwrite=True)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "files.md", "exec"), {})
    traverse = read_traverse(folder)
    found = [mask_file(traverse, row) for row in range(len(traverse.images))]
    expected = [
        (i.frame, i.camera) == (traverse.images[0].frame, traverse.images[0].camera) for i in traverse.images
    ]
    assert [mask is not None for mask in found] == expected
    masks = find_masks(traverse, FrontEndOptions(masks="user"))
    assert masks[0] is not None
    reasons = masks[0].reasons & np.uint8(Reason.USER)
    assert reasons[160:].all()
    assert not reasons[:160].any()
