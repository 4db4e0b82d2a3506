"""Ties between stops: terrain, alignment, and rendered stereo panoramas with known truth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph import (
    Rendering,
    RenderOptions,
    SimulationOptions,
    Solution,
    SolveOptions,
    Traverse,
    find_observations,
    read_traverse,
    render,
    simulate,
    solve,
    write_rendering,
)
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray
from pancam_graph.base.threads import n_workers
from pancam_graph.cameras import Pinhole
from pancam_graph.data import Refusal, StopMatching
from pancam_graph.images import FrontEndOptions, _alignment, _placed, _refine, _steps
from pancam_graph.images._alignment import Alignment, Ties, believed, fit_pose, telemetry_alignment
from pancam_graph.images._between import StopMatcher, StopTies, agreeing
from pancam_graph.images._cache import Arrays
from pancam_graph.images._features import Features
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._splines import Splines
from pancam_graph.images._terrain import StopTerrain, terrain_arrays, terrain_from, unplaced_arrays
from pancam_graph.rigs import Eye, Rig, rig_template
from support.truth import place_error, relative_rms_rad

QUICK = FrontEndOptions(max_features=1500, max_ties=700)

# --- terrain and alignment, from simulated points ---


@pytest.fixture(scope="module")
def simulated() -> tuple[StopTerrain, tuple[gtsam.Pose3, ...]]:
    """The terrain of two stops that share no track, and the true masts."""
    options = SimulationOptions(
        stops=2, pans=8, tilts_rad=(-0.3,), points_per_image=60, link_stops=0, noise_px=0.1, spacing_m=5.0
    )
    simulation = simulate(rig_template("mer-navcam"), options, seed=3)
    traverse = simulation.traverse
    assert traverse.observations is not None
    order = np.lexsort((traverse.observations.image, traverse.observations.track))
    ordered = traverse.with_observations(traverse.observations.select(order))
    arrays: dict[str, Any] = terrain_arrays(solve(ordered), np.zeros(len(order), dtype=np.int64))
    terrain = terrain_from(ordered, drive_row=np.arange(len(ordered.images)), **arrays)
    return terrain, simulation.truth.world_T_mast


def test_terrain_lies_where_the_estimated_rig_has_it() -> None:
    """With the claimed rig, off as it says it may be, it is where other stops do not see it."""
    options = SimulationOptions(
        stops=1,
        pans=4,
        tilts_rad=(-0.3,),
        points_per_image=30,
        sweep_rad=None,
        rig_error="drawn",
        noise_px=0.1,
    )
    traverse = simulate(rig_template("mer-navcam"), options, seed=3).traverse
    solution = solve(traverse, SolveOptions(field=False))
    rows = np.arange(len(traverse.images))
    none = np.zeros(len(solution.used), dtype=np.int64)
    as_claimed = replace(solution, final=replace(solution.final, rig=None))
    arrays: list[dict[str, Any]] = [terrain_arrays(each, none) for each in (solution, as_claimed)]
    off = [distances(terrain_from(traverse, drive_row=rows, **each), solution) for each in arrays]
    assert np.median(off[0]) < 1e-3  # the flex of frames is left out
    assert np.median(off[1]) > 2e-3


def distances(terrain: StopTerrain, solution: Solution) -> FloatArray:
    """From the solution's points (n,), as shares of their range."""
    parts = []
    for i in np.unique(terrain.image).tolist():
        rows = np.flatnonzero(terrain.image == i)
        points = solution.final.landmarks_m[np.searchsorted(solution.landmark_track, terrain.track[rows])]
        apart = np.linalg.norm(terrain.points_m(rows) - points, axis=1)
        parts.append(apart / np.linalg.norm(points - solution.final.world_t_camera[i], axis=1))
    return np.concatenate(parts)


