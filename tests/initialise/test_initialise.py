"""Circle fits with their degenerate cases, and starts from cameras, odometry and telemetry."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.errors import CameraError, GeometryError, InputError
from pancam_graph.base.geometry import FloatArray, wrap_angle
from pancam_graph.cameras import projection_matrix
from pancam_graph.initialise import (
    CircleFit,
    fit_circle,
    start_from_cameras,
    start_from_odometry,
    start_from_telemetry,
)
from pancam_graph.rigs import Rig, rig_template
from pancam_graph.simulate import Simulation, SimulationOptions, simulate
from support.parameters import slow_but_for

CENTRE = np.array([3.0, -2.0, 1.0])
TILTED = Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix()


def circle(phi: FloatArray, radius_m: float = 0.15) -> FloatArray:
    """Points of a circle in general position, anticlockwise about TILTED's z."""
    flat = radius_m * np.column_stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)])
    return np.asarray(flat @ TILTED.T + CENTRE)


def rebuilt(fit: CircleFit) -> FloatArray:
    """Thesis eq. 4.8 with what the fit found."""
    outward = np.column_stack([np.cos(fit.angle_rad), np.sin(fit.angle_rad), np.zeros_like(fit.angle_rad)])
    return np.asarray(fit.radius_m * outward @ fit.rotation.T + fit.centre_m)


# --- circle ---


@pytest.mark.parametrize(
    "phi",
    [
        np.array([0.0, 2.0, 4.0]),
        np.linspace(0.5, 6.5, 12),
        np.linspace(1.0, 1.4, 5),
        np.array([0.3, 0.3, 1.9, 3.0]),
        np.linspace(0, 2 * np.pi, 9),
    ],
    ids=["three", "ring", "short", "one twice", "closed"],
)
def test_an_exact_circle_is_found(phi: FloatArray) -> None:
    points = circle(phi)
    fit = fit_circle(points)
    assert fit.centre_m == pytest.approx(CENTRE, abs=1e-10)
    assert fit.radius_m == pytest.approx(0.15, abs=1e-10)
    assert fit.rotation[:, 2] == pytest.approx(TILTED[:, 2], abs=1e-9)
    assert fit.rotation @ fit.rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    assert fit.angle_rad[0] == 0
    assert wrap_angle(fit.angle_rad - (phi - phi[0])) == pytest.approx(np.zeros(len(phi)), abs=1e-8)
    assert rebuilt(fit) == pytest.approx(points, abs=1e-10)
    assert fit.residual_m == pytest.approx(np.zeros((len(phi), 2)), abs=1e-10)


def test_the_normal_follows_the_order_of_points_or_the_way_up() -> None:
    points = circle(np.linspace(0, 4, 7))
    up = TILTED[:, 2]
    assert fit_circle(points).rotation[:, 2] @ up == pytest.approx(1)
    assert fit_circle(points[::-1]).rotation[:, 2] @ up == pytest.approx(-1)
    for sign in (1, -1):
        fit = fit_circle(points[::-1], sign * (up + 0.3 * TILTED[:, 0]))
        assert fit.rotation[:, 2] @ up == pytest.approx(sign)
        assert np.all(np.diff(fit.angle_rad) * sign < 0)
        assert rebuilt(fit) == pytest.approx(points[::-1], abs=1e-12)


def test_residuals_are_radial_and_along_the_normal() -> None:
    """Alternating offsets leave the best circle where it is."""
    phi = 2 * np.pi * np.arange(8) / 8
    sign = np.array([1, 1, -1, -1] * 2)
    outward = (circle(phi) - CENTRE) / 0.15
    fit = fit_circle(circle(phi) + 1e-4 * sign[:, None] * outward, TILTED[:, 2])
    assert fit.residual_m[:, 0] == pytest.approx(1e-4 * sign, abs=1e-9)
    fit = fit_circle(circle(phi) + 1e-4 * sign[:, None] * TILTED[:, 2], TILTED[:, 2])
    assert fit.residual_m[:, 1] == pytest.approx(1e-4 * sign, abs=1e-9)
    assert fit.residual_m[:, 0] == pytest.approx(np.zeros(8), abs=1e-7)


