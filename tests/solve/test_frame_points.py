"""Points of known position that one picture alone sees: they place the drive as points that many see do."""

from dataclasses import replace

import numpy as np
import pytest

from pancam_graph import SolveOptions, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Constraint, FramePoint, LandmarkPosition, Solution, Traverse
from pancam_graph.simulate import Simulation
from pancam_graph.smoother import SmootherOptions, TraverseSmoother, stops_of
from support.parameters import slow_but_for
from support.small_drives import HARD, WAYS, near_part, simulated
from support.tied_drives import noise_free


def fiducials(simulation: Simulation, *, sigma_m: float = 0.01) -> tuple[FramePoint, ...]:
    """Four places at the last stop, each at the true pixel of one picture."""
    t, true = simulation.traverse, simulation.truth
    rotations, centres = t.camera_poses(true.world_T_mast, true.pan_tilt_rad)
    images = np.flatnonzero(t.image_stop == len(t.stops) - 1)[[0, 1, -2, -1]]
    out = []
    for image, uv, distance in zip(
        images.tolist(),
        ([200.0, 700.0], [800.0, 600.0], [500.0, 900.0], [300.0, 300.0]),
        (3.0, 4.0, 5.0, 7.0),
        strict=True,
    ):
        rays = t.rig.eyes[int(t.image_eye[image])].camera.unproject(np.array([uv]))
        place = centres[image] + rotations[image] @ (rays.origin_m[0] + distance * rays.direction[0])
        out.append(
            FramePoint(
                frame=t.images[image].frame,
                camera=t.images[image].camera,
                u_px=uv[0],
                v_px=uv[1],
                sigma_px=0.3,
                position_m=tuple(place),
                sigma_m=sigma_m,
            )
        )
    return tuple(out)


def loose(traverse: Traverse, rng: np.random.Generator, simulation: Simulation) -> Traverse:
    """Telemetry that knows places to 30 cm and attitudes to 20 mrad, and is off by as much."""
    true = zip(traverse.stops, simulation.truth.world_T_mast, strict=True)
    stops = [
        replace(
            stop,
            world_T_mast=pose.retract(np.concatenate([rng.normal(0, 0.02, 3), rng.normal(0, 0.3, 3)])),
            sigma_rotation_rad=0.02,
            sigma_translation_m=0.3,
        )
        for stop, pose in true
    ]
    return replace(traverse, stops=tuple(stops))


def errors(solution: Solution, simulation: Simulation) -> FloatArray:
    """(stops, 6) of the masts, in their tangents."""
    pairs = zip(solution.final.world_T_mast, simulation.truth.world_T_mast, strict=True)
    return np.array([found.localCoordinates(true) for found, true in pairs])


@pytest.mark.parametrize("way", slow_but_for("hard", WAYS))
def test_they_place_the_drive_and_pixels_without_noise_give_the_truth(way: str) -> None:
    simulation = simulated(2, 2)
    plain = near_part(replace(simulation, traverse=noise_free(simulation)))
    angles = simulation.truth.pan_tilt_rad.tolist()
    frames = [replace(f, pan_rad=p, tilt_rad=t) for f, (p, t) in zip(plain.frames, angles, strict=True)]
    stops = [
        replace(stop, world_T_mast=pose, sigma_rotation_rad=1.0, sigma_translation_m=10.0)
        for stop, pose in zip(plain.stops, simulation.truth.world_T_mast, strict=True)
    ]
    told = replace(plain, stops=tuple(stops), frames=tuple(frames), constraints=fiducials(simulation))
    solution = solve(told, WAYS[way])
    assert solution.converged
    assert np.abs(errors(solution, simulation)).max() < 1e-5
    sigma = np.sqrt(np.trace(solution.stop_covariance[1][3:, 3:]))
    assert 0.003 < sigma < 0.3


