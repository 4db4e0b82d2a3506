"""Simulation: truth reproduces the pixels, errors have their statistics, streams are independent."""

import runpy
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import kstest

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import CAHVOR
from pancam_graph.cli import main
from pancam_graph.data import Observations
from pancam_graph.io import read_traverse
from pancam_graph.rigs import TEMPLATES, Eye, Rig, rig_template
from pancam_graph.simulate import Simulation, SimulationOptions, simulate
from support.parameters import slow_but_for

SMALL = SimulationOptions(stops=2, pans=3, sweep_rad=1.5)

PANORAMAS = (
    "mer-pancam",
    "mer-navcam",
    "msl-navcam",
    "mars2020-navcam",
    "mars2020-mastcam-z-34mm",
    "exomars-pancam",
    "stereo-pan-tilt",
)
"""Templates whose eyes are wide enough, and equal but for the HRC, for full panoramas that hang together."""


@lru_cache
def default_of(template: str) -> Simulation:
    return simulate(rig_template(template), SimulationOptions(stops=2), seed=1)


def observed(simulation: Simulation) -> Observations:
    observations = simulation.traverse.observations
    assert observations is not None
    return observations


def projected(simulation: Simulation) -> tuple[FloatArray, BoolArray]:
    """Pixels of the true landmarks in the true cameras, by a path of its own: gtsam poses, image by image."""
    traverse, truth, observations = simulation.traverse, simulation.truth, observed(simulation)
    uv, valid = np.zeros((len(observations), 2)), np.zeros(len(observations), dtype=bool)
    for i, image in enumerate(traverse.images):
        frame = int(traverse.image_frame[i])
        pan, tilt = truth.pan_tilt_rad[frame]
        eye = traverse.rig.eyes[traverse.rig.eye_index(image.camera)]
        world_T_camera = (
            truth.world_T_mast[int(traverse.frame_stop[frame])]
            * gtsam.Pose3(gtsam.Rot3.Rz(pan), np.zeros(3))
            * traverse.rig.pan_T_tilt
            * gtsam.Pose3(gtsam.Rot3.Ry(-tilt), np.zeros(3))
            * eye.head_T_camera
        )
        rows = np.flatnonzero(observations.image == i)
        points = truth.landmarks_m[observations.track[rows]]
        uv[rows], valid[rows] = eye.camera.project(
            np.array([world_T_camera.transformTo(p) for p in points]).reshape(-1, 3)
        )
    return uv, valid


def cahvor_rig() -> Rig:
    """A made-up mast with a tilt axis beside the pan axis and two strongly distorted eyes."""
    eyes = []
    for name, y in (("left", 0.2), ("right", -0.2)):
        axis = np.array([0.999, 0.02, -0.04]) / np.linalg.norm([0.999, 0.02, -0.04])
        right = np.cross(axis, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        model = CAHVOR(
            width_px=800,
            height_px=600,
            C=np.array([0.1, y, 0.03]),
            A=axis,
            H=700 * right + 390 * axis,
            V=705 * np.cross(axis, right) + 310 * axis,
            O=np.array([1.0, 0.0, 0.0]),
            R=np.array([1e-4, -0.12, 0.05]),
        )
        eyes.append(Eye.from_head_model(name, model))
    pan_T_tilt = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, 0.0, -0.02), np.array([0.01, 0.0, 0.2]))
    return Rig(name="cahvor", pan_T_tilt=pan_T_tilt, eyes=tuple(eyes))


