"""Finding observations in images: rendered scenes with known truth, and five frames of Opportunity."""

from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest

from pancam_graph import Traverse
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import rz
from pancam_graph.images import FrontEndOptions, find_observations, usable_mask
from pancam_graph.images._features import find_features
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._patch_noise import patch_covariance_px2, shared_by_tracks
from pancam_graph.images._tracks import Links, apart_tracks, join_tracks, shared_still, spread_tracks
from pancam_graph.images._verify import epipolar_px
from pancam_graph.io import read_pds
from support.image_scenes import (
    QUICK,
    SIZE_PX,
    Scene,
    as_bytes,
    disturbed,
    errors_px,
    found_in,
    make_traverse,
    small_rig,
)


@pytest.fixture(scope="module")
def panorama(tmp_path_factory: pytest.TempPathFactory) -> tuple[Traverse, Scene]:
    return make_traverse(tmp_path_factory.mktemp("panorama"))


@pytest.fixture(scope="module")
def panorama_found(panorama: tuple[Traverse, Scene]) -> Traverse:
    return on_threads(2, panorama[0])


def on_threads(number: int, traverse: Traverse) -> Traverse:
    threads = cv2.getNumThreads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PANCAM_GRAPH_THREADS", str(number))
        try:
            cv2.setNumThreads(number)
            return find_observations(traverse, QUICK)
        finally:
            cv2.setNumThreads(threads)


def test_feature_positions_count_from_the_centre_of_the_first_pixel() -> None:
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:SIZE_PX, :SIZE_PX].astype(float)
    grid = np.stack(np.meshgrid(np.arange(30, 220, 45), np.arange(30, 220, 45)), -1).reshape(-1, 2)
    spots = grid + rng.uniform(-0.5, 0.5, grid.shape)
    image = sum(120 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 1.8**2)) for x, y in spots) + 60
    camera = small_rig().eyes[0].camera
    up = np.array([0.0, -1.0, 0.0])
    found = find_features(
        np.rint(image).astype(np.uint8), np.ones((4, 4), dtype=bool), camera, up, FrontEndOptions()
    )
    difference = found.uv_px[:, None] - spots
    nearest = np.linalg.norm(difference, axis=2).argmin(axis=1)
    offset = difference[np.arange(len(found)), nearest]
    offset = offset[np.linalg.norm(offset, axis=1) < 1]
    assert len(offset) > 0.8 * len(spots)
    assert np.abs(np.median(offset, axis=0)).max() < 0.03


def test_blocks_of_zeros_are_not_used_but_single_dark_pixels_are() -> None:
    image = np.full((60, 60), 9, dtype=np.uint16)
    image[:, :10] = 0
    image[40, 40] = 0
    usable = usable_mask(image)
    assert not usable[:, :18].any()
    assert usable[:, 25:].all()


def test_tracks_lie_where_the_scene_says(panorama: tuple[Traverse, Scene], panorama_found: Traverse) -> None:
    truth, scene = panorama
    obs = found_in(panorama_found)
    assert obs.origin == "images"
    assert panorama_found.warnings == ()
    error = errors_px(truth, scene, obs)
    views = np.bincount(obs.track)
    assert len(views) > 400
    assert views.min() == 2
    assert np.count_nonzero(views > 2) > 50
    assert np.mean(error < 1) > 0.99
    assert np.median(error) < 0.1


def test_images_that_do_not_overlap_share_no_tracks(panorama_found: Traverse) -> None:
    obs = found_in(panorama_found)
    for track in np.unique(obs.track):
        frames = panorama_found.image_frame[obs.image[obs.track == track]]
        assert not {0, 2} <= set(frames.tolist())


def test_same_input_same_bytes_whatever_the_threads(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(-20.0, 0.0, 20.0), eyes=("left",))
    one, two = (as_bytes(found_in(on_threads(number, truth))) for number in (1, 2))
    assert one == two


@pytest.mark.slow
def test_disturbed_start_finds_the_same(panorama: tuple[Traverse, Scene], panorama_found: Traverse) -> None:
    truth, scene = panorama
    obs = found_in(find_observations(disturbed(truth, 0.5, seed=4), QUICK))
    error = errors_px(truth, scene, obs)
    assert len(obs) == pytest.approx(len(found_in(panorama_found)), rel=0.05)
    assert np.mean(error < 1) > 0.99


