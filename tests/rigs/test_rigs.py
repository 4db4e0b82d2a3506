"""Shipped rigs against published numbers, and what is particular to each."""

import json
import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph import SimulationOptions, SolveOptions, Traverse, read_traverse, simulate, solve
from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHVOR, CAHVORE, Pinhole
from pancam_graph.graph import Flex
from pancam_graph.initialise import Start
from pancam_graph.io import read_input
from pancam_graph.rigs import (
    MARS2020_MAST,
    MSL_MAST,
    TEMPLATES,
    Eye,
    MastKinematics,
    PointingSigma,
    Rig,
    exomars_pancam,
    ladybug3,
    ladybug5,
    mars2020_mastcam_z,
    mars2020_navcam,
    msl_mastcam,
    msl_navcam,
    rig_template,
    stereo_pan_tilt,
)
from support.parameters import slow_but_for
from support.published_cameras import LINEAR_PIXEL_B, PIXEL_B, PIXELS_C, POINT_B, POINTS_C

FLIP = np.diag([1.0, -1.0, -1.0])


def document_pose(eye: Eye, head_T_document: gtsam.Pose3) -> tuple[FloatArray, FloatArray]:
    """Rotation and centre of an eye in the mast's documented head frame, z down."""
    pose = head_T_document.inverse() * eye.head_T_camera
    return pose.rotation().matrix(), pose.translation()


def inwards_deg(rotation: FloatArray) -> float:
    """Yaw of the axis to the right, seen along the documented head's x."""
    return float(np.rad2deg(np.arctan2(rotation[1, 2], rotation[0, 2])))


def from_pan_axis_m(rig: Rig) -> list[float]:
    return [rig.circle(i, 0.0)[0] for i in range(len(rig.eyes))]


def baseline_m(rig: Rig) -> float:
    left, right = (e.head_T_camera.translation() for e in rig.eyes[:2])
    return float(np.linalg.norm(left - right))


# --- Curiosity ------------------------------------------------------------------------------------


def test_msl_navcam_projects_as_its_published_label() -> None:
    """Test vector B, through the chain: from the rover frame, at the encoders' angles of the label."""
    rig = msl_navcam()
    right = rig.eyes[rig.eye_index("right")]
    rover_T_camera = MSL_MAST.rover_T_head(2.91281, 0.715421) * right.head_T_camera
    point = rover_T_camera.transformTo(FLIP @ POINT_B)[None]
    uv, valid = right.camera.project(point)
    assert valid.all()
    np.testing.assert_allclose(uv[0], PIXEL_B, atol=2e-6)
    np.testing.assert_allclose(right.camera.pinhole.project(point)[0][0], LINEAR_PIXEL_B, atol=2e-6)
    _, centre = document_pose(right, MSL_MAST.head_T_document())
    np.testing.assert_allclose(centre, [0.1141, 0.2096, -0.0341], atol=5e-5)
    assert from_pan_axis_m(rig) == pytest.approx([0.2386, 0.2386], abs=1e-3)
    assert baseline_m(rig) == pytest.approx(0.42, abs=2e-3)


def test_msl_navcam_looks_where_the_frame_kernel_says() -> None:
    """MSL frame kernel 0.8: lines of sight of the central pixels and twists, which no label went into."""
    for eye, kernel in (
        ("left", (89.86145547, -0.38921323, -90.02355994)),
        ("right", (89.91279432, -0.33489566, -90.29024820)),
    ):
        rig = msl_navcam()
        camera = rig.eyes[rig.eye_index(eye)]
        rotation, _ = document_pose(camera, MSL_MAST.head_T_document())
        expected = Rotation.from_euler("YXZ", kernel, degrees=True).as_matrix()
        central = camera.camera.unproject(np.array([[511.5, 511.5]])).direction[0]
        off = np.rad2deg(np.linalg.norm(np.cross(rotation @ central, expected[:, 2])))
        assert off < 0.02
        # The kernel's x points left in the image.
        twist = np.rad2deg(rotation[:, 0] @ expected[:, 1])
        assert abs(twist) < 0.02
        assert rotation[:, 0] @ expected[:, 0] < -0.999