@pytest.mark.parametrize(
    "name",
    slow_but_for(
        ["mer-navcam", "exomars-pancam", "msl-mastcam", "stereo-pan-tilt", "ladybug3", "cahvor"],
        [*TEMPLATES, "cahvor"],
    ),
)
def test_truth_reproduces_the_pixels_when_there_is_no_noise(name: str) -> None:
    rig = cahvor_rig() if name == "cahvor" else TEMPLATES[name]()
    simulation = simulate(rig, replace(SMALL, noise_px=0.0, prior="truth"), seed=3)
    uv, valid = projected(simulation)
    assert valid.all()
    np.testing.assert_allclose(observed(simulation).uv_px, uv, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(observed(simulation).uv_px, simulation.truth.uv_px)
    assert (observed(simulation).sigma_px > 0).all()
    for stop, pose in zip(simulation.traverse.stops, simulation.truth.world_T_mast, strict=True):
        np.testing.assert_array_equal(stop.world_T_mast.matrix(), pose.matrix())
    np.testing.assert_array_equal(simulation.traverse.pan_tilt_rad, simulation.truth.pan_tilt_rad)


@pytest.mark.parametrize("template", slow_but_for(["mer-navcam", "stereo-pan-tilt"], PANORAMAS))
def test_every_image_sees_enough_and_every_track_is_seen_enough(template: str) -> None:
    simulation = default_of(template)
    traverse, observations = simulation.traverse, observed(simulation)
    per_image = np.bincount(observations.image, minlength=len(traverse.images))
    hrc = np.array([image.camera == "hrc" for image in traverse.images])
    assert per_image[~hrc].min() >= 30
    assert 60 <= np.median(per_image[~hrc]) <= 160
    assert not hrc.any() or per_image[hrc].min() >= 6
    views = np.bincount(observations.track)
    assert len(views) == len(simulation.truth.landmarks_m)  # numbers are dense
    assert views.min() >= 2
    for i, eye in enumerate(traverse.rig.eyes):
        assert eye.camera.contains(simulation.truth.uv_px[traverse.image_eye[observations.image] == i]).all()


@pytest.mark.parametrize("template", slow_but_for(["mer-navcam", "stereo-pan-tilt"], PANORAMAS))
def test_each_stop_hangs_together_by_shared_tracks(template: str) -> None:
    traverse, observations = default_of(template).traverse, observed(default_of(template))
    sees = coo_array(
        (np.ones(len(observations)), (observations.image, observations.track)),
        shape=(len(traverse.images), int(observations.track.max()) + 1),
    ).tocsr()
    shared = (sees @ sees.T).toarray()
    hrc = np.array([image.camera == "hrc" for image in traverse.images])
    for stop in range(len(traverse.stops)):
        here = traverse.image_stop == stop
        wide = np.flatnonzero(here & ~hrc)
        assert connected_components(shared[np.ix_(wide, wide)] >= 10)[0] == 1
        for eye in np.unique(traverse.image_eye[wide]):  # and even one eye by itself
            own = wide[traverse.image_eye[wide] == eye]
            assert connected_components(shared[np.ix_(own, own)] >= 3)[0] == 1
        # One HRC frame does not overlap the next; each hangs on the wide angle images.
        assert (shared[np.ix_(here & hrc, wide)].max(axis=1, initial=0) >= 3).all()
        others = np.flatnonzero(~here & ~hrc)
        assert (shared[np.ix_(wide, others)] > 0).sum() > 10


@pytest.mark.parametrize("template", PANORAMAS)
def test_points_lie_on_ground_rocks_and_horizon_from_near_to_far(template: str) -> None:
    truth = default_of(template).truth
    xy, height = truth.landmarks_m[:, :2], truth.landmarks_m[:, 2]
    np.testing.assert_allclose(height, truth.terrain.height_m(xy), rtol=0, atol=1e-9)
    distance = np.linalg.norm(truth.landmarks_m - truth.world_T_mast[0].translation(), axis=1)
    above = height - truth.terrain.ground_m(xy)
    assert distance.min() < 4
    assert (distance > 700).sum() >= 20
    assert ((above > 0.03) & (distance < 100)).mean() > 0.01
    for low, high in ((3, 6), (6, 12), (12, 25), (25, 100)):
        assert ((distance > low) & (distance < high)).mean() > 0.02


def test_mast_stands_on_the_ground_along_its_slope() -> None:
    options = SimulationOptions(stops=60, pans=1, tilts_rad=(-0.4,), points_per_image=4, slope_rad=0.06)
    simulation = simulate(rig_template("mer-navcam"), options, seed=2)
    poses = simulation.truth.world_T_mast
    up = np.array([pose.rotation().matrix()[:, 2] for pose in poses])
    foot = np.array([pose.translation() for pose in poses]) - simulation.traverse.rig.mast_height_m * up
    np.testing.assert_allclose(foot[:, 2], simulation.truth.terrain.ground_m(foot[:, :2]), atol=1e-9)
    step = np.linalg.norm(np.diff(foot[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(step, options.spacing_m)
    assert 0.03 < np.sqrt(np.mean(up[:, :2] ** 2)) < 0.09


def test_noise_is_gaussian_with_its_sigma_and_outliers_are_anywhere() -> None:
    simulation = simulate(
        rig_template("mer-navcam"), SimulationOptions(stops=2, noise_px=0.4, outliers=0.1), seed=5
    )
    observations, truth = observed(simulation), simulation.truth
    share = truth.outlier.mean()
    assert abs(share - 0.1) < 4 * np.sqrt(0.09 / len(observations))
    noise = (observations.uv_px - truth.uv_px)[~truth.outlier]
    assert kstest(noise.ravel() / 0.4, "norm").pvalue > 1e-3
    assert abs(np.asarray(np.corrcoef(noise.T))[0, 1]) < 4 / np.sqrt(len(noise))
    anywhere = (observations.uv_px[truth.outlier] + 0.5) / 1024
    assert kstest(anywhere.ravel(), "uniform").pvalue > 1e-3
    np.testing.assert_array_equal(observations.sigma_px, 0.4)


def test_telemetry_errors_have_the_sigmas_of_the_priors() -> None:
    options = SimulationOptions(
        stops=60,
        pans=8,
        tilts_rad=(-0.2,),
        points_per_image=1,
        link_stops=1,
        pointing_scale=2.0,
        sigma_stop_m=0.2,
    )
    simulation = simulate(rig_template("mer-navcam"), options, seed=4)
    traverse, truth = simulation.traverse, simulation.truth
    sigma = np.array([[f.sigma_pan_rad, f.sigma_tilt_rad] for f in traverse.frames])
    np.testing.assert_allclose(sigma, 2 * np.deg2rad(0.077))
    angle = (traverse.pan_tilt_rad - truth.pan_tilt_rad) / sigma
    assert kstest(angle.ravel(), "norm").pvalue > 1e-3
    assert traverse.stops[0].sigma_rotation_rad == traverse.stops[0].sigma_translation_m == 0
    np.testing.assert_array_equal(traverse.stops[0].world_T_mast.matrix(), truth.world_T_mast[0].matrix())
    normalised = np.array(
        [
            true.logmap(stop.world_T_mast) / np.repeat([stop.sigma_rotation_rad, stop.sigma_translation_m], 3)
            for true, stop in list(zip(truth.world_T_mast, traverse.stops, strict=True))[1:]
        ]
    )
    assert kstest(normalised.ravel(), "norm").pvalue > 1e-3
    np.testing.assert_allclose(np.var(normalised, axis=0), 1, atol=4 * np.sqrt(2 / 59))


def test_same_seed_same_numbers_another_seed_others() -> None:
    rig, options = rig_template("mer-navcam"), replace(SMALL, outliers=0.05)
    first, again, other = (simulate(rig, options, seed=s) for s in (7, 7, 8))
    for field in ("image", "track", "uv_px", "sigma_px"):
        np.testing.assert_array_equal(getattr(observed(first), field), getattr(observed(again), field))
    np.testing.assert_array_equal(first.truth.landmarks_m, again.truth.landmarks_m)
    np.testing.assert_array_equal(first.traverse.pan_tilt_rad, again.traverse.pan_tilt_rad)
    assert not np.array_equal(first.traverse.pan_tilt_rad, other.traverse.pan_tilt_rad)
    assert not np.array_equal(first.truth.landmarks_m[:9], other.truth.landmarks_m[:9])


def test_noise_outliers_and_telemetry_do_not_move_the_rest() -> None:
    rig = rig_template("exomars-pancam")
    base = simulate(rig, replace(SMALL, noise_px=0.2))
    noisy = simulate(rig, replace(SMALL, noise_px=0.6, outliers=0.1))
    off = simulate(rig, replace(SMALL, noise_px=0.2, pointing_scale=3.0, sigma_stop_m=1.0))
    for changed in (noisy, off):
        np.testing.assert_array_equal(base.truth.landmarks_m, changed.truth.landmarks_m)
        np.testing.assert_array_equal(base.truth.uv_px, changed.truth.uv_px)
    np.testing.assert_array_equal(base.traverse.pan_tilt_rad, noisy.traverse.pan_tilt_rad)
    np.testing.assert_array_equal(observed(base).uv_px, observed(off).uv_px)
    inliers = ~noisy.truth.outlier
    noise, more = (observed(s).uv_px[inliers] - s.truth.uv_px[inliers] for s in (base, noisy))
    np.testing.assert_allclose(more, 3 * noise, atol=1e-9)
    angle, larger = (s.traverse.pan_tilt_rad - s.truth.pan_tilt_rad for s in (base, off))
    np.testing.assert_allclose(larger, 3 * angle, atol=1e-12)


@pytest.mark.slow
def test_a_wrong_rig_is_claimed_and_the_true_one_makes_the_images() -> None:
    rig = rig_template("exomars-pancam")
    base = simulate(rig, SMALL)
    assert base.truth.rig is rig
    assert base.traverse.rig.eyes == rig.eyes
    errors: dict[str, Any] = {"focal_error": 0.01, "mount_error_rad": 0.01, "mount_error_m": 0.02}
    wrong = simulate(rig, replace(SMALL, **errors))
    np.testing.assert_array_equal(observed(base).uv_px, observed(wrong).uv_px)
    np.testing.assert_array_equal(base.traverse.pan_tilt_rad, wrong.traverse.pan_tilt_rad)
    assert wrong.truth.rig is rig
    drawn = []
    for seed in range(30):
        claimed = simulate(
            rig, replace(SMALL, **errors, stops=1, pans=1, points_per_image=2), seed=seed
        ).traverse.rig
        for eye, true in zip(claimed.eyes, rig.eyes, strict=True):
            before, after = true.camera.pinhole, eye.camera.pinhole
            assert (after.cx_px, after.cy_px) == pytest.approx((before.cx_px, before.cy_px))
            assert after.fx_px / before.fx_px == pytest.approx(after.fy_px / before.fy_px)
            between = true.head_T_camera.between(eye.head_T_camera)
            turn, shift = gtsam.Rot3.Logmap(between.rotation()), between.translation()
            drawn.append([(after.fx_px / before.fx_px - 1) / 0.01, *(turn / 0.01), *(shift / 0.02)])
    square = np.mean(np.array(drawn) ** 2, axis=0)
    assert np.all(np.abs(square - 1) < 4 * np.sqrt(2 / len(drawn)))
    assert np.all(np.abs(np.mean(drawn, axis=0)) < 4 / np.sqrt(len(drawn)))


def test_an_error_of_radius_is_one_of_nothing_else_at_the_mean_tilt() -> None:
    rig = cahvor_rig()
    options = replace(SMALL, radius_error_m=0.01, tilts_rad=(-0.1, -0.5))
    claimed = simulate(rig, options).traverse.rig
    for eye in range(2):
        radius, phase, height = rig.circle(eye, -0.3)
        found = claimed.circle(eye, -0.3)
        assert 1e-4 < abs(found[0] - radius) < 0.04
        assert found[1:] == pytest.approx((phase, height), abs=1e-12)


def test_start_is_the_telemetry_wherever_the_priors_are() -> None:
    rig = rig_template("mer-navcam")
    usual = simulate(rig, SMALL)
    centred = simulate(rig, replace(SMALL, prior="truth"))
    np.testing.assert_array_equal(usual.traverse.pan_tilt_rad, usual.telemetry_start.pan_tilt_rad)
    np.testing.assert_array_equal(centred.telemetry_start.pan_tilt_rad, usual.telemetry_start.pan_tilt_rad)
    for a, b, c in zip(
        usual.traverse.stops,
        usual.telemetry_start.world_T_mast,
        centred.telemetry_start.world_T_mast,
        strict=True,
    ):
        np.testing.assert_array_equal(a.world_T_mast.matrix(), b.matrix())
        np.testing.assert_array_equal(b.matrix(), c.matrix())
    assert np.abs(centred.telemetry_start.pan_tilt_rad - centred.truth.pan_tilt_rad).max() > 1e-4
    np.testing.assert_array_equal(observed(usual).uv_px, observed(centred).uv_px)


def test_observations_per_image_do_not_grow_with_the_length_of_the_drive() -> None:
    rig = rig_template("mer-navcam")
    mean = [
        len(observed(s)) / len(s.traverse.images)
        for s in (
            simulate(rig, SimulationOptions(stops=n, pans=6, tilts_rad=(-0.2,), points_per_image=6))
            for n in (8, 20)
        )
    ]
    assert mean[1] < 1.25 * mean[0]


def lines_of_sight_m(simulation: Simulation) -> FloatArray:
    """From the true camera to the true landmark (observations, 3)."""
    traverse, truth, observations = simulation.traverse, simulation.truth, observed(simulation)
    _, centres = traverse.camera_poses(truth.world_T_mast, truth.pan_tilt_rad)
    return np.asarray(truth.landmarks_m[observations.track] - centres[observations.image])


def test_nothing_is_matched_beyond_the_reach_and_lines_that_end_there_are_drawn_anew() -> None:
    rig, options = rig_template("mer-navcam"), replace(SMALL, stops=3, tilts_rad=(-0.1,))
    near, usual = simulate(rig, replace(options, reach_m=12.0), seed=3), simulate(rig, options, seed=3)
    distance = np.linalg.norm(lines_of_sight_m(near), axis=1)
    assert 11 < distance.max() <= 12
    assert np.linalg.norm(lines_of_sight_m(usual), axis=1).max() > 100
    assert len(near.truth.landmarks_m) > 0.7 * len(usual.truth.landmarks_m)


def test_how_differently_a_point_may_look_is_an_option() -> None:
    rig, options = rig_template("mer-navcam"), replace(SMALL, stops=3, detection=1.0, reach_m=15.0)
    turns, zooms, stops_seeing = [], [], []
    for max_turn_rad, max_zoom in ((0.3, 1.3), (float(np.pi), 10.0)):
        wanted = replace(options, max_turn_rad=max_turn_rad, max_zoom=max_zoom)
        simulation = simulate(rig, wanted, seed=3)
        observations, lines = observed(simulation), lines_of_sight_m(simulation)
        distance = np.linalg.norm(lines, axis=1)
        # Some image of the track found it: no two are farther apart than twice the limit.
        first = np.unique(observations.track, return_index=True)[1][observations.track]
        cosine = np.sum(lines * lines[first], axis=1) / (distance * distance[first])
        turns.append(np.arccos(np.clip(cosine, -1, 1)).max() / max_turn_rad)
        zooms.append(np.maximum(distance / distance[first], distance[first] / distance).max())
        stop = simulation.traverse.image_stop[observations.image]
        stops_seeing.append(len(np.unique(observations.track * 3 + stop)) / (observations.track.max() + 1))
    assert turns[0] <= 2
    assert zooms[0] <= 1.3**2 + 1e-9
    assert zooms[1] > 2
    assert stops_seeing[1] > 1.3 * stops_seeing[0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("stops", 0),
        ("stops", 1.5),
        ("pans", 0),
        ("points_per_image", 0),
        ("min_views", 1),
        ("tilts_rad", ()),
        ("tilts_rad", (2.0,)),
        ("noise_px", -0.1),
        ("noise_px", float("nan")),
        ("outliers", 1.0),
        ("outliers", -0.1),
        ("detection", 0.0),
        ("sigma_stop_m", float("inf")),
        ("pointing_scale", -1.0),
        ("sweep_rad", 7.0),
        ("reach_m", 0.5),
        ("reach_m", float("nan")),
        ("max_turn_rad", 0.0),
        ("max_turn_rad", 4.0),
        ("max_zoom", 0.9),
        ("max_zoom", float("inf")),
        ("focal_error", -1e-3),
        ("mount_error_rad", float("nan")),
        ("mount_error_m", -1e-3),
        ("radius_error_m", float("inf")),
        ("prior", "wish"),
    ],
)
def test_nonsense_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(InputError, match=f"simulation: {name}: expected .*, found "):
        replace(SMALL, **{name: value})  # type: ignore[arg-type]  # what a type checker would refuse too


def test_a_view_of_nothing_but_sky_is_refused() -> None:
    rig = rig_template("mer-pancam")
    with pytest.raises(InputError, match="sky"):
        simulate(rig, SimulationOptions(stops=1, pans=2, tilts_rad=(1.0,)))
    with pytest.raises(InputError, match="reach_m"):
        simulate(rig, SimulationOptions(stops=1, pans=2, reach_m=1.0))
    with pytest.raises(InputError, match="seed"):
        simulate(rig, seed=-1)


def test_program_writes_a_traverse_with_the_truth_beside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    numbers = ["--stops", "2", "--pans", "3", "--sweep-deg", "90", "--tilts-deg", "-5", "-30"]
    assert main(["simulate", str(out), *numbers, "--outliers", "0.1"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert said.out.count("\n") == 1
    options = SimulationOptions(
        stops=2,
        pans=3,
        sweep_rad=np.pi / 2,
        tilts_rad=tuple(np.deg2rad([-5.0, -30.0]).tolist()),
        outliers=0.1,
    )
    expected = simulate(rig_template("mer-navcam"), options)
    observations = read_traverse(out).observations
    assert observations is not None
    np.testing.assert_array_equal(observations.uv_px, observed(expected).uv_px)
    with np.load(out / "truth.npz") as truth:
        np.testing.assert_array_equal(truth["landmarks_m"], expected.truth.landmarks_m)
        np.testing.assert_array_equal(truth["outlier"], expected.truth.outlier)
        assert truth["world_T_mast"].shape == (2, 4, 4)
        assert truth["pan_tilt_rad"].shape == (12, 2)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["old"], "old: expected a new or empty folder, found files"),
        (["new", "--noise-px", "-1"], "noise_px: expected a number of 0 or above, found -1.0"),
        (["new", "--stops", "1", "--pans", "2", "--tilts-deg", "60"], "the sky, "),
    ],
)
def test_program_refuses_in_one_sentence_and_writes_nothing(
    arguments: list[str],
    sentence: str,
    scripts_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "traverse.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["simulate_traverse.py", *arguments])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(scripts_folder / "simulate_traverse.py"), run_name="__main__")
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert sentence in said.err
    assert not (tmp_path / "new").exists()
    assert (tmp_path / "old" / "traverse.json").read_text() == "{}"