def test_sixteen_bits_are_read_as_well(tmp_path: Path) -> None:
    truth, scene = make_traverse(tmp_path, pans_deg=(0.0, 26.0), eyes=("left",), bits=16)
    obs = found_in(find_observations(truth, QUICK))
    assert np.median(errors_px(truth, scene, obs)) < 0.1
    assert len(obs) > 100


def test_between_stops_terrain_is_tied_and_the_deck_is_not(tmp_path: Path) -> None:
    second = gtsam.Pose3(gtsam.Rot3(rz(0.15)), np.array([0.3, 0.5, 0.0]))
    truth, scene = make_traverse(
        tmp_path,
        pans_deg=(-13.0, 13.0),
        tilt_deg=-18.0,
        stops=(gtsam.Pose3(), second),
        eyes=("left",),
        deck=True,
    )
    obs = found_in(find_observations(truth, QUICK))
    on_deck = np.zeros(len(obs), dtype=bool)
    for row in range(len(truth.images)):
        k = obs.image == row
        on_deck[k] = scene.points_m(truth, row, obs.uv_px[k])[1]
    stop = truth.image_stop[obs.image]
    linking = np.array([len(set(stop[obs.track == t].tolist())) > 1 for t in range(int(obs.track.max()) + 1)])
    assert np.count_nonzero(linking) > 40
    assert np.count_nonzero(on_deck & ~linking[obs.track]) > 40
    assert np.mean(on_deck[linking[obs.track]]) < 0.02


def test_points_that_start_beyond_infinity_are_kept(tmp_path: Path) -> None:
    options = FrontEndOptions()
    truth, _ = make_traverse(tmp_path, pans_deg=(0.0, 26.0), eyes=("left",))
    reference = found_in(find_observations(truth))
    # Between these frames the sphere's parallax is some 12 mrad; pointing that is wrong by more hides it.
    sigma = 0.01
    wrong = replace(
        truth,
        frames=tuple(
            replace(f, pan_rad=f.pan_rad + d, sigma_pan_rad=sigma, sigma_tilt_rad=sigma)
            for f, d in zip(truth.frames, (0.0, 0.02), strict=True)
        ),
    )
    obs = found_in(find_observations(wrong))
    pair = PairGeometry(wrong, 0, 1, options.mount_sigma_rad)
    _, inverse_depth = epipolar_px(pair, pair.no_correction, obs.uv_px[::2], obs.uv_px[1::2], options)
    assert np.mean(inverse_depth == 0) > 0.9
    assert len(obs) == pytest.approx(len(reference), rel=0.1)


def links(*rows: tuple[int, int, int, int, float]) -> Links:
    table = np.array(rows)
    columns = [table[:, i].astype(np.int64) for i in range(4)]
    return Links(
        image_a=columns[0],
        feature_a=columns[1],
        image_b=columns[2],
        feature_b=columns[3],
        distance=table[:, 4],
    )


def as_tracks(found: tuple[np.ndarray, ...]) -> list[list[tuple[int, int]]]:
    image, feature, track = (c.tolist() for c in found)
    out: list[list[tuple[int, int]]] = [[] for _ in range(max(track, default=-1) + 1)]
    for i, f, t in zip(image, feature, track, strict=True):
        out[t].append((i, f))
    return out


def test_links_join_to_tracks_numbered_by_their_first_feature() -> None:
    found = join_tracks(links((0, 7, 1, 3, 0.2), (1, 3, 2, 5, 0.1), (0, 2, 1, 9, 0.3)))
    assert as_tracks(found) == [[(0, 2), (1, 9)], [(0, 7), (1, 3), (2, 5)]]


def test_of_two_features_of_an_image_only_the_worse_leaves_the_track() -> None:
    found = join_tracks(links((0, 1, 1, 1, 0.1), (0, 1, 2, 1, 0.1), (1, 1, 2, 2, 0.4)))
    assert as_tracks(found) == [[(0, 1), (1, 1), (2, 1)]]