@pytest.mark.slow
def test_squared_errors_are_as_large_as_covariances_say() -> None:
    squares = []
    for seed in range(400, 416):
        simulation, rng = simulated(seed, 2), np.random.default_rng(seed)
        noisy: list[Constraint] = []
        for one in fiducials(simulation):
            du, dv = rng.normal(0, one.sigma_px, 2)
            place = np.asarray(one.position_m) + rng.normal(0, one.sigma_m, 3)
            noisy.append(replace(one, u_px=one.u_px + du, v_px=one.v_px + dv, position_m=tuple(place)))
        told = replace(loose(simulation.traverse, rng, simulation), constraints=tuple(noisy))
        solution = solve(told, HARD)
        for error, covariance in zip(errors(solution, simulation), solution.stop_covariance, strict=True):
            squares.append(error @ np.linalg.solve(covariance, error) / 6)
    # Two stops of a drive are nearly one: 16 means of six squares have a sigma of 0.15.
    assert 0.6 < np.mean(squares) < 1.5


def test_a_point_that_two_images_see_says_the_same_through_either() -> None:
    """The marks of a landmark that two images have, once as its observations, once as one in each picture."""
    simulation = simulated(2, 2)
    traverse = near_part(simulation)
    traverse = loose(traverse, np.random.default_rng(1), simulation)
    observations = traverse.observations
    assert observations is not None
    count = np.bincount(observations.track)
    track = int(np.flatnonzero(count == 2)[0])
    rows = np.flatnonzero(observations.track == track)
    place = tuple(simulation.truth.landmarks_m[track])
    as_landmark = LandmarkPosition(landmark=track, position_m=place, sigma_m=(0.0,) * 3)
    first = solve(replace(traverse, constraints=(as_landmark,)), HARD)
    as_frames = tuple(
        FramePoint(
            frame=traverse.images[image].frame,
            camera=traverse.images[image].camera,
            u_px=u,
            v_px=v,
            sigma_px=float(observations.sigma_px[row]),
            position_m=place,
            sigma_m=0.0,
        )
        for row, image, (u, v) in zip(
            rows, observations.image[rows].tolist(), observations.uv_px[rows].tolist(), strict=True
        )
    )
    others = observations.select(observations.track != track)
    second = solve(replace(traverse, observations=others, constraints=as_frames), HARD)
    sigma = np.sqrt(np.diagonal(first.stop_covariance, axis1=1, axis2=2))
    assert np.abs((errors(first, simulation) - errors(second, simulation)) / sigma).max() < 0.02
    assert np.diagonal(second.stop_covariance, axis1=1, axis2=2) == pytest.approx(sigma**2, rel=0.01)


def test_a_gross_one_is_let_go_and_the_smoother_is_where_batch_is() -> None:
    simulation = simulated(2, 2)
    traverse = near_part(simulation)
    ties = fiducials(simulation)
    x, y, z = ties[0].position_m
    wrong = (replace(ties[0], position_m=(x, y, z + 0.5), robust=True), *ties[1:])
    solution = solve(replace(traverse, constraints=wrong), SolveOptions(rig="held"))
    assert solution.verdict is not None
    note = next(test for test in solution.verdict.tests if test.name == "constraints let go")
    assert "constraints[0] (frame-point of frame00006 left) is off by" in note.says
    assert solution.verdict.passed
    smoother = TraverseSmoother(traverse.rig, SmootherOptions(rig="held", outlier_sigma=None))
    for part in stops_of(traverse):
        smoother.add_stop(*part)
    smoother.add_constraints(ties)
    batch = solve(replace(traverse, constraints=ties), HARD)
    sigma = np.sqrt(np.diag(batch.stop_covariance[1]))
    apart = batch.final.world_T_mast[1].localCoordinates(smoother.estimate().world_T_mast[1])
    assert np.abs(apart / sigma).max() < 1e-2


def test_a_place_behind_the_camera_is_refused() -> None:
    simulation = simulated(2, 2)
    one = fiducials(simulation)[0]
    mast = simulation.truth.world_T_mast[1].translation()
    behind = replace(one, position_m=tuple(2 * mast - np.asarray(one.position_m)))
    with pytest.raises(
        InputError, match=r"constraints\[0\] \(frame-point of .*: expected a place in front of the camera"
    ):
        solve(replace(near_part(simulation), constraints=(behind,)), HARD)