def seen_rows(terrain: StopTerrain, mast: gtsam.Pose3) -> Ties:
    """What the images of stop 1 see of the terrain of stop 0, without any error."""
    parts = []
    for i in np.unique(terrain.image[terrain.stop == 0]).tolist():
        rows = np.flatnonzero(terrain.image == i)
        for j in np.flatnonzero(terrain.traverse.image_stop == 1).tolist():
            seen = terrain.sighting(rows, j, mast)
            on = seen.valid & terrain.camera(j).contains(seen.uv_px)
            count = int(on.sum())
            parts.append(
                Ties(
                    row=rows[on],
                    image=np.full(count, j),
                    uv_px=seen.uv_px[on],
                    covariance_px2=np.tile(np.eye(2), (count, 1, 1)),
                )
            )
    return Ties.concatenate(parts)


def test_telemetry_that_ties_contradict_pulls_less(
    simulated: tuple[StopTerrain, tuple[gtsam.Pose3, ...]],
) -> None:
    terrain, _ = simulated
    telemetry = telemetry_alignment(terrain, 0, 1)
    sigma = float(np.sqrt(telemetry.covariance[3, 3]))
    for off, grown in ((2.0, 1.0), (6.0, 6.0)):
        found = replace(telemetry, world_T_mast=moved_by(telemetry.world_T_mast, off * sigma))
        assert believed(telemetry, found).root == pytest.approx(grown * telemetry.root)