def test_what_hangs_on_the_worse_feature_leaves_with_it() -> None:
    found = join_tracks(
        links((0, 1, 1, 1, 0.1), (0, 1, 2, 1, 0.1), (1, 1, 2, 2, 0.4), (2, 2, 3, 8, 0.2), (2, 1, 3, 6, 0.1))
    )
    assert as_tracks(found) == [[(0, 1), (1, 1), (2, 1), (3, 6)], [(2, 2), (3, 8)]]


def test_order_of_links_does_not_matter() -> None:
    rng = np.random.default_rng(5)
    rows = [
        (a, int(rng.integers(12)), b, int(rng.integers(12)), float(rng.integers(4)))
        for a, b in rng.integers(4, size=(60, 2)).tolist()
        if a < b
    ]
    rows = sorted(set(rows))
    reference = as_tracks(join_tracks(links(*rows)))
    for _ in range(5):
        shuffled = [rows[i] for i in rng.permutation(len(rows))]
        assert as_tracks(join_tracks(links(*shuffled))) == reference
    for track in reference:
        assert len({image for image, _ in track}) == len(track) > 1


def test_no_links_no_tracks() -> None:
    assert as_tracks(join_tracks(Links.concatenate([]))) == []


def test_images_without_content_or_file_are_warned_of(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(-26.0, 0.0, 26.0, 52.0), eyes=("left",))
    cv2.imwrite(str(tmp_path / "s0-f2-left.png"), np.full((SIZE_PX, SIZE_PX), 90, np.uint8))
    images = (*truth.images[:-1], replace(truth.images[-1], file=None))
    seen: dict[str, list[tuple[int, int]]] = {}
    found = find_observations(
        replace(truth, images=images),
        QUICK,
        progress=lambda stage, done, of: seen.setdefault(stage, []).append((done, of)),
    )
    assert found.warnings == (
        "images s0-f1-left and s0-f2-left: no matches, although they overlap by pointing",
        "image s0-f2-left (s0-f2-left.png): no observations were found in it "
        "(none of its 0 features was found in another image)",
        "image s0-f3-left: it has no file",
    )
    assert set(seen) == {"images", "overlaps", "masks", "features", "matches", "refinement"}
    for counts in seen.values():
        assert counts == [(k + 1, len(counts)) for k in range(len(counts))]


def test_what_leaves_one_image_alone_is_named(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, eyes=("left",))
    cv2.imwrite(str(tmp_path / "s0-f1-left.png"), np.zeros((200, 240), np.uint8))
    size = r"s0-f1-left\.png: expected 240 x 240 .* camera left of .*, found 240 x 200"
    with pytest.raises(InputError, match=rf"features that several images share, found none .*{size}"):
        find_observations(truth, QUICK)
    (tmp_path / "s0-f1-left.png").unlink()
    with pytest.raises(InputError, match=r"found none .*s0-f1-left\.png: .*, found nothing there"):
        find_observations(truth, QUICK)


def test_no_files_and_nothing_found_are_refused(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, eyes=("left",))
    without = replace(truth, images=tuple(replace(i, file=None) for i in truth.images))
    with pytest.raises(InputError, match="expected observations or image files, found neither"):
        find_observations(without, QUICK)
    for image in truth.images:
        cv2.imwrite(str(tmp_path / str(image.file)), np.zeros((SIZE_PX, SIZE_PX), np.uint8))
    with pytest.raises(InputError, match="expected features that several images share, found none"):
        find_observations(truth, QUICK)


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="min_depth_m: expected a number above 0, found 0"):
        FrontEndOptions(min_depth_m=0.0)
    with pytest.raises(InputError, match=r"ratio: expected a number below 1, found 1\.5"):
        FrontEndOptions(ratio=1.5)


@pytest.mark.slow
def test_opportunity(opportunity_folder: Path) -> None:
    traverse = read_pds(opportunity_folder)
    found = find_observations(traverse)
    obs = found_in(found)
    pairs = {tuple(obs.image[obs.track == t].tolist()) for t in np.unique(obs.track)}
    assert pairs == {(0, 1), (2, 3), (3, 4)}
    assert len(np.unique(obs.track)) > 1800
    assert np.mean(obs.sigma_px < FrontEndOptions().sigma_px) > 0.85
    again = found_in(find_observations(disturbed(traverse, 0.5, seed=0)))
    assert len(again) == pytest.approx(len(obs), rel=0.02)


