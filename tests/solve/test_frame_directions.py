"""Directions that frames see: exact without noise, as theory says with it, in every way to solve."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph import SolveOptions, Stop, build_graph, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Constraint, FrameDirection, Solution
from pancam_graph.simulate import Simulation
from pancam_graph.smoother import SmootherOptions, TraverseSmoother, solve_incrementally, stops_of
from support.parameters import slow_but_for
from support.small_drives import HARD, WAYS, near_part, simulated
from support.tied_drives import noise_free


def sun(simulation: Simulation, image: int, *, off_rad: float = 0.0, robust: bool = False) -> FrameDirection:
    """What an image truly sees at a pixel, told with an azimuth that is off by so much."""
    t, true = simulation.traverse, simulation.truth
    rotations, _ = t.camera_poses(true.world_T_mast, true.pan_tilt_rad)
    uv = np.array([400.0, 300.0])
    camera = t.rig.eyes[int(t.image_eye[image])].camera
    x, y, z = rotations[image] @ camera.unproject(uv[None]).direction[0]
    return FrameDirection(
        frame=t.images[image].frame,
        camera=t.images[image].camera,
        u_px=uv[0],
        v_px=uv[1],
        sigma_px=0.3,
        azimuth_rad=float(np.arctan2(y, x)) + off_rad,
        elevation_rad=float(np.arcsin(z)),
        robust=robust,
    )


def suns(simulation: Simulation) -> tuple[FrameDirection, ...]:
    """Two of each stop, by its first left and its last right eye."""
    of_stop = simulation.traverse.image_stop
    return tuple(
        sun(simulation, int(image))
        for stop in range(len(simulation.traverse.stops))
        for image in np.flatnonzero(of_stop == stop)[[0, -1]]
    )


def turned(stop: Stop, rng: np.random.Generator, sigma_rad: float, sigma_m: float = 0.1) -> Stop:
    """A stop as telemetry has it that is so uncertain."""
    error = np.concatenate([rng.normal(0, sigma_rad, 3), rng.normal(0, sigma_m, 3)])
    return replace(
        stop,
        world_T_mast=stop.world_T_mast.retract(error),
        sigma_rotation_rad=sigma_rad,
        sigma_translation_m=sigma_m,
    )


def rotation_errors(solution: Solution, simulation: Simulation) -> FloatArray:
    """(stops, 3) errors of the masts' attitudes, in their own frames."""
    pairs = zip(solution.final.world_T_mast, simulation.truth.world_T_mast, strict=True)
    return np.array([gtsam.Rot3.Logmap(a.rotation().inverse() * b.rotation()) for a, b in pairs])


@pytest.mark.parametrize("way", slow_but_for("hard", WAYS))
def test_true_directions_and_pixels_without_noise_give_the_truth_though_no_heading_is_known(way: str) -> None:
    simulation = simulated(2, 2)
    plain = near_part(replace(simulation, traverse=noise_free(simulation)))
    truth = simulation.truth
    angles = truth.pan_tilt_rad
    turn = 0.02 if way == "explicit" else 0.2  # points that are variables turn with the drive in small steps
    frames = [
        replace(f, pan_rad=pan, tilt_rad=tilt)
        for f, (pan, tilt) in zip(plain.frames, angles.tolist(), strict=True)
    ]
    stops = [
        replace(
            stop,
            world_T_mast=gtsam.Pose3(gtsam.Rot3.Rz(turn) * true.rotation(), true.translation()),
            sigma_rotation_rad=1e3,
            sigma_translation_m=0.1,
        )
        for stop, true in zip(plain.stops, truth.world_T_mast, strict=True)
    ]
    told = replace(plain, stops=tuple(stops), frames=tuple(frames), constraints=suns(simulation))
    solution = solve(told, WAYS[way])
    assert solution.converged
    assert np.abs(rotation_errors(solution, simulation)).max() < 1e-6