def test_msl_mastcam_has_two_focal_lengths() -> None:
    rig = msl_mastcam()
    left, right = rig.eyes
    pinhole = left.camera.pinhole
    assert (pinhole.fx_px, pinhole.cx_px, pinhole.cy_px) == pytest.approx((4640.96, 679.64, 575.90), abs=0.01)
    assert right.camera.pinhole.fx_px / pinhole.fx_px == pytest.approx(100 / 34, rel=0.02)
    rotation, centre = document_pose(left, MSL_MAST.head_T_document())
    np.testing.assert_allclose(centre, [-0.0332, -0.1343, -0.0648], atol=5e-5)
    assert inwards_deg(rotation) == pytest.approx(1.77, abs=5e-3)
    assert from_pan_axis_m(rig)[0] == pytest.approx(0.138, abs=5e-4)
    right_R, right_t = document_pose(right, MSL_MAST.head_T_document())
    assert inwards_deg(right_R) == pytest.approx(-1.332, abs=0.2)  # frame kernel, central pixel
    np.testing.assert_allclose(right_t * [1, -1, 1], centre, atol=0.03)


# --- Perseverance ---------------------------------------------------------------------------------


def test_mars2020_navcam_projects_as_published() -> None:
    """Test vector C, and the table of both eyes."""
    rig = mars2020_navcam()
    left = rig.eyes[0]
    head_T_document = MARS2020_MAST.head_T_document()
    to_camera = left.head_T_camera.inverse() * head_T_document
    uv, valid = left.camera.project(np.array([to_camera.transformFrom(np.array(p)) for p in POINTS_C]))
    assert valid.all()
    np.testing.assert_allclose(uv, PIXELS_C, atol=2e-6)
    assert isinstance(left.camera, CAHVORE)
    # Without the moving pupil these near points would be elsewhere: the pixels hold E too.
    still = replace(left.camera, E=np.zeros(3))
    uv, _ = still.project(np.array([to_camera.transformFrom(np.array(p)) for p in POINTS_C]))
    assert np.linalg.norm(uv - PIXELS_C, axis=1).min() > 0.005
    for eye, numbers in zip(
        rig.eyes, ((2958.60, 2595.74, 1942.73), (2951.76, 2577.78, 1948.44)), strict=True
    ):
        p = eye.camera.pinhole
        assert (p.fx_px, p.cx_px, p.cy_px) == pytest.approx(numbers, abs=0.02)
    assert from_pan_axis_m(rig) == pytest.approx([0.2504, 0.2467], abs=1e-4)
    assert baseline_m(rig) == pytest.approx(0.42438, abs=1e-5)


def test_mastcam_z_zooms_as_published() -> None:
    zooms = (26, 34, 48, 63, 79, 100, 110)
    rigs = [mars2020_mastcam_z(z) for z in zooms]
    for eye in (0, 1):
        cameras = [r.eyes[eye].camera for r in rigs]
        focal_mm = np.array([c.pinhole.fx_px for c in cameras]) * 7.4e-3
        np.testing.assert_allclose(focal_mm, zooms, rtol=0.03)
        assert all(isinstance(c, CAHVOR) and (c.width_px, c.height_px) == (1648, 1200) for c in cameras)
        # Vectors typed wrongly would not be this orthogonal, nor the pixels this square.
        for p in (c.pinhole for c in cameras):
            assert p.fy_px / p.fx_px == pytest.approx(1, abs=1e-3)
            assert abs(p.skew_px) < 1e-3 * p.fx_px
        centres = np.array([r.eyes[eye].head_T_camera.translation() for r in rigs])
        assert np.ptp(centres[:, 0]) == pytest.approx(0.042, abs=3e-3)
        assert np.ptp(centres[:, 1:], axis=0).max() < 1.5e-3
    for rig in rigs:
        assert baseline_m(rig) == pytest.approx(0.243, abs=1.5e-3)
        yaws = [inwards_deg(document_pose(e, MARS2020_MAST.head_T_document())[0]) for e in rig.eyes]
        assert 0.8 < yaws[0] < 1.6
        assert -1.6 < yaws[1] < -0.8
        assert yaws[0] - yaws[1] == pytest.approx(2 * 1.17, abs=0.7)
    assert from_pan_axis_m(rigs[1]) == pytest.approx([0.1281, 0.1250], abs=1e-4)
    p = rigs[1].eyes[1].camera.pinhole
    assert (p.fx_px, p.cx_px, p.cy_px) == pytest.approx((4660.82, 844.62, 586.47), abs=0.02)