@pytest.mark.parametrize("arc_rad", slow_but_for([1.2], [2 * np.pi * 11 / 12, 1.2]))
def test_sigma_of_the_centre_against_monte_carlo(arc_rad: float) -> None:
    """The spread of the centre in the plane, in its worst direction, over 400 fits."""
    rng = np.random.default_rng(0)
    clean = circle(np.linspace(0, arc_rad, 12))
    fits = [fit_circle(clean + 2e-4 * rng.standard_normal((12, 3)), TILTED[:, 2]) for _ in range(400)]
    in_plane = np.array([f.centre_m - CENTRE for f in fits]) @ TILTED[:, :2]
    spread = np.sqrt(np.linalg.eigvalsh(in_plane.T @ in_plane / 400)[-1])
    formal = np.sqrt(np.mean([f.centre_sigma_m**2 for f in fits]))
    assert formal == pytest.approx(spread, rel=0.12)
    assert np.abs(np.mean(in_plane, axis=0)).max() < 4 * spread / 20


def test_three_centres_leave_nothing_to_judge_by() -> None:
    assert np.isnan(fit_circle(circle(np.array([0.0, 1.0, 2.0]))).centre_sigma_m)
    assert fit_circle(circle(np.array([0.0, 1.0, 2.0, 3.0]))).centre_sigma_m < 1e-10


@pytest.mark.parametrize(
    ("phi", "arc_deg", "short"),
    [
        ([0, 45, 89], 89, True),
        ([0, 45, 91], 91, False),
        ([350, 355, 5, 20], 30, True),
        ([0, 120, 240], 240, False),
        ([170, 180, 190, 200], 30, True),
    ],
)
def test_a_short_arc_is_flagged_wherever_it_lies(phi: list[float], arc_deg: float, short: bool) -> None:
    fit = fit_circle(circle(np.deg2rad(np.array(phi, dtype=float))))
    assert np.rad2deg(fit.arc_rad) == pytest.approx(arc_deg)
    assert fit.short_arc is short


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "at least 3 centres, found 0"),
        (circle(np.array([0.0, 1.0])), "at least 3 centres, found 2"),
        (np.full((4, 3), 2.0), "4 centres coincide"),
        (np.outer(np.arange(5.0), [1, 2, 3]), "5 centres are collinear"),
        (circle(np.array([0.0, 1.0, 1.0, 0.0])), "4 centres are collinear"),
        (circle(np.array([0.0, 1.0, np.nan])), "finite"),
    ],
    ids=["none", "two", "coincident", "collinear", "two places", "nan"],
)
def test_what_determines_no_circle_is_refused(points: FloatArray, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        fit_circle(points)


@pytest.mark.slow
def test_noise_that_hides_the_bend_ends_in_a_circle_or_a_refusal() -> None:
    """The best circle may then be a line: its normal equations are singular and its radius has no bound."""
    refused = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        phi = np.linspace(0, 0.05, rng.integers(4, 8))
        try:
            fit = fit_circle(circle(phi) + rng.normal(0, 2e-3, (len(phi), 3)))
        except GeometryError as error:
            assert "no circle is determined" in str(error)
            refused += 1
        else:
            assert 0 < fit.radius_m < 1e4
            assert np.isfinite(fit.centre_sigma_m)
    assert 0 < refused < 30


# --- starts ---


def bent(rig: Rig) -> Rig:
    """The rig with a tilt axis beside the pan axis and askew to it, as measured ones are."""
    offset = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.02, -0.01, 0.03), np.array([0.03, -0.02, 0.05]))
    return replace(rig, pan_T_tilt=offset)


@lru_cache
def simulation(rig_name: str, *, askew: bool = False, **options: object) -> Simulation:
    rig = rig_template(rig_name)
    base = {"stops": 2, "pans": 6, "tilts_rad": (-0.15, -0.5), "points_per_image": 3, "noise_px": 0.0}
    return simulate(bent(rig) if askew else rig, SimulationOptions(**{**base, **options}), seed=3)  # type: ignore[arg-type]