def test_of_tracks_that_come_near_each_other_the_longest_stays() -> None:
    image = np.array([0, 1, 0, 1, 2, 0, 1, 1, 2])
    track = np.array([0, 0, 1, 1, 1, 2, 2, 3, 3])
    uv = np.array([[10, 10], [50, 10], [14, 10], [80, 80], [5, 5], [10, 60], [56, 10], [83, 80], [90, 90]])
    # 0 is near 1 in image 0 and near 2 in image 1; 3 is near 1 in image 1.
    kept = apart_tracks(image, track, uv.astype(float), 8.0)
    assert np.unique(track[kept]).tolist() == [1, 2]
    assert kept.tolist() == np.isin(track, [1, 2]).tolist()
    assert apart_tracks(image, track, uv.astype(float), 2.0).all()


def test_a_track_that_loses_all_images_but_one_is_left_out_whole() -> None:
    track = np.array([0, 0, 0, 1, 1, 2, 2])
    kept = np.array([True, False, True, True, False, True, True])
    assert shared_still(track, kept).tolist() == [0, 2, 5, 6]


def test_noise_along_and_across_the_line_of_a_patch() -> None:
    fit = np.array([[0.04, 0.01, 0.02]])
    along = np.array([[0.6, 0.8]])
    across = np.array([[-0.8, 0.6]])
    none = np.zeros((1, 2))
    plain, lined = (patch_covariance_px2(fit, a, one_pointing=True)[0] for a in (none, along))
    assert along[0] @ (lined - 2 * plain) @ along[0] == pytest.approx(0, abs=1e-4)
    assert across[0] @ (lined - plain) @ across[0] == pytest.approx(0, abs=1e-12)


def test_noise_against_the_first_is_shared_out() -> None:
    """Track 0: two images of one frame and two of another; track 1: one that was not fitted."""
    track, frame = np.array([0, 0, 0, 0, 1, 1]), np.array([0, 0, 1, 1, 0, 1])
    moved = np.array([False, True, True, True, False, False])
    own = np.array([1.0, 2.0, 3.0, 4.0, 9.0, 9.0])[:, None, None] * np.eye(2)
    out = shared_by_tracks(own, own, moved, track, frame)[:, 0, 0]
    # The first of the track and its stereo partner have together the noise of the one against the other.
    assert out[0] == pytest.approx(0.3 * np.mean([2, 3, 4]))
    assert out[1] == pytest.approx(0.7 * 2)
    # Two images that err alike, with a correlation of 0.6, tell as much as 1 / 0.8 of one.
    assert out[2:4].tolist() == pytest.approx([0.7 * 3 * 1.6, 0.7 * 4 * 1.6])
    assert out[4:].tolist() == [9.0, 9.0]


def test_tracks_are_thinned_evenly_and_stay_whole() -> None:
    """A thousand points in one corner and fifty elsewhere, seen by two images, some of them by a third."""
    rng = np.random.default_rng(2)
    uv = np.concatenate([rng.uniform(0, 60, (1000, 2)), rng.uniform(0, 1000, (50, 2))])
    views = np.where(np.arange(len(uv)) % 5 == 0, 3, 2)
    track = np.repeat(np.arange(len(uv)), views)
    image = np.arange(len(track)) - np.searchsorted(track, track)
    size = np.full((3, 2), 1000.0)
    kept = spread_tracks(image, track, uv[track], size, 100)
    chosen = np.unique(track[kept])
    assert (np.bincount(track[kept], minlength=len(uv))[chosen] == views[chosen]).all()
    assert set(range(1000, 1050)) <= set(chosen.tolist())
    crowd = chosen[chosen < 1000]
    assert 40 < len(crowd) < 200
    assert np.mean(views[crowd] == 3) == pytest.approx(1)
    assert spread_tracks(image, track, uv[track], size, 2000).all()