def test_a_zoom_that_is_not_published_is_refused() -> None:
    with pytest.raises(InputError, match=r"zoom_mm: expected one of 26, 34, .* 110; found 50"):
        mars2020_mastcam_z(50)
    with pytest.raises(InputError, match=r"expected one of .*mars2020-mastcam-z-34mm.*; found 'mars2020-m"):
        rig_template("mars2020-mastcam-z-50mm")


@pytest.mark.parametrize("mast", [MSL_MAST, MARS2020_MAST], ids=lambda m: m.name)
def test_the_documented_head_is_parallel_to_the_rover_at_home(mast: MastKinematics) -> None:
    at_home = mast.rover_T_head(mast.home_azimuth_rad, mast.home_elevation_rad) * mast.head_T_document()
    assert at_home.rotation().matrix() == pytest.approx(FLIP, abs=1e-12)
    # Azimuth turns clockwise, elevation up.
    ahead = mast.rover_T_head(mast.home_azimuth_rad + 0.3, mast.home_elevation_rad + 0.2).rotation().matrix()
    assert np.arctan2(ahead[1, 0], ahead[0, 0]) == pytest.approx(-0.3, abs=0.01)
    assert np.arcsin(ahead[2, 0]) == pytest.approx(0.2, abs=0.01)


# --- Rings ----------------------------------------------------------------------------------------

LADYBUG5_UNIT = (
    (0.061564, -0.000836, -0.000023),
    (0.017904, -0.058481, -0.000240),
    (-0.050197, -0.035245, -0.000097),
    (-0.048999, 0.036651, 0.000180),
    (0.019728, 0.057911, 0.000180),
    (0.000320, -0.000344, 0.076026),
)
"""Camera centres in a unit's calibration file (serial number 15402620), metres."""
LADYBUG5_UNIT_ANGLES = (
    (-2.151942, 1.566552, -2.151938),
    (-2.806324, 1.564830, 2.220612),
    (-1.815490, 1.566224, 1.958800),
    (2.320270, 1.569067, -1.446774),
    (-1.787905, 1.563776, -0.526615),
    (0.000197, 0.001386, -3.137179),
)
"""rotX, rotY, rotZ of the same: R = Rz Ry Rx, of the sensor, which lies on its side."""
LADYBUG3_UNIT = (
    (0.042, -0.002, 0.0),
    (0.011, -0.04, 0.0),
    (-0.035, -0.023, 0.0),
    (-0.033, 0.026, 0.0),
    (0.015, 0.039, 0.0),
    (0.001, -0.001, 0.062),
)


@pytest.mark.parametrize(("make", "unit"), [(ladybug5, LADYBUG5_UNIT), (ladybug3, LADYBUG3_UNIT)])
def test_ladybugs_are_rings_like_published_units(
    make: Callable[[], Rig], unit: tuple[tuple[float, float, float], ...]
) -> None:
    rig = make()
    assert not rig.turns
    centres = np.array([e.head_T_camera.translation() for e in rig.eyes])
    np.testing.assert_allclose(centres, unit, atol=3.5e-3)
    circles = np.array([rig.circle(i, 0.0) for i in range(5)])
    assert np.ptp(circles[:, 0]) < 1e-12
    assert np.ptp(circles[:, 2]) < 1e-12
    steps = np.angle(np.exp(1j * np.diff(circles[:, 1])))
    np.testing.assert_allclose(steps, -np.deg2rad(72), atol=1e-12)
    for i in range(5):  # each looks outwards
        outward = centres[i] / np.linalg.norm(centres[i])
        np.testing.assert_allclose(rig.eyes[i].head_T_camera.rotation().matrix()[:, 2], outward, atol=1e-12)