@pytest.mark.parametrize("way", slow_but_for("hard", WAYS))
def test_every_way_ends_where_the_hard_tie_does_and_the_drive_has_its_heading(way: str) -> None:
    simulation = simulated(2, 2)
    traverse = near_part(simulation)
    rng = np.random.default_rng(5)
    stops = tuple(turned(stop, rng, 0.05) for stop in traverse.stops)
    traverse = replace(traverse, stops=stops)
    plain = solve(traverse, HARD)
    tied = solve(replace(traverse, constraints=suns(simulation)), WAYS[way])
    assert tied.converged
    loose, firm = (np.sqrt(s.stop_covariance[0][2, 2]) for s in (plain, tied))
    assert loose > 0.02
    # In other models a camera's own rotation is loose.
    assert firm < (1e-2 if way in {"circle", "free"} else 2e-3)
    apart = np.abs(rotation_errors(tied, simulation)[:, 2])
    assert np.all(apart < 3.5 * np.sqrt(tied.stop_covariance[:, 2, 2]))
    assert tied.verdict is not None
    assert any(test.name == "constraints" and test.passed for test in tied.verdict.tests)
    if way in {"hard", "explicit"}:
        hard = solve(replace(traverse, constraints=suns(simulation)), HARD)
        gone = np.abs(rotation_errors(tied, simulation) - rotation_errors(hard, simulation)).max()
        assert gone < 1e-3 * firm
        assert tied.stop_covariance == pytest.approx(hard.stop_covariance, rel=1e-3, abs=1e-10)


@pytest.mark.slow
def test_squared_errors_are_as_large_as_covariances_say() -> None:
    squares = []
    for seed in range(300, 316):
        simulation = simulated(seed, 2)
        rng = np.random.default_rng(seed)
        true = zip(simulation.traverse.stops, simulation.truth.world_T_mast, strict=True)
        stops = tuple(turned(replace(stop, world_T_mast=pose), rng, 0.05) for stop, pose in true)
        noisy = []
        for one in suns(simulation):
            du, dv = rng.normal(0, one.sigma_px, 2)
            noisy.append(replace(one, u_px=one.u_px + du, v_px=one.v_px + dv))
        told = replace(simulation.traverse, stops=stops, constraints=tuple(noisy))
        solution = solve(told, HARD)
        errors = rotation_errors(solution, simulation)
        for error, covariance in zip(errors, solution.stop_covariance, strict=True):
            squares.append(error @ np.linalg.solve(covariance[:3, :3], error) / 3)
    # Two stops of a drive are nearly one: 16 means of three squares have a sigma of 0.2.
    assert 0.5 < np.mean(squares) < 1.6


def gross(simulation: Simulation, *, robust: bool) -> tuple[Constraint, ...]:
    first = next(i for i, s in enumerate(simulation.traverse.image_stop) if s == 1)
    return (
        sun(simulation, first, off_rad=0.02, robust=robust),
        sun(simulation, len(simulation.traverse.images) - 1, robust=robust),
    )


@pytest.mark.parametrize("way", slow_but_for("hard", ["hard", "explicit", "circle"]))
def test_a_gross_direction_is_found_named_and_let_go(way: str) -> None:
    simulation = simulated(2, 2)
    traverse, options = near_part(simulation), replace(WAYS[way], relative_decrease=1e-9)
    solution = solve(replace(traverse, constraints=gross(simulation, robust=True)), options)
    assert solution.verdict is not None
    note = next(test for test in solution.verdict.tests if test.name == "constraints let go")
    assert "constraints[0] (frame-direction of frame00006 left) is off by 1.1" in note.says
    others = solve(replace(traverse, constraints=gross(simulation, robust=True)[1:]), options)
    apart = others.final.world_T_mast[1].localCoordinates(solution.final.world_T_mast[1])
    assert np.abs(apart / np.sqrt(np.diag(others.stop_covariance[1]))).max() < 0.05