def true_cameras(sim: Simulation) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Projection matrices of all images, each times a factor of its own, and their poses."""
    t = sim.traverse
    rotation, centre = t.camera_poses(sim.truth.world_T_mast, sim.truth.pan_tilt_rad)
    k = [t.rig.pinholes[e].calibration_matrix for e in t.image_eye]
    factor = np.random.default_rng(0).normal(0, 5, len(centre))
    p = [projection_matrix(k[i], rotation[i].T, centre[i]) * factor[i] for i in range(len(centre))]
    return np.array(p), rotation, centre


RIGS = [("mer-navcam", False), ("mer-pancam", False), ("exomars-pancam", False), ("mer-navcam", True)]
QUICK = [("exomars-pancam", False), ("mer-navcam", True)]


@pytest.mark.parametrize(("name", "askew"), slow_but_for(QUICK, RIGS))
def test_masts_and_angles_are_recovered_from_true_cameras(name: str, askew: bool) -> None:
    sim = simulation(name, askew=askew, prior="truth")
    start = start_from_cameras(sim.traverse, true_cameras(sim)[0])
    assert start.warnings == ()
    for found, true in zip(start.world_T_mast, sim.truth.world_T_mast, strict=True):
        assert gtsam.Pose3.Logmap(true.between(found)) == pytest.approx(np.zeros(6), abs=1e-9)
    assert start.pan_tilt_rad == pytest.approx(sim.truth.pan_tilt_rad, abs=1e-9)


@pytest.mark.parametrize(("name", "askew"), slow_but_for(QUICK, RIGS))
def test_errors_of_telemetry_do_not_reach_the_cameras(name: str, askew: bool) -> None:
    """Only the zero of the pan is telemetry's: mast and angles turn against each other, cameras stay true."""
    sim = simulation(name, askew=askew, sigma_stop_m=2.0, sigma_stop_rad=0.05)
    projections, rotation, centre = true_cameras(sim)
    start = start_from_cameras(sim.traverse, projections)
    found = sim.traverse.camera_poses(start.world_T_mast, start.pan_tilt_rad)
    assert found[0] == pytest.approx(rotation, abs=1e-9)
    assert found[1] == pytest.approx(centre, abs=1e-9)
    assert np.abs(start.pan_tilt_rad[:, 1] - sim.truth.pan_tilt_rad[:, 1]).max() < 1e-9
    pan_error = wrap_angle(start.pan_tilt_rad[:, 0] - sim.truth.pan_tilt_rad[:, 0]).reshape(2, -1)
    assert np.ptp(pan_error, axis=1) == pytest.approx(np.zeros(2), abs=1e-9)
    assert 0 < np.abs(pan_error).max() < 5e-3


def test_a_lone_frame_of_another_tilt_first_hides_no_circle() -> None:
    """The first frame looks elsewhere; the row that follows determines the mast."""
    sim = simulation("mer-navcam", prior="truth", stops=1)
    t = sim.traverse
    kept = [0, *range(6, 12)]
    images = tuple(i for i in t.images if i.frame in {t.frames[f].id for f in kept})
    rows = [t.images.index(i) for i in images]
    part = replace(t, frames=tuple(t.frames[f] for f in kept), images=images, observations=None)
    start = start_from_cameras(part, true_cameras(sim)[0][rows])
    assert start.warnings == ()
    true = sim.truth.world_T_mast[0]
    assert gtsam.Pose3.Logmap(true.between(start.world_T_mast[0])) == pytest.approx(np.zeros(6), abs=1e-9)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"sweep_rad": 1.2}, "degrees only; 90 or more are needed"),
        ({"pans": 2, "sweep_rad": 2.0}, "at least 3 centres, found 2"),
    ],
    ids=["short arc", "two frames"],
)
def test_a_stop_without_a_circle_is_placed_by_its_rotations_with_a_warning(
    options: dict[str, Any], reason: str
) -> None:
    sim = simulation("mer-navcam", prior="truth", **options)
    projections, rotation, centre = true_cameras(sim)
    start = start_from_cameras(sim.traverse, projections)
    assert len(start.warnings) == 2
    for stop, warning in zip(sim.traverse.stops, start.warnings, strict=True):
        assert warning.startswith(f"stop {stop.id}: placed by rotations and telemetry's angles: ")
        assert reason in warning
    found = sim.traverse.camera_poses(start.world_T_mast, start.pan_tilt_rad)
    assert found[0] == pytest.approx(rotation, abs=1e-9)
    assert found[1] == pytest.approx(centre, abs=1e-9)


