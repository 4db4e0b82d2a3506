"""The smoother as a rover uses it: stop by stop, late, out of order, wrong, and after a restart."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, SmootherOptions, SolveOptions, TraverseSmoother, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import Frame, Freedom, Image, Observations, Sharing, Solution, Stop, Traverse
from pancam_graph.report import DriveStep, write_drive
from pancam_graph.results import read_solution_json, write_results
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.smoother import Update
from pancam_graph.smoother._incremental import solve_incrementally, stops_of

_SMALL = SimulationOptions(
    stops=4, spacing_m=3.0, pans=4, tilts_rad=(-0.2,), sweep_rad=2.0, points_per_image=20, noise_px=0.3
)
_LOOP = SimulationOptions(
    stops=12,
    loop=True,
    odometry=True,
    spacing_m=8.0,
    pans=6,
    tilts_rad=(-0.2,),
    points_per_image=20,
    reach_m=16.0,
    link_stops=2,
    max_turn_rad=float(np.pi),
    max_zoom=6.0,
    heading_change_rad=0.05,
    sigma_stop_m=0.1,
    noise_px=0.4,
)
Parts = tuple[Stop, list[Frame], list[Image], Observations]


def driven(
    traverse: Traverse, smoother: TraverseSmoother, order: Sequence[int] | None = None
) -> list[Update]:
    """What the smoother says at each stop."""
    parts = list(stops_of(traverse))
    return [smoother.add_stop(*parts[i]) for i in (range(len(parts)) if order is None else order)]


def less(part: Parts, rows: IntArray) -> Parts:
    """A stop without some of its observations."""
    return (*part[:3], part[3].select(np.delete(np.arange(len(part[3])), rows)))


@pytest.fixture(scope="module")
def small() -> Simulation:
    """Four stops in a row."""
    return simulate(mer_navcam(), _SMALL, seed=3)


@pytest.fixture(scope="module")
def batch(small: Simulation) -> Solution:
    """All at once."""
    return solve(small.traverse)


@pytest.fixture(scope="module")
def loop() -> Simulation:
    """Twelve stops and back."""
    return simulate(mer_navcam(), _LOOP, seed=2)


def test_every_entry_of_a_traverse_is_in_one_stop(small: Simulation) -> None:
    t, parts = small.traverse, list(stops_of(small.traverse))
    assert t.observations is not None
    assert tuple(stop for stop, *_ in parts) == t.stops
    for stop, frames, images, observations in parts:
        assert {frame.stop for frame in frames} == {stop.id}
        assert {image.frame for image in images} == {frame.id for frame in frames}
        assert observations.image.min() == 0
        assert observations.image.max() < len(images)
    assert sorted(f.id for _, frames, _, _ in parts for f in frames) == sorted(f.id for f in t.frames)
    assert sorted(i.id for _, _, images, _ in parts for i in images) == sorted(i.id for i in t.images)
    seen = [
        (images[image].id, track, u, v)
        for _, _, images, o in parts
        for image, track, (u, v) in zip(o.image.tolist(), o.track.tolist(), o.uv_px.tolist(), strict=True)
    ]
    given = zip(
        t.observations.image.tolist(),
        t.observations.track.tolist(),
        t.observations.uv_px.tolist(),
        strict=True,
    )
    assert sorted(seen) == sorted((t.images[image].id, track, u, v) for image, track, (u, v) in given)


def test_images_of_a_stop_are_counted_from_0_in_their_order() -> None:
    """Frames and images of two stops in turns, observations in no order."""
    place: dict[str, Any] = {
        "world_T_mast": gtsam.Pose3(),
        "sigma_rotation_rad": 0.01,
        "sigma_translation_m": 0.1,
    }
    angles: dict[str, Any] = {"pan_rad": 0.0, "tilt_rad": 0.0, "sigma_pan_rad": 1e-3, "sigma_tilt_rad": 1e-3}
    traverse = Traverse(
        name="in turns",
        rig=mer_navcam(),
        stops=tuple(Stop(id=name, **place) for name in ("one", "two")),
        frames=tuple(Frame(id=f"f{i}", stop=stop, **angles) for i, stop in enumerate(("two", "one", "two"))),
        images=(
            Image(id="a", frame="f2", camera="left"),
            Image(id="b", frame="f1", camera="left"),
            Image(id="c", frame="f0", camera="left"),
            Image(id="d", frame="f1", camera="right"),
        ),
        observations=Observations(
            image=np.array([3, 2, 0, 1, 2]),
            track=np.array([7, 7, 7, 5, 5]),
            uv_px=np.arange(10.0).reshape(5, 2),
            sigma_px=np.full(5, 0.5),
        ),
    )
    (one, frames_1, images_1, observations_1), (two, frames_2, images_2, observations_2) = stops_of(traverse)
    assert (one.id, two.id) == ("one", "two")
    assert [f.id for f in frames_1] == ["f1"]
    assert [f.id for f in frames_2] == ["f0", "f2"]
    assert [i.id for i in images_1] == ["b", "d"]
    assert [i.id for i in images_2] == ["a", "c"]
    assert observations_1.image.tolist() == [1, 0]
    assert observations_1.track.tolist() == [7, 5]
    assert observations_2.image.tolist() == [1, 0, 1]
    assert observations_2.uv_px.tolist() == [[2.0, 3.0], [4.0, 5.0], [8.0, 9.0]]


def require_batch(smoother: TraverseSmoother, batch: Solution) -> None:
    """What is used is what the batch uses but for few; all else is as a batch of it has it."""
    t, used = smoother.traverse, smoother.used
    assert t.observations is not None
    assert abs(int(used.sum()) - int(batch.used.sum())) < 0.004 * len(used)
    same = solve(t.with_observations(t.observations.select(used)), SolveOptions(loss="none"))
    assert smoother.cost == pytest.approx(same.cost_final, rel=1e-4)
    estimate = smoother.estimate()
    for i, stop in enumerate(t.stops):
        sigma = np.sqrt(np.diag(same.stop_covariance[i]))
        found = same.final.world_T_mast[i].localCoordinates(estimate.world_T_mast[i])
        assert np.all(np.abs(found) <= 0.05 * sigma + 1e-12)
        assert np.sqrt(np.diag(smoother.covariance(stop.id))) == pytest.approx(sigma, rel=0.01)


def test_the_answer_after_the_last_stop_is_that_of_the_batch(small: Simulation, batch: Solution) -> None:
    smoother = TraverseSmoother(small.traverse.rig)
    updates = driven(small.traverse, smoother)
    require_batch(smoother, batch)
    assert not any(u.fell_back for u in updates)
    assert updates[-1].cost == smoother.cost
    assert [u.stop for u in updates] == [s.id for s in small.traverse.stops]
    assert np.all(smoother.covariance(small.traverse.stops[0].id) == 0)  # held
    found, angles = smoother.estimate().pan_tilt_rad, batch.final.pan_tilt_rad
    assert np.all(np.abs(found - angles) < 0.05 * batch.angle_sigma_rad)


@pytest.mark.slow
def test_stops_may_come_in_any_order(small: Simulation, batch: Solution) -> None:
    smoother = TraverseSmoother(small.traverse.rig)
    driven(small.traverse, smoother, [2, 0, 3, 1])
    assert smoother.stops == tuple(small.traverse.stops[i].id for i in (2, 0, 3, 1))
    require_batch(smoother, batch)


def test_where_steps_do_not_settle_all_is_solved_anew(small: Simulation, batch: Solution) -> None:
    # One round, and nothing may be where it was not linearised: what a new stop moves never settles.
    options = SmootherOptions(max_rounds=1, relinearise_rad=1e-12, relinearise_m=1e-12)
    smoother = TraverseSmoother(small.traverse.rig, options)
    updates = driven(small.traverse, smoother)
    assert updates[-1].fell_back
    assert updates[-1].rounds == 1
    require_batch(smoother, batch)


@pytest.mark.slow
def test_without_screening_all_that_is_seen_is_used() -> None:
    # Points beside the way, placed by a stereo base far off, come to lie behind the stops that pass them.
    passing = SimulationOptions(
        stops=5,
        spacing_m=8.0,
        pans=12,
        tilts_rad=(-0.2,),
        points_per_image=60,
        detection=0.2,
        min_views=3,
        reach_m=18.0,
        link_stops=5,
        max_turn_rad=float(np.pi),
        max_zoom=8.0,
        noise_px=1.5,
    )
    t = simulate(mer_navcam(), passing, seed=2).traverse
    smoother = TraverseSmoother(t.rig, SmootherOptions(outlier_sigma=None))
    driven(t, smoother)
    assert np.all(smoother.used)
    assert smoother.cost == pytest.approx(solve(t, SolveOptions(loss="none")).cost_final, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["1", "3"])
def test_the_number_of_threads_changes_no_bit(
    small: Simulation, monkeypatch: pytest.MonkeyPatch, threads: str
) -> None:
    def found_with(number: str) -> tuple[list[float], FloatArray]:
        monkeypatch.setenv("PANCAM_GRAPH_THREADS", number)
        smoother = TraverseSmoother(small.traverse.rig)
        costs = [u.cost for u in driven(small.traverse, smoother)]
        return costs, np.stack([pose.matrix() for pose in smoother.estimate().world_T_mast])

    costs, poses = found_with("2")
    other_costs, other_poses = found_with(threads)
    assert other_costs == costs
    assert np.array_equal(other_poses, poses)


def test_observations_may_come_late(small: Simulation, batch: Solution) -> None:
    smoother, late = TraverseSmoother(small.traverse.rig), []
    first_image = 0
    for part in stops_of(small.traverse):
        rows = np.arange(0, len(part[3]), 3)
        smoother.add_stop(*less(part, rows))
        taken = part[3].select(rows)
        late.append(replace(taken, image=taken.image + first_image))
        first_image += len(part[2])
    for part_of in late:
        smoother.add_observations(part_of)
    require_batch(smoother, batch)


def test_relative_covariance_is_that_of_the_difference(small: Simulation) -> None:
    smoother = TraverseSmoother(small.traverse.rig)
    driven(small.traverse, smoother)
    a, b = smoother.stops[0], smoother.stops[3]
    # The first stop is held, so that a pose relative to it is as sure as in the world.
    assert np.allclose(smoother.relative_covariance(a, b), smoother.covariance(b), rtol=1e-6)
    near, far = smoother.relative_covariance(smoother.stops[2], b), smoother.covariance(b)
    assert np.trace(near[3:, 3:]) < np.trace(far[3:, 3:])
    assert np.all(smoother.relative_covariance(b, b) == 0)


def test_a_wrong_match_is_taken_back(small: Simulation, batch: Solution) -> None:
    t = small.traverse
    assert t.observations is not None
    smoother = TraverseSmoother(t.rig, SmootherOptions(outlier_sigma=None))
    exact = TraverseSmoother(t.rig, SmootherOptions(outlier_sigma=None))
    driven(t, smoother)
    driven(t, exact)
    seen = {(int(i), int(k)) for i, k in zip(t.observations.image, t.observations.track, strict=True)}
    # The other eye of an image that sees a track is said to see it where it cannot be.
    row = next(
        r
        for r, (i, k) in enumerate(zip(t.observations.image, t.observations.track, strict=True))
        if t.image_stop[i] == 3 and (int(i) ^ 1, int(k)) not in seen
    )
    wrong = replace(t.observations.select(np.array([row])), image=t.observations.image[[row]] ^ 1)
    wrong = replace(wrong, uv_px=wrong.uv_px + 25.0)
    before = smoother.cost
    assert smoother.add_observations(wrong).cost > before + 10
    smoother.remove(wrong)
    assert smoother.cost == pytest.approx(exact.cost, rel=1e-6)
    a, b = smoother.estimate().world_T_mast[3], exact.estimate().world_T_mast[3]
    assert np.all(
        np.abs(b.localCoordinates(a)) < 0.02 * np.sqrt(np.diag(exact.covariance(smoother.stops[3])))
    )


def test_wrong_observations_are_rejected_as_they_come(small: Simulation, batch: Solution) -> None:
    t = small.traverse
    wrong = simulate(mer_navcam(), replace(_SMALL, outliers=0.05), seed=3)
    smoother = TraverseSmoother(t.rig)
    updates = driven(wrong.traverse, smoother)
    n_wrong = int(wrong.truth.outlier.sum())
    assert 0.7 * n_wrong < sum(u.rejected for u in updates) < 1.6 * n_wrong
    require_batch(smoother, solve(wrong.traverse))


def test_it_goes_on_after_a_restart(small: Simulation, batch: Solution, tmp_path: Path) -> None:
    t, path = small.traverse, tmp_path / "drive.npz"
    parts = list(stops_of(t))
    smoother = TraverseSmoother(t.rig)
    for part in parts[:2]:
        smoother.add_stop(*part)
    smoother.save(path)
    again = TraverseSmoother.load(path)
    assert again.stops == smoother.stops
    assert again.images == smoother.images
    # Of blocks that hardly moved the cost is that of their linear model; read anew, they are linearised.
    assert again.cost == pytest.approx(smoother.cost, rel=1e-4)
    for part in parts[2:]:
        again.add_stop(*part)
    require_batch(again, batch)


def test_a_saved_state_of_another_kind_is_refused(small: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "drive.npz"
    smoother = TraverseSmoother(small.traverse.rig)
    with pytest.raises(InputError, match="at least one stop"):
        smoother.save(path)
    smoother.add_stop(*next(stops_of(small.traverse)))
    smoother.save(path)
    whole = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)
    header = arrays["header"].tobytes().replace(b'"version": 1', b'"version": 2', 1)
    np.savez(path, **{**arrays, "header": np.frombuffer(header, dtype=np.uint8)})
    other = path.read_bytes()
    with pytest.raises(InputError, match=r"drive\.npz: version: expected 1, found 2"):
        TraverseSmoother.load(path)
    assert path.read_bytes() == other
    for damaged in (whole[: len(whole) // 2], whole[:500] + b"\0" * 400 + whole[900:], b""):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"drive\.npz: .*"):
            TraverseSmoother.load(path)
        assert path.read_bytes() == damaged
    np.savez(path, **{k: v for k, v in arrays.items() if k != "vector"})
    with pytest.raises(InputError, match=r"drive\.npz: vector: expected an array of this name"):
        TraverseSmoother.load(path)


def test_bad_input_changes_nothing(small: Simulation) -> None:
    t = small.traverse
    parts = list(stops_of(t))
    smoother = TraverseSmoother(t.rig)
    smoother.add_stop(*parts[0])
    smoother.add_stop(*parts[1])
    before = smoother.cost
    one = Observations(
        image=np.array([0]), track=np.array([10**6]), uv_px=np.array([[1.0, 1.0]]), sigma_px=np.ones(1)
    )
    with pytest.raises(InputError, match=r"stop stop0001: .* added already"):
        smoother.add_stop(*parts[1])
    with pytest.raises(InputError, match="'frame00000' of another stop"):
        smoother.add_stop(
            replace(parts[2][0]), [replace(f, stop=parts[2][0].id) for f in parts[0][1]], parts[0][2]
        )
    with pytest.raises(InputError, match=r"image, row 0: expected a row of the 16 images .* found 16"):
        smoother.add_observations(replace(one, image=np.array([16])))
    with pytest.raises(InputError, match="to see a track once"):
        smoother.add_observations(parts[0][3].select(np.array([0])))
    with pytest.raises(InputError, match="an observation that was added"):
        smoother.remove(one)
    with pytest.raises(InputError, match="found 'stop9'"):
        smoother.covariance("stop9")
    with pytest.raises(InputError, match="found 'stop9'"):
        smoother.add_stop(*parts[2], after="stop9")
    assert smoother.stops == (t.stops[0].id, t.stops[1].id)
    assert smoother.cost == before
    with pytest.raises(InputError, match="telemetry"):
        SmootherOptions(telemetry="guessed")  # type: ignore[arg-type]  # what is tested


def test_a_stop_without_a_connection_keeps_its_odometry(small: Simulation) -> None:
    parts = list(stops_of(small.traverse))
    smoother = TraverseSmoother(small.traverse.rig, SmootherOptions(telemetry="odometry"))
    smoother.add_stop(*parts[0])
    alone = replace(parts[1][3], track=parts[1][3].track + 10**6)
    update = smoother.add_stop(*parts[1][:3], alone)
    assert any("no track connects it" in w for w in update.warnings)
    said = parts[1][0].world_T_mast
    assert np.abs(said.localCoordinates(smoother.estimate().world_T_mast[1])).max() < 1e-3
    sigma = np.sqrt(np.diag(smoother.covariance(parts[1][0].id)))[3:]
    assert sigma == pytest.approx(parts[1][0].sigma_translation_m, rel=0.05)


def test_a_track_number_used_for_two_places_is_found(small: Simulation) -> None:
    parts = list(stops_of(small.traverse))
    smoother = TraverseSmoother(small.traverse.rig)
    smoother.add_stop(*parts[0])
    smoother.add_stop(*parts[1])
    known = set(parts[0][3].track) & set(parts[1][3].track)
    part = parts[2][3]
    tracks, counts = np.unique(part.track, return_counts=True)
    taken = tracks[(counts >= 2) & ~np.isin(tracks, list(known | set(parts[0][3].track)))][0]
    victim = next(k for k in sorted(known) if k not in set(part.track))
    update = smoother.add_stop(
        *parts[2][:3], replace(part, track=np.where(part.track == taken, victim, part.track))
    )
    assert any(f"track ({victim})" in w and "another place" in w for w in update.warnings)


def closing(loop: Simulation) -> tuple[TraverseSmoother, list[Parts], list[IntArray]]:
    """The drive but for what closes the loop: rows of each stop that see what stops half a drive ago saw."""
    parts = list(stops_of(loop.traverse))
    held_back = []
    early = set(np.concatenate([p[3].track for p in parts[:3]]).tolist())
    smoother = TraverseSmoother(loop.traverse.rig, SmootherOptions(rig="held", telemetry="odometry"))
    for i, part in enumerate(parts):
        rows = np.flatnonzero(np.isin(part[3].track, list(early))) if i >= 6 else np.zeros(0, dtype=np.int64)
        held_back.append(rows)
        smoother.add_stop(*less(part, rows))
    return smoother, parts, held_back


def late_of(loop: Simulation, part: Parts, rows: IntArray, stop: int) -> Observations:
    """Rows of a stop, images counted over the whole drive."""
    taken = part[3].select(rows)
    return replace(taken, image=taken.image + int(np.flatnonzero(loop.traverse.image_stop == stop)[0]))


def error_m(loop: Simulation, smoother: TraverseSmoother, stop: int) -> float:
    found, truth = smoother.estimate().world_T_mast[stop], loop.truth.world_T_mast[stop]
    return float(np.linalg.norm(found.translation() - truth.translation()))


def test_a_late_match_closes_the_loop(loop: Simulation) -> None:
    smoother, parts, held_back = closing(loop)
    last = len(parts) - 1
    sigma = smoother.covariance(smoother.stops[last])
    update = smoother.add_observations(late_of(loop, parts[last], held_back[last], last))
    assert [(c.stop, c.accepted) for c in update.closures] == [(smoother.stops[last], True)]
    assert update.closures[0].sigmas < 4
    after = smoother.covariance(smoother.stops[last])
    assert error_m(loop, smoother, last) < 4 * np.sqrt(np.trace(after[3:, 3:]))
    assert np.trace(after) < 0.5 * np.trace(sigma)


@pytest.mark.slow
def test_a_wrong_loop_closure_is_found_and_not_believed(loop: Simulation) -> None:
    smoother, parts, held_back = closing(loop)
    last, middle = len(parts) - 1, 7
    before = smoother.estimate().world_T_mast
    # What the last stop sees at the first is said to be seen from the middle, as by a look-alike.
    wrong = late_of(loop, parts[last], held_back[last], middle)
    update = smoother.add_observations(wrong)
    assert [(c.stop, c.accepted) for c in update.closures] == [(smoother.stops[middle], False)]
    assert any("not believed" in w for w in update.warnings)
    assert update.rejected > 0.95 * len(wrong)
    for stop, a, b in zip(smoother.stops, before, smoother.estimate().world_T_mast, strict=True):
        sigma = np.sqrt(np.diag(smoother.covariance(stop)))
        assert np.all(np.abs(a.localCoordinates(b)) <= 0.3 * sigma)


def test_a_shared_mount_is_estimated_along_the_way() -> None:
    wrong = simulate(mer_navcam(), replace(_SMALL, mount_error_rad=2e-3, stops=3), seed=5)
    sharing = Sharing(mounts=Freedom(scope="eye", free=("rx_rad", "ry_rad", "rz_rad")))
    t = replace(wrong.traverse, sharing=sharing)
    smoother = TraverseSmoother(t.rig, SmootherOptions(sharing=sharing, outlier_sigma=None))
    driven(t, smoother)
    batch = solve(t, SolveOptions(loss="none"))
    assert smoother.cost == pytest.approx(batch.cost_final, rel=1e-3)
    for i in (1, 2):
        sigma = np.sqrt(np.diag(batch.stop_covariance[i]))
        found = batch.final.world_T_mast[i].localCoordinates(smoother.estimate().world_T_mast[i])
        assert np.all(np.abs(found) < 0.05 * sigma)
        assert np.sqrt(np.diag(smoother.covariance(smoother.stops[i]))) == pytest.approx(sigma, rel=0.01)


def test_a_traverse_is_solved_stop_by_stop(small: Simulation, batch: Solution, tmp_path: Path) -> None:
    heard: list[Update] = []
    solution = solve_incrementally(small.traverse, on_stop=heard.append)
    assert solution.incremental is not None
    assert solution.cost_final == pytest.approx(batch.cost_final, rel=1e-3)
    assert solution.incremental.cost_per_stop[-1] == pytest.approx(solution.cost_final, rel=1e-6)
    assert solution.incremental.seconds_per_stop == tuple(u.seconds for u in heard)
    write_results(solution, tmp_path / "out", report=False)
    entry = read_solution_json(tmp_path / "out" / "solution.json").incremental
    assert entry is not None
    assert len(entry.seconds_per_stop) == len(entry.relinearised_per_stop) == 4
    assert entry.cost_per_stop == list(solution.incremental.cost_per_stop)
    with pytest.raises(InputError, match="incremental: model: expected mast, found circle"):
        solve_incrementally(small.traverse, SolveOptions(model="circle"))


def test_noise_of_what_images_say_is_found_at_the_end(small: Simulation, batch: Solution) -> None:
    # Tie points found in images do not know their noise: here it is taken for half of what it is.
    observations = small.traverse.observations
    assert observations is not None
    found = replace(observations, sigma_px=observations.sigma_px / 2, origin="images")
    t = small.traverse.with_observations(found)
    # Observations of another program's are held to have no field, those from images are not.
    options = SolveOptions(outlier_sigma=8.0, field=False)
    solution, expected = solve_incrementally(t, options), solve(t, options)
    for one, other in zip(solution.stop_covariance, expected.stop_covariance, strict=True):
        assert np.sqrt(np.diag(one)) == pytest.approx(np.sqrt(np.diag(other)), rel=0.01)
    # Not those of half the noise.
    ratio = np.sqrt(np.diag(solution.stop_covariance[-1]) / np.diag(batch.stop_covariance[-1]))
    assert ratio == pytest.approx(np.ones(6), abs=0.1)


def test_the_replay_has_a_frame_for_each_stop(small: Simulation, tmp_path: Path) -> None:
    smoother, steps = TraverseSmoother(small.traverse.rig), list[DriveStep]()
    for part in stops_of(small.traverse):
        steps.append(DriveStep.of(smoother, smoother.add_stop(*part), small))
    write_drive(steps, small, tmp_path / "drive.html")
    page = (tmp_path / "drive.html").read_text()
    assert 'max="4"' in page
    assert "9 m driven" in page
    assert "http://" not in page.split("packed-plotly")[0]
    assert steps[-1].error_m < steps[-1].odometry_error_m