def test_stop_by_stop_ends_where_batch_does_and_the_graph_has_the_factors() -> None:
    simulation = simulated(2, 2)
    traverse = near_part(simulation)
    ties = suns(simulation)[2:]
    tied = replace(traverse, constraints=ties)
    batch, incremental = solve(tied, HARD), solve_incrementally(tied, HARD)
    sigma = np.sqrt(np.diag(batch.stop_covariance[1]))
    apart = batch.final.world_T_mast[1].localCoordinates(incremental.final.world_T_mast[1])
    assert np.abs(apart / sigma).max() < 1e-3
    smoother = TraverseSmoother(traverse.rig, SmootherOptions(rig="held", outlier_sigma=None))
    for part in stops_of(traverse):
        smoother.add_stop(*part)
    smoother.add_constraints(ties)
    apart = batch.final.world_T_mast[1].localCoordinates(smoother.estimate().world_T_mast[1])
    assert np.abs(apart / sigma).max() < 1e-2
    off = smoother.covariance(traverse.stops[1].id) - batch.stop_covariance[1]
    assert np.abs(off / np.outer(sigma, sigma)).max() < 1e-2
    for options in (HARD, replace(HARD, model="free")):
        graph, values = build_graph(tied, options)
        without, _ = build_graph(traverse, options)
        assert graph.size() == without.size() + len(ties)
        assert np.isfinite(graph.error(values))


def test_a_picture_of_the_sun_alone_heads_the_drive() -> None:
    """A frame whose picture shares no point with others."""
    simulation = simulated(2, 2)
    plain = near_part(simulation)
    rng = np.random.default_rng(0)
    last = plain.images[-1]
    observations = plain.observations
    assert observations is not None
    alone = plain.image_frame == plain.image_frame[-1]
    plain = plain.with_observations(observations.select(~alone[observations.image]))
    level = np.array([1e-4, 1e-4, 1.0])  # telemetry knows roll and pitch
    stops = [
        replace(
            stop,
            world_T_mast=pose.retract(np.append(0.05 * level * rng.normal(size=3), np.zeros(3))),
            sigma_rotation_rad=0.05,
        )
        for stop, pose in zip(plain.stops, simulation.truth.world_T_mast, strict=True)
    ]
    before = replace(plain, stops=tuple(stops))
    tied = replace(before, constraints=(sun(simulation, len(plain.images) - 1),))
    loose, firm = solve(before, HARD), solve(tied, HARD)
    assert any(last.id in warning for warning in loose.warnings)
    assert not any(last.id in warning for warning in firm.warnings)
    for stop in (0, 1):
        assert firm.stop_covariance[stop][2, 2] < 0.5 * loose.stop_covariance[stop][2, 2]
        error = rotation_errors(firm, simulation)[stop, 2]
        assert abs(error) < 3 * np.sqrt(firm.stop_covariance[stop][2, 2])


def test_what_no_camera_can_see_is_refused_in_one_sentence() -> None:
    simulation = simulated(2, 2)
    traverse = near_part(simulation)
    one = sun(simulation, len(traverse.images) - 1)
    behind = replace(traverse, constraints=(replace(one, azimuth_rad=one.azimuth_rad + np.pi),))
    with pytest.raises(
        InputError, match=r"constraints\[0\] \(frame-direction of .*: expected a direction in front of the"
    ):
        solve(behind, HARD)
    with pytest.raises(InputError, match="expected the model mast, circle or free, found projective"):
        solve(replace(traverse, constraints=(one,)), SolveOptions(model="projective"))
    held = replace(
        traverse,
        stops=tuple(replace(s, sigma_rotation_rad=0.0, sigma_translation_m=0.0) for s in traverse.stops),
        frames=tuple(replace(f, sigma_pan_rad=0.0, sigma_tilt_rad=0.0) for f in traverse.frames),
        constraints=(one,),
    )
    with pytest.raises(InputError, match="expected a variable that is free, found only such as telemetry"):
        solve(held, HARD)


def test_a_direction_at_a_held_stop_is_said_to_turn_no_drive() -> None:
    simulation = simulated(2, 2)
    t = simulation.traverse
    assert not t.stops[0].sigma_rotation_rad
    seen = replace(t, constraints=suns(simulation))
    said = [w for w in solve(seen, HARD).warnings if "turns pans, tilts and the rig, not the drive" in w]
    assert len(said) == 1
    assert said[0].startswith(f"stop {t.stops[0].id}: a frame-direction there")
    free = replace(seen, stops=tuple(replace(s, sigma_rotation_rad=0.02) for s in t.stops))
    assert not [w for w in solve(free, HARD).warnings if "not the drive" in w]