def test_the_warning_gives_the_reason_of_the_longest_row() -> None:
    """A lone frame of another tilt comes first, and a short arc after it."""
    sim = simulation("mer-navcam", prior="truth", stops=1, sweep_rad=1.2)
    t = sim.traverse
    images = tuple(i for i in t.images if i.frame in {t.frames[f].id for f in [0, *range(6, 12)]})
    rows = [t.images.index(i) for i in images]
    part = replace(t, images=images, observations=None)
    (warning,) = start_from_cameras(part, true_cameras(sim)[0][rows]).warnings
    assert "degrees only" in warning


def test_frames_and_stops_without_images_keep_telemetry() -> None:
    sim = simulation("mer-navcam", sigma_stop_m=1.0)
    t = sim.traverse
    images = tuple(i for i in t.images if i.frame != t.frames[2].id and t.image_stop[t.images.index(i)] == 0)
    rows = [t.images.index(i) for i in images]
    start = start_from_cameras(replace(t, images=images, observations=None), true_cameras(sim)[0][rows])
    assert start.pan_tilt_rad[2].tolist() == t.pan_tilt_rad[2].tolist()
    assert start.pan_tilt_rad[12:].tolist() == t.pan_tilt_rad[12:].tolist()
    assert start.world_T_mast[1].equals(t.stops[1].world_T_mast, 0.0)
    assert start.pan_tilt_rad[3, 1] == pytest.approx(sim.truth.pan_tilt_rad[3, 1], abs=1e-9)


def test_angles_stay_on_telemetrys_turn() -> None:
    """A mast that has turned on: pans beyond half a turn are not brought back by a whole one."""
    sim = simulation("mer-navcam", prior="truth", stops=1)
    frames = tuple(replace(f, pan_rad=f.pan_rad + 2 * np.pi) for f in sim.traverse.frames)
    start = start_from_cameras(replace(sim.traverse, frames=frames), true_cameras(sim)[0])
    assert start.pan_tilt_rad[:, 0] == pytest.approx(sim.truth.pan_tilt_rad[:, 0] + 2 * np.pi, abs=1e-9)


def test_matrices_that_do_not_fit_are_refused() -> None:
    sim = simulation("mer-navcam")
    projections, _, _ = true_cameras(sim)
    with pytest.raises(InputError, match=r"expected shape \(48, 3, 4\), found \(47, 3, 4\)"):
        start_from_cameras(sim.traverse, projections[1:])
    projections[5, :, :3] = 0.0
    with pytest.raises(CameraError, match="projection matrix"):
        start_from_cameras(sim.traverse, projections)


def test_odometry_chains_motions_from_the_first_stop() -> None:
    sim = simulation("mer-navcam", stops=4, sigma_stop_m=1.0)
    true = sim.truth.world_T_mast
    motions = [true[i].between(true[i + 1]) for i in range(3)]
    start = start_from_odometry(sim.traverse, motions)
    for found, expected in zip(start.world_T_mast, true, strict=True):
        assert found.equals(expected, 1e-12)
    assert start.pan_tilt_rad.tolist() == sim.traverse.pan_tilt_rad.tolist()
    with pytest.raises(InputError, match="expected 3 motions for 4 stops, found 2"):
        start_from_odometry(sim.traverse, motions[:2])


def test_telemetry_is_the_traverses_own_and_safe_to_change() -> None:
    sim = simulation("mer-navcam")
    start = start_from_telemetry(sim.traverse)
    assert [
        p.equals(s.world_T_mast, 0.0) for p, s in zip(start.world_T_mast, sim.traverse.stops, strict=True)
    ]
    start.pan_tilt_rad[:] = 0.0
    assert np.abs(sim.traverse.pan_tilt_rad).min() > 0