def test_ladybug_cameras_stand_as_a_units_file_has_them() -> None:
    for eye, angles in zip(ladybug5().eyes, LADYBUG5_UNIT_ANGLES, strict=True):
        sensor = Rotation.from_euler("xyz", angles).as_matrix()
        # An upright picture is the sensor's, turned a quarter: its right is the sensor's up.
        upright = np.column_stack([-sensor[:, 1], sensor[:, 0], sensor[:, 2]])
        off = Rotation.from_matrix(upright.T @ eye.head_T_camera.rotation().matrix()).magnitude()
        assert off < np.deg2rad(1.5)


LADYBUG_DRIVE = SimulationOptions(stops=4, points_per_image=40, spacing_m=2.0)


@pytest.mark.parametrize(
    ("make", "model"),
    slow_but_for(
        [(ladybug3, "circle"), (ladybug5, "mast")], product([ladybug3, ladybug5], ["mast", "circle"])
    ),
)
def test_a_ladybug_drive_is_exact_without_noise(make: Callable[[], Rig], model: str) -> None:
    simulation = simulate(make(), replace(LADYBUG_DRIVE, noise_px=0.0, prior="truth"), seed=2)
    t, telemetry = simulation.traverse, simulation.telemetry_start
    assert len(t.frames) == len(t.stops) == 4
    assert len(t.images) == 4 * 6
    assert all((f.pan_rad, f.tilt_rad, f.sigma_pan_rad, f.sigma_tilt_rad) == (0, 0, 0, 0) for f in t.frames)
    start = Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)
    solution = solve(t, SolveOptions(loss="none", model=model), start=start)  # type: ignore[arg-type]  # parametrised
    assert solution.converged
    for found, begun, true in zip(
        solution.final.world_T_mast[1:],
        telemetry.world_T_mast[1:],
        simulation.truth.world_T_mast[1:],
        strict=True,
    ):
        assert np.abs(true.localCoordinates(begun)).max() > 1e-2
        assert np.abs(true.localCoordinates(found)).max() < 1e-8
    assert np.abs(solution.final.pan_tilt_rad).max() < 1e-9


def test_a_ladybug_takes_one_frame_whatever_the_sweep() -> None:
    options = SimulationOptions(stops=2, pans=5, tilts_rad=(0.1, 0.2), sweep_rad=1.0, pointing_scale=3.0)
    t = simulate(ladybug5(), options, seed=0).traverse
    assert t.pan_tilt_rad.tolist() == [[0, 0], [0, 0]]


def with_radii(rig: Rig, change_m: FloatArray) -> Rig:
    """The ring with each eye farther out on its circle."""
    eyes = []
    for i, eye in enumerate(rig.eyes):
        _, phase, _ = rig.circle(i, 0.0)
        outward = np.array([np.cos(phase), np.sin(phase), 0.0])
        moved = eye.head_T_camera.translation() + change_m[i] * outward
        eyes.append(replace(eye, head_T_camera=gtsam.Pose3(eye.head_T_camera.rotation(), moved)))
    return replace(rig, eyes=tuple(eyes))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["mast", "circle"])
def test_a_ladybugs_errors_have_the_variance_that_the_covariance_says(model: str) -> None:
    """Six degrees of freedom of one stop; 60 drives, interval of 95 %.

    The model `circle` estimates the radii: there, each drive's ring has others, by that model's prior.
    """
    rig, firm = ladybug5(), Flex(rotation_rad=1e-5, translation_m=1e-5)
    misses = []
    for seed in range(60):
        change = 1e-3 * np.random.default_rng(seed).standard_normal(6) if model == "circle" else np.zeros(6)
        simulation = simulate(with_radii(rig, change), LADYBUG_DRIVE, seed=seed)
        options = SolveOptions(loss="none", rig="held", model=model, flex=firm if model == "circle" else None)  # type: ignore[arg-type]  # parametrised
        solution = solve(replace(simulation.traverse, rig=rig), options)
        shift = simulation.truth.world_T_mast[2].localCoordinates(solution.final.world_T_mast[2])
        misses.append(shift @ np.linalg.solve(solution.stop_covariance[2], shift))
    assert abs(np.mean(misses) / 6 - 1) < 1.96 * np.sqrt(2 / (6 * len(misses)))


# --- A zoomed eye beside two wide ones ------------------------------------------------------------