@pytest.mark.slow
def test_a_search_begins_where_most_matches_agree(
    simulated: tuple[StopTerrain, tuple[gtsam.Pose3, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Telemetry 5 sigma off: in its own windows near terrain is not, and matches there are wrong."""
    terrain, masts = simulated
    true = terrain.traverse.stops[0].world_T_mast.compose(masts[0].between(masts[1]))
    ties, rng, sigma_m = seen_rows(terrain, true), np.random.default_rng(0), 0.15

    def matched(*given: Any) -> tuple[Ties, FloatArray]:
        at = given[3]
        seen = terrain.sighting(ties.row, ties.image, at.world_T_mast)
        spread = seen.covariance_px2(at.covariance, terrain.sigma_inverse_m[ties.row])
        half = QUICK.search_sigmas * np.sqrt(np.linalg.eigvalsh(spread)[:, 1]) + QUICK.search_slack_px
        there = np.linalg.norm(ties.uv_px - seen.uv_px, axis=1) < half
        chance = seen.uv_px + half[:, None] * rng.uniform(-1, 1, (len(ties), 2))
        found = replace(ties, uv_px=np.where(there[:, None], ties.uv_px, chance))
        return found.select(seen.valid), half[seen.valid]

    def no_features(_: int) -> Features:
        return Features.none()

    monkeypatch.setattr(_alignment, "_matched", matched)
    for angle in np.deg2rad([75.0, 200.0]):
        off = 5 * sigma_m * np.array([np.cos(angle), np.sin(angle), 0.0])
        told = Alignment(
            world_T_mast=true.compose(gtsam.Pose3(gtsam.Rot3(), off)),
            root=np.diag([2e-3] * 3 + [sigma_m] * 3),
        )
        begun = {}
        for wide_px in (10.0, np.inf):
            monkeypatch.setattr(_alignment, "_WIDE_PX", wide_px)
            begun[wide_px] = _alignment._begun(terrain, no_features, (0, 1), told, QUICK)
        assert begun[np.inf] is told
        apart = true.between(begun[10.0].world_T_mast).translation()
        assert np.linalg.norm(apart) < 0.5 * sigma_m


def moved_by(pose: gtsam.Pose3, forward_m: float) -> gtsam.Pose3:
    return pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([forward_m, 0.0, 0.0])))


def test_directions_that_contradict_each_other_give_no_ties(
    simulated: tuple[StopTerrain, tuple[gtsam.Pose3, ...]],
) -> None:
    terrain, _ = simulated
    masts = [s.world_T_mast for s in terrain.traverse.stops]

    def found(a: int, b: int, off_m: float, sigma_m: float) -> StopTies:
        count = 20
        return StopTies(
            ties=Ties(
                row=np.arange(count),
                image=np.zeros(count, dtype=np.int64),
                uv_px=np.zeros((count, 2)),
                covariance_px2=np.tile(np.eye(2), (count, 1, 1)),
            ),
            report=StopMatching(
                a=a,
                b=b,
                sought=25,
                unlike=0,
                ambiguous=0,
                unstable=0,
                masked=0,
                off_pose=5,
                kept=count,
                noise_px=0.1,
            ),
            pose=Alignment(world_T_mast=moved_by(masts[b], off_m), root=sigma_m * np.eye(6)),
        )

    there = found(0, 1, 0.0, 0.02)
    # Within their sigmas, and within a fiftieth of the way however small these are.
    for off_m, sigma_m in ((0.3, 0.2), (0.05, 1e-4)):
        back = found(1, 0, off_m, sigma_m)
        assert agreeing(terrain, there, back) == (there, back)
    refused = agreeing(terrain, there, found(1, 0, 1.0, 0.02))
    for each in refused:
        assert each.report.refusal is Refusal.CONTRADICTION
        assert len(each.ties) == each.report.kept == 0
        assert each.report.sought == each.report.off_pose
        assert StopTies.of_arrays(each.arrays()).report == each.report


def test_stops_apart_and_beside_each_other_see_the_same(
    simulated: tuple[StopTerrain, tuple[gtsam.Pose3, ...]],
) -> None:
    """Each through its own rig: points lie where that of the first has them, pixels where the other does."""
    terrain, masts = simulated
    rig = terrain.rigs[1]
    left = rig.eyes[0]
    K = left.camera.pinhole.calibration_matrix + np.array([[20.0, 0, 5], [0, 20, 0], [0, 0, 0]])
    other = replace(rig, eyes=(replace(left, camera=left.camera.with_calibration(K)), *rig.eyes[1:]))
    both = replace(terrain, rigs=(rig, other))
    apart = [both.of_stop(stop) for stop in (0, 1)]
    assert [list(each.drive_row) for each in apart] == [list(range(16)), list(range(16, 32))]
    assert sum(len(each.image) for each in apart) == len(terrain.image)
    joined = apart[0].beside(apart[1])
    assert list(joined.drive_row) == list(range(32))
    order = np.argsort(terrain.stop, kind="stable")
    np.testing.assert_array_equal(joined.track, terrain.track[order])
    np.testing.assert_array_equal(joined.image, terrain.image[order])
    rows = np.flatnonzero(joined.image == 0)
    points = terrain.points_m(order[rows])
    np.testing.assert_array_equal(joined.points_m(rows), points)
    traverse = terrain.traverse
    image = next(i for i in range(16, 32) if traverse.image_eye[i] == 0)
    seen = joined.sighting(rows, image, masts[1])
    frame = traverse.image_frame[[image]]
    R, centre = (part[0] for part in other.mast_T_camera(traverse.pan_tilt_rad[frame], np.array([0])))
    in_mast = (points - masts[1].translation()) @ masts[1].rotation().matrix()
    expected = other.eyes[0].camera.project((in_mast - centre) @ R)[0]
    np.testing.assert_allclose(seen.uv_px[seen.valid], expected[seen.valid], atol=1e-6)
    through_one_rig = terrain.sighting(order[rows], image, masts[1])
    assert np.abs(seen.uv_px - through_one_rig.uv_px)[seen.valid].max() > 5.0


def test_a_stop_that_cannot_be_placed_gives_no_ties(
    simulated: tuple[StopTerrain, tuple[gtsam.Pose3, ...]],
) -> None:
    traverse = simulated[0].traverse
    nowhere: dict[str, Any] = unplaced_arrays(traverse)
    empty = terrain_from(traverse, drive_row=np.arange(len(traverse.images)), **nowhere).of_stop(0)
    matcher = StopMatcher(
        terrain=empty.beside(simulated[0].of_stop(1)),
        spline=lambda *_: pytest.fail("nothing is to be sought"),
        usable=lambda _: pytest.fail("nothing is to be sought"),
        features=lambda _: Features.none(),
        options=QUICK,
    )
    found = [matcher.ties(*stops) for stops in ((0, 1), (1, 0))]
    assert [each.report.refusal for each in found] == [Refusal.FEW_ALIKE] * 2
    assert agreeing(matcher.terrain, *found) == tuple(found)


def test_derivatives_of_sightings(simulated: tuple[StopTerrain, tuple[gtsam.Pose3, ...]]) -> None:
    terrain, masts = simulated
    ties = seen_rows(terrain, masts[1])
    first, image = int(terrain.image[ties.row[0]]), int(ties.image[0])
    rows = ties.row[(terrain.image[ties.row] == first) & (ties.image == image)]
    seen = terrain.sighting(rows, image, masts[1])
    for k in range(6):
        change = 1e-6 * np.eye(6)[k]
        ahead, behind = (terrain.sighting(rows, image, masts[1].retract(s * change)).uv_px for s in (1, -1))
        numeric = (ahead - behind) / 2e-6
        np.testing.assert_allclose(seen.d_pose[:, :, k], numeric, rtol=1e-5, atol=1e-3)
    step = 1e-7
    ahead, behind = (
        replace(terrain, inverse_depth=terrain.inverse_depth + s * step).sighting(rows, image, masts[1]).uv_px
        for s in (1, -1)
    )
    np.testing.assert_allclose(seen.d_inverse_depth, (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-2)


def test_slopes_are_those_of_the_ground(simulated: tuple[StopTerrain, tuple[gtsam.Pose3, ...]]) -> None:
    """On a level plane the pixel beside lands on the plane, too."""
    terrain, _ = simulated
    for i in np.unique(terrain.image)[:4].tolist():
        rows = np.flatnonzero(terrain.image == i)
        near = rows[terrain.inverse_depth[rows] > 0.1]
        rise = terrain.points_m(near, (0.0, -2.0)) - terrain.points_m(near)
        steepness = rise[:, 2] / np.linalg.norm(rise[:, :2], axis=1)
        assert np.median(np.abs(steepness)) < 0.2


def test_pose_is_found_among_wrong_ties(simulated: tuple[StopTerrain, tuple[gtsam.Pose3, ...]]) -> None:
    terrain, masts = simulated
    rng = np.random.default_rng(1)
    ties = seen_rows(terrain, masts[1])
    uv = ties.uv_px + rng.normal(scale=0.3, size=ties.uv_px.shape)
    wrong = rng.random(len(ties)) < 0.5
    uv[wrong] += rng.uniform(-80, 80, (int(wrong.sum()), 2))
    prior = telemetry_alignment(terrain, 0, 1)
    found = fit_pose(terrain, replace(ties, uv_px=uv), prior, prior, 80.0)
    error = gtsam.Pose3.Logmap(masts[1].between(found.world_T_mast))
    start = gtsam.Pose3.Logmap(masts[1].between(prior.world_T_mast))
    assert np.abs(start[3:]).max() > 0.05
    assert np.abs(error[3:]).max() < 0.02
    assert np.abs(error[:3]).max() < 3e-3  # the heading is as good as the pan of the first stop


# --- rendered images ---


def small_rig() -> Rig:
    """A Navcam of a third of the resolution."""
    camera = Pinhole(width_px=352, height_px=352, fx_px=420.0, fy_px=420.0, cx_px=175.5, cy_px=175.5)
    eyes = tuple(
        Eye(
            name=name,
            camera=camera,
            head_T_camera=gtsam.Pose3(gtsam.Rot3(HEAD_R_FORWARD_CAMERA), np.array([0.1, y, 0.0])),
        )
        for name, y in (("left", 0.15), ("right", -0.15))
    )
    return replace(rig_template("mer-navcam"), name="small navcam", eyes=eyes)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rendering, Traverse]:
    folder = tmp_path_factory.mktemp("rendered") / "traverse"
    options = RenderOptions(
        spacing_m=3.0, pans=3, sweep_rad=float(np.deg2rad(105)), heading_change_rad=0.05, sigma_stop_m=0.05
    )
    rendering = render(small_rig(), options, seed=5)
    write_rendering(rendering, folder)
    return rendering, read_traverse(folder)


Fitted = list[tuple[PairGeometry, FloatArray, FloatArray, FloatArray]]
"""Pairs of images, pixels in the first, and in the second as the features have them and as fitted."""


@pytest.fixture(scope="module")
def small_run(small: tuple[Rendering, Traverse]) -> tuple[Traverse, Fitted, int]:
    """What is found, what the least-squares matching within stops made of what, and how much was untied."""
    fitted: Fitted = []
    untied: dict[int, int] = {}
    original, observed = _refine._refine_pair, _steps.Steps.observed

    def counted(steps: _steps.Steps, group: int) -> Arrays:
        found = observed(steps, group)
        untied[group] = len(found["track"])
        return found

    def recorded(
        pair: PairGeometry, spline: Splines, uv_a: FloatArray, uv_b: FloatArray, options: FrontEndOptions
    ) -> _refine._PairFit:
        found = original(pair, spline, uv_a, uv_b, options)
        fitted.append((pair, uv_a[found.good], uv_b[found.good], found.uv_px[found.good]))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_refine, "_refine_pair", recorded)
        patch.setattr(_steps.Steps, "observed", counted)
        return find_observations(small[1], QUICK), fitted, sum(untied.values())


@pytest.fixture(scope="module")
def small_found(small_run: tuple[Traverse, Fitted, int]) -> Traverse:
    return small_run[0]


def errors_px(rendering: Rendering, traverse: Traverse) -> tuple[FloatArray, np.ndarray]:
    """By how much (n,) observations miss the point that their track's first one sees, and its row (n,)."""
    obs, truth = traverse.observations, rendering.truth
    assert obs is not None
    first = np.searchsorted(obs.track, obs.track)
    R, centre = traverse.camera_poses(truth.world_T_mast, truth.pan_tilt_rad)
    points, hit = np.empty((len(obs), 3)), np.empty(len(obs), dtype=bool)
    for i in np.unique(obs.image).tolist():
        points[obs.image == i], hit[obs.image == i] = rendering.points(i, obs.uv_px[obs.image == i])
    error = np.empty(len(obs))
    for i in np.unique(obs.image).tolist():
        k = obs.image == i
        camera = traverse.rig.eyes[traverse.image_eye[i]].camera
        error[k] = np.linalg.norm(
            camera.project((points[first[k]] - centre[i]) @ R[i])[0] - obs.uv_px[k], axis=1
        )
    error[~hit[first] | (first == np.arange(len(obs)))] = np.nan
    return error, first


@pytest.mark.slow
def test_the_noise_that_patches_predict_is_that_of_their_errors(
    small: tuple[Rendering, Traverse], small_found: Traverse
) -> None:
    """In stereo, along the epipolar line (a row here) and across it: robust sigmas, by stated noise."""
    obs, truth = small_found.observations, small[0].truth
    assert obs is not None
    assert obs.covariance_px2 is not None
    first = np.searchsorted(obs.track, obs.track)
    stereo = small_found.image_frame[obs.image] == small_found.image_frame[obs.image[first]]
    k = np.flatnonzero(stereo & (first != np.arange(len(obs))) & (obs.sigma_px < QUICK.sigma_px))
    R, centre = small_found.camera_poses(truth.world_T_mast, truth.pan_tilt_rad)
    error = np.full((len(obs), 2), np.nan)
    for i in np.unique(obs.image[first[k]]).tolist():
        rows = k[obs.image[first[k]] == i]
        points, hit = small[0].points(i, obs.uv_px[first[rows]])
        for j in np.unique(obs.image[rows]).tolist():
            on = (obs.image[rows] == j) & hit
            camera = small_found.rig.eyes[small_found.image_eye[j]].camera
            seen, _ = camera.project((points[on] - centre[j]) @ R[j])
            error[rows[on]] = obs.uv_px[rows[on]] - seen
    k = k[np.isfinite(error[k]).all(axis=1)]
    # The first of a track has a share of its own.
    sigma = np.sqrt(np.diagonal(obs.covariance_px2[k] + obs.covariance_px2[first[k]], axis1=1, axis2=2))
    ratio = np.abs(error[k]) / sigma
    by_noise = np.argsort(sigma[:, 0])
    for part in np.array_split(by_noise, 3):
        along, across = np.median(ratio[part], axis=0) / 0.6745
        assert 0.5 < along < 1.5
        assert 0.5 < across < 1.5
    assert np.quantile(sigma[:, 0], 0.9) > 2 * np.quantile(sigma[:, 0], 0.1)


def linking(traverse: Traverse, first: np.ndarray) -> np.ndarray:
    """Which observations (n,) are of another stop than their track's first."""
    assert traverse.observations is not None
    stop = traverse.image_stop[traverse.observations.image]
    return np.asarray(stop != stop[first])


@pytest.mark.slow
def test_ties_between_stops_lie_on_the_terrain(
    small: tuple[Rendering, Traverse], small_found: Traverse
) -> None:
    error, first = errors_px(small[0], small_found)
    link = linking(small_found, first) & np.isfinite(error)
    assert np.count_nonzero(link) > 40
    assert np.mean(error[link] < 1.5) > 0.7
    assert np.median(error[link]) < 0.6


@pytest.mark.slow
def test_least_squares_matching_beats_the_features_own_places(
    small: tuple[Rendering, Traverse], small_run: tuple[Traverse, Fitted, int]
) -> None:
    rendering, traverse = small
    R, centre = traverse.camera_poses(rendering.truth.world_T_mast, rendering.truth.pan_tilt_rad)
    errors: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    for pair, uv_a, *both in small_run[1]:
        points, hit = rendering.points(pair.a, uv_a)
        truth, _ = pair.camera_b.project((points - centre[pair.b]) @ R[pair.b])
        for error, uv_b in zip(errors, both, strict=True):
            error.append(np.linalg.norm(uv_b - truth, axis=1)[hit])
    before, after = (float(np.median(np.concatenate(e))) for e in errors)
    assert after < 0.5 * before


@pytest.mark.slow
def test_the_same_on_any_number_of_threads_and_from_the_cache(
    small: tuple[Rendering, Traverse], small_found: Traverse, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def not_again(*_: object) -> None:
        raise AssertionError("what was kept is made anew")

    before = small_found.observations
    assert before is not None
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "1" if n_workers() > 1 else "2")
    for _ in range(2):
        again = find_observations(small[1], QUICK, cache=tmp_path)
        assert again.observations is not None
        assert again.warnings == small_found.warnings
        for name in ("image", "track", "uv_px", "covariance_px2"):
            assert getattr(again.observations, name).tobytes() == getattr(before, name).tobytes()
        for name in ("find_features", "match_pair", "refine_tracks", "shared_by_tracks"):
            monkeypatch.setattr(_steps, name, not_again)
        monkeypatch.setattr(_placed, "terrain_arrays", not_again)
        monkeypatch.setattr(StopMatcher, "ties", not_again)


@pytest.mark.slow
def test_ties_that_were_found_before_an_interrupt_are_kept(
    small: tuple[Rendering, Traverse], small_found: Traverse, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "1")
    ties, done = StopMatcher.ties, list[int]()
    """Stops whose terrain was sought in the images of the other."""

    def interrupted(matcher: StopMatcher, one: int, other: int) -> StopTies:
        stop = int(small[1].image_stop[matcher.terrain.drive_row[0]])
        done.append(stop)
        if done == [0, 1]:
            raise KeyboardInterrupt
        return ties(matcher, one, other)

    def not_again(*_: object) -> None:
        raise AssertionError("what was kept is made anew")

    monkeypatch.setattr(StopMatcher, "ties", interrupted)
    with pytest.raises(KeyboardInterrupt):
        find_observations(small[1], QUICK, cache=tmp_path)
    assert len(list(tmp_path.glob("ties-*"))) == 1
    monkeypatch.setattr(_placed, "terrain_arrays", not_again)
    again = find_observations(small[1], QUICK, cache=tmp_path)
    assert done == [0, 1, 1]
    assert again.matching == small_found.matching
    assert again.observations is not None
    assert small_found.observations is not None
    for name in ("image", "track", "uv_px", "covariance_px2"):
        assert (
            getattr(again.observations, name).tobytes() == getattr(small_found.observations, name).tobytes()
        )


@pytest.mark.slow
def test_all_that_was_looked_at_is_accounted_for(
    small_found: Traverse, small_run: tuple[Traverse, Fitted, int]
) -> None:
    found = small_found.matching
    assert found is not None
    assert {(s.a, s.b) for s in found.stops} == {(0, 1), (1, 0)}
    for s in found.stops:
        assert s.sought == s.kept + s.unlike + s.ambiguous + s.unstable + s.masked + s.off_pose
        assert s.kept > 10
        assert s.unlike > 0
    for p in found.pairs:
        assert bool(p.refusal) == (p.kept == 0)
        if not p.refusal:
            assert p.candidates == p.kept + p.rover + p.off_line
    assert sum(p.off_line for p in found.pairs) > 0
    observations = small_found.observations
    assert observations is not None
    assert len(observations) - small_run[2] == sum(s.kept for s in found.stops)


@pytest.mark.slow
def test_small_panoramas_place_the_second_stop(
    small: tuple[Rendering, Traverse], small_found: Traverse
) -> None:
    solution = solve(small_found, SolveOptions(rig="held"))
    assert solution.converged
    assert place_error(small[0], solution) < 0.01
    assert relative_rms_rad(small[0], solution).max() < 0.15e-3


@pytest.mark.slow
def test_a_rig_that_is_off_costs_few_ties_between_stops(
    small: tuple[Rendering, Traverse], small_found: Traverse
) -> None:
    """Stops' terrain was placed with the rig as it is claimed: other stops then had next to no ties."""
    t = small[1]
    left, right = t.rig.eyes
    mount = right.head_T_camera
    off = gtsam.Pose3(mount.rotation() * gtsam.Rot3.Expmap(np.array([2e-3, 2e-3, 0.0])), mount.translation())
    rig = replace(t.rig, eyes=(left, replace(right, head_T_camera=off)))
    found = find_observations(replace(t, rig=rig), QUICK)
    assert found.matching is not None
    assert small_found.matching is not None
    n_ties = [sum(s.kept for s in matching.stops) for matching in (found.matching, small_found.matching)]
    assert n_ties[0] > 0.7 * n_ties[1]
    solution = solve(found, SolveOptions(field=False))
    assert solution.converged
    assert relative_rms_rad(small[0], solution).max() < 0.5e-3


def wac_pair() -> Rig:
    rig = rig_template("exomars-pancam")
    return replace(rig, name="exomars-wac", eyes=rig.eyes[:2])


@pytest.mark.slow
@pytest.mark.parametrize(
    "rig", [lambda: rig_template("mer-navcam"), wac_pair], ids=["mer-navcam", "exomars-wac"]
)
@pytest.mark.parametrize("seed", [1, 2])
def test_two_stereo_panoramas_reach_the_target(rig: Callable[[], Rig], seed: int, tmp_path: Path) -> None:
    """Two stops 7 m apart, ten azimuths, two eyes, 1024 x 1024, telemetry's errors; from files alone."""
    rendering = render(rig(), RenderOptions(), seed=seed)
    write_rendering(rendering, tmp_path / "traverse")
    # The lens is perfect: a field that is estimated adds its own uncertainty to pans of a row that is open.
    solution = solve(find_observations(read_traverse(tmp_path / "traverse")), SolveOptions(field=False))
    assert solution.converged
    assert relative_rms_rad(rendering, solution).max() < 0.15e-3
    assert place_error(rendering, solution) < 0.003
    error, first = errors_px(rendering, solution.traverse)
    judged = solution.used & solution.used[first] & np.isfinite(error)
    assert np.sqrt(np.mean(np.minimum(error[judged], 3.0) ** 2) / 2) < 0.35
    assert np.mean(solution.used) > 0.9
    assert not any("stops" in w for w in solution.warnings)