CLOSE = SimulationOptions(stops=1, pans=4, sweep_rad=0.24, tilts_rad=(-0.12, -0.17))
"""Frames so near to each other that the images of the HRC (4.9 degrees) overlap too."""


def without(t: Traverse, eye: str) -> Traverse:
    """The same traverse without the observations of an eye."""
    assert t.observations is not None
    return t.with_observations(
        t.observations.select(t.image_eye[t.observations.image] != t.rig.eye_index(eye))
    )


def first_frame_known(t: Traverse, pan_tilt_rad: FloatArray) -> Traverse:
    pan, tilt = pan_tilt_rad.tolist()
    first = replace(t.frames[0], pan_rad=pan, tilt_rad=tilt, sigma_pan_rad=0.0, sigma_tilt_rad=0.0)
    return replace(t, frames=(first, *t.frames[1:]))


def test_wide_and_zoomed_eyes_of_one_stop_are_solved_together() -> None:
    simulation = simulate(exomars_pancam(), replace(CLOSE, noise_px=0.0, prior="truth"), seed=1)
    t, telemetry = simulation.traverse, simulation.telemetry_start
    assert t.observations is not None
    seen_by = [set(t.image_eye[t.observations.image[t.observations.track == k]]) for k in range(400)]
    assert sum(eyes == {0, 1, 2} for eyes in seen_by) > 20  # tracks that join all three eyes
    start = Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)
    assert np.abs(start.pan_tilt_rad - simulation.truth.pan_tilt_rad).max() > 1e-3
    solution = solve(t, SolveOptions(loss="none"), start=start)
    assert solution.converged
    assert solution.used.all()
    assert np.abs(solution.final.pan_tilt_rad - simulation.truth.pan_tilt_rad).max() < 1e-10


@pytest.mark.slow
def test_the_zoomed_eye_sharpens_pan_and_tilt() -> None:
    """Relative to the first frame, which is known here: what all frames share, images cannot tell.

    Both the formal sigmas and the errors that are made: to 7.8 and 7.5 microradians from 12.
    """
    errors: dict[bool, list[FloatArray]] = {True: [], False: []}
    sigmas: dict[bool, list[FloatArray]] = {True: [], False: []}
    for seed in range(12):
        simulation = simulate(exomars_pancam(), CLOSE, seed=seed)
        truth = simulation.truth.pan_tilt_rad
        t = first_frame_known(simulation.traverse, truth[0])
        for zoomed, traverse in ((True, t), (False, without(t, "hrc"))):
            solution = solve(traverse, SolveOptions(loss="none", rig="held"))
            errors[zoomed].append((solution.final.pan_tilt_rad - truth)[1:])
            sigmas[zoomed].append(solution.angle_sigma_rad[1:])
    formal = {z: np.mean(sigmas[z], axis=(0, 1)) for z in sigmas}
    made = {z: np.sqrt(np.mean(np.square(errors[z]), axis=(0, 1))) for z in errors}
    assert (formal[True] < 0.7 * formal[False]).all()
    assert (made[True] < 0.7 * made[False]).all()
    squared = np.square(np.array(errors[True]) / np.array(sigmas[True])).mean(axis=(1, 2))
    assert abs(squared.mean() - 1) < 2.6 * squared.std() / np.sqrt(len(squared))


# --- Stereo pan-tilt unit -------------------------------------------------------------------------


def test_a_stereo_unit_is_what_its_parameters_say() -> None:
    sigma = PointingSigma(pan_rad=1e-3, tilt_rad=2e-3)
    rig = stereo_pan_tilt(
        baseline_m=0.4,
        field_rad=np.pi / 2,
        width_px=1000,
        height_px=500,
        forward_m=0.1,
        above_m=-0.02,
        toe_in_rad=0.05,
        tilt_axis_m=(0.01, 0.02, 0.3),
        pointing_sigma=sigma,
        mast_height_m=0.8,
        name="mine",
    )
    assert (rig.name, rig.mast_height_m, rig.pointing_sigma) == ("mine", 0.8, sigma)
    assert baseline_m(rig) == pytest.approx(0.4)
    left, right = rig.eyes
    assert isinstance(left.camera, Pinhole)
    edges = left.camera.unproject(np.array([[-0.5, 249.5], [999.5, 249.5]])).direction
    assert np.arccos(edges[0] @ edges[1]) == pytest.approx(np.pi / 2)
    axes = [e.head_T_camera.rotation().matrix()[:, 2] for e in (left, right)]
    assert np.arccos(axes[0] @ axes[1]) == pytest.approx(0.1)
    assert axes[0][1] < 0 < axes[1][1]  # inwards
    _, centres = rig.mast_T_camera(np.array([[np.pi / 2, np.pi / 2]] * 2), np.array([0, 1]))
    # Pan to the left, then tilt straight up: forward becomes up, up becomes backwards, which is now -y.
    np.testing.assert_allclose(centres.mean(axis=0), [-0.02, 0.01 + 0.02, 0.3 + 0.1], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("baseline_m", 0.0),
        ("baseline_m", float("nan")),
        ("field_rad", 3.2),
        ("field_rad", 0.0),
        ("width_px", 0),
        ("height_px", -3),
        ("forward_m", float("inf")),
        ("above_m", float("nan")),
        ("toe_in_rad", 2.0),
        ("tilt_axis_m", (0.0, float("nan"), 0.0)),
        ("mast_height_m", -1.0),
    ],
)
def test_a_stereo_unit_of_nonsense_is_refused(name: str, value: object) -> None:
    with pytest.raises(InputError, match=f"stereo-pan-tilt: {name}: expected .*, found "):
        stereo_pan_tilt(**{name: value})  # type: ignore[arg-type]  # what a type checker would refuse too


# --- All templates --------------------------------------------------------------------------------


@pytest.mark.parametrize("template", TEMPLATES)
def test_a_template_has_its_name_and_its_source(template: str) -> None:
    rig = TEMPLATES[template]()
    assert rig.name == template
    assert rig.source


@pytest.mark.parametrize(
    "template", slow_but_for(["mer-navcam", "mars2020-mastcam-z-34mm", "ladybug5"], TEMPLATES)
)
def test_the_program_simulates_every_template_and_the_file_may_name_it(
    template: str, scripts_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What --rig wrote with the rig's own numbers is the same with the rig by name."""
    out = tmp_path / "out"
    few = ["--stops", "1", "--pans", "2", "--sweep-deg", "20", "--tilts-deg", "-15"]
    monkeypatch.setattr(sys, "argv", ["simulate_traverse.py", str(out), "--rig", template, *few])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(scripts_folder / "simulate_traverse.py"), run_name="__main__")
    written = read_traverse(out)
    path = out / "traverse.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps(data | {"rig": {"template": template}}))
    named = read_traverse(out)
    assert named.rig.name == written.rig.name == template
    for a, b in zip(named.camera_poses(), written.camera_poses(), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    pixels = np.array([[40.0, 50.0], [700.0, 900.0]])
    for mine, theirs in zip(named.rig.eyes, written.rig.eyes, strict=True):
        np.testing.assert_allclose(
            mine.camera.unproject(pixels).direction, theirs.camera.unproject(pixels).direction, atol=1e-12
        )


def test_images_of_another_size_than_the_templates_are_refused_in_one_sentence(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((960, 1280), dtype=np.uint8))
    entry = {"id": "f", "stop": "s", "pan_rad": 0, "tilt_rad": 0, "sigma_pan_rad": 0, "sigma_tilt_rad": 0}
    pose = {"rotation_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, 0]}
    stop = {"id": "s", "world_T_mast": pose, "sigma_rotation_rad": 0, "sigma_translation_m": 0}
    data = {
        "format": "pancam-graph/traverse",
        "version": 1,
        "rig": {"template": "mars2020-navcam"},
        "stops": [stop],
        "frames": [entry],
        "images": [{"id": "i", "frame": "f", "camera": "left", "file": "a.png"}],
        "observations": None,
    }
    (tmp_path / "traverse.json").write_text(json.dumps(data))
    with pytest.raises(ImageError) as caught:
        read_input(tmp_path)
    sentence = str(caught.value)
    assert sentence == (
        f"{tmp_path}/traverse.json: images[0] (i): {tmp_path}/a.png: expected 5120 x 3840 pixels as of "
        "camera left of the rig mars2020-navcam, found 1280 x 960"
    )
