"""Cross-validation: how halves are cut and solved, what they lose, refusals, and where it is written."""

import json
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from pancam_graph import (
    CrossValidation,
    Observations,
    SimulationOptions,
    Solution,
    SolveOptions,
    Traverse,
    cross_validate,
    simulate,
    solve,
)
from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.base.geometry import BoolArray
from pancam_graph.graph import Flex
from pancam_graph.landmarks import Measurements
from pancam_graph.report._cross_validation import cross_validation_section
from pancam_graph.report._page import make_page
from pancam_graph.results import read_solution_json, write_results
from pancam_graph.rigs import mer_navcam
from pancam_graph.solve.cross_validation._halves import Groups, random_half, upper_half
from support.parameters import slow_but_for

SMALL = SimulationOptions(stops=2, pans=3, sweep_rad=1.5, points_per_image=15)
PLAIN = SolveOptions(rig="held", loss="none")
EXACT = SolveOptions(rig="held", loss="none", relative_decrease=1e-11)


@pytest.fixture(scope="module")
def traverse() -> Traverse:
    return simulate(mer_navcam(), SMALL, seed=1).traverse


@pytest.fixture(scope="module")
def solution(traverse: Traverse) -> Solution:
    return solve(traverse, PLAIN)


@pytest.fixture(scope="module")
def found(traverse: Traverse, solution: Solution) -> CrossValidation:
    return cross_validate(traverse, PLAIN, solution=solution, halvings=2, seed=3)


# --- halves ---


def measurements_of(traverse: Traverse) -> Measurements:
    """All observations, as measurements sorted by track."""
    obs = traverse.observations
    assert obs is not None
    rows = np.lexsort((obs.image, obs.track))
    return Measurements(
        row=rows,
        image=obs.image[rows],
        landmark=np.unique(obs.track[rows], return_inverse=True)[1],
        uv_px=obs.uv_px[rows],
        whitening=np.tile(np.eye(2), (len(rows), 1, 1)),
    )


def test_halves_by_lot_are_alike_everywhere(traverse: Traverse) -> None:
    m = measurements_of(traverse)
    first = random_half(traverse, m, np.random.default_rng(0))
    assert first.sum() in {m.n_landmarks // 2, (m.n_landmarks + 1) // 2}
    frame = traverse.image_frame[m.image]
    ends = np.column_stack([side.reduceat(frame, m.starts) for side in (np.minimum, np.maximum)])
    for pair in np.unique(ends, axis=0):
        of_pair = (ends == pair).all(axis=1)
        assert abs(2 * first[of_pair].sum() - of_pair.sum()) <= 2
    again, other = (random_half(traverse, m, np.random.default_rng(seed)) for seed in (0, 1))
    assert np.array_equal(first, again)
    assert 0.3 < np.mean(first != other) < 0.7


def test_upper_is_above_the_middle_of_images_in_the_mean() -> None:
    t = simulate(mer_navcam(), replace(SMALL, stops=1), seed=0).traverse
    v = [511.0, 511.2, 511.9, 512.5, 100.0, 900.0, 100.0, 950.0]  # the middle of 1024 rows is at 511.5
    obs = Observations(
        image=np.tile([0, 1], 4),
        track=np.repeat([3, 5, 6, 9], 2),
        uv_px=np.column_stack([np.full(8, 10.0), v]),
        sigma_px=np.full(8, 0.3),
    )
    t = t.with_observations(obs)
    assert upper_half(t, measurements_of(t)).tolist() == [True, False, True, False]


def groups(seen: list[bool], group: list[int]) -> Groups:
    return Groups(seen=np.array(seen), group=np.array(group))


def test_lost_is_what_a_half_does_not_see_or_cuts_off_from_the_most() -> None:
    whole = groups([True] * 6 + [False], [0, 0, 0, 0, 1, 1, 2])
    half = groups([True, True, True, False, True, True, False], [0, 1, 1, 2, 3, 4, 5])
    #             cut off             together   not seen   two alone: the first stays   never seen
    assert whole.lost_in(half).tolist() == [True, False, False, True, False, True, False]
    assert not whole.lost_in(whole).any()
    assert half.joins(np.array([[1, 2], [0, 1], [2, 3], [3, 3]])).tolist() == [True, False, False, False]


def test_neighbours_are_a_tree_of_the_pairs_with_most_tracks(
    traverse: Traverse, found: CrossValidation
) -> None:
    obs = traverse.observations
    assert obs is not None
    frame = traverse.image_frame[obs.image]
    n = len(traverse.frames)
    tracks = [set(obs.track[frame == f].tolist()) for f in range(n)]
    shared = np.array([[len(a & b) for b in tracks] for a in tracks])
    assert found.pair_tracks.tolist() == [shared[i, j] for i, j in found.pairs]
    assert (traverse.frame_stop[found.pairs[:, 0]] == traverse.frame_stop[found.pairs[:, 1]]).all()
    assert len(found.pairs) == n - len(traverse.stops)  # every stop's frames hang together
    # Kruskal's way: no pair outside has more in common than every pair on the way between its frames.
    weight = 0
    for stop in range(len(traverse.stops)):
        frames = np.flatnonzero(traverse.frame_stop == stop)
        edges = sorted(((int(shared[i, j]), i, j) for i in frames for j in frames if i < j), reverse=True)
        group = {f: f for f in frames}
        for count, i, j in edges:
            if group[i] != group[j]:
                weight += count
                group = {f: group[i] if g == group[j] else g for f, g in group.items()}
    assert found.pair_tracks.sum() == weight


# --- solutions of halves ---


def halves_of(traverse: Traverse, upper: BoolArray) -> tuple[Traverse, Traverse]:
    """Traverses with the tracks of either half alone; `upper` is by number of track."""
    obs = traverse.observations
    assert obs is not None
    above = upper[np.unique(obs.track, return_inverse=True)[1]]
    return traverse.with_observations(obs.select(above)), traverse.with_observations(obs.select(~above))


def test_halves_are_solved_as_if_they_were_all_there_is(
    traverse: Traverse, solution: Solution, found: CrossValidation
) -> None:
    upper, lower = (
        solve(t, EXACT) for t in halves_of(traverse, upper_half(traverse, measurements_of(traverse)))
    )
    angles = upper.final.pan_tilt_rad - lower.final.pan_tilt_rad
    sigma = found.pointing.formal
    assert np.abs(np.abs(angles) - found.pointing.upper_lower.difference).max() < 1e-3 * sigma.min()
    i, j = found.pairs.T
    relative = np.abs(angles[j] - angles[i])
    assert relative == pytest.approx(found.relative_pointing.upper_lower.difference, abs=1e-3 * sigma.min())
    # Covariances are taken elsewhere, but not far off.
    assert found.pointing.formal == pytest.approx(solution.angle_sigma_rad, rel=1e-6)
    stops = np.sqrt(np.diagonal(solution.stop_covariance, axis1=1, axis2=2))
    assert found.stops.formal == pytest.approx(stops, rel=1e-6)
    squares = [
        ((half.final.pan_tilt_rad - solution.final.pan_tilt_rad) ** 2)
        / (half.angle_sigma_rad**2 - solution.angle_sigma_rad**2)
        for half in (upper, lower)
    ]
    expected = np.sqrt(np.mean(squares, axis=0))
    assert found.pointing.upper_lower.ratio == pytest.approx(expected, rel=0.05)


def test_scores_are_those_of_a_solve_with_cameras_held(traverse: Traverse, found: CrossValidation) -> None:
    halves = halves_of(traverse, upper_half(traverse, measurements_of(traverse)))
    solved = [solve(t, EXACT) for t in halves]
    scores = [s for s in found.scores if s.splitting == "upper_lower"]
    assert [s.half for s in scores] == ["upper", "lower"]
    for score, own, own_traverse, other in zip(scores, solved, halves, reversed(solved), strict=True):
        stops = tuple(
            replace(s, world_T_mast=pose, sigma_rotation_rad=0.0, sigma_translation_m=0.0)
            for s, pose in zip(traverse.stops, other.final.world_T_mast, strict=True)
        )
        frames = tuple(
            replace(f, pan_rad=float(a[0]), tilt_rad=float(a[1]), sigma_pan_rad=0.0, sigma_tilt_rad=0.0)
            for f, a in zip(traverse.frames, other.final.pan_tilt_rad, strict=True)
        )
        held = solve(replace(own_traverse, stops=stops, frames=frames), PLAIN)
        assert score.scored == score.tracks == len(own.landmark_track)
        assert score.observations == own.used.sum()
        assert score.own_px == pytest.approx(own.rms_final_px, rel=1e-6)
        assert score.other_px == pytest.approx(held.rms_final_px, rel=1e-6)
        assert score.own_px < score.other_px
        assert score.own_expected_px < score.other_expected_px
    n = [s.observations for s in scores]
    mean = np.sqrt(np.average([s.other_px**2 for s in scores], weights=n))
    assert found.score_px("upper_lower")[0] == pytest.approx(mean)


def loosened(traverse: Traverse, sigma: float) -> Traverse:
    """Telemetry that says nothing but where the first stop is and where its first frame points."""
    stops = [
        replace(s, sigma_rotation_rad=sigma, sigma_translation_m=100 * sigma) for s in traverse.stops[1:]
    ]
    frames = [replace(f, sigma_pan_rad=sigma, sigma_tilt_rad=sigma) for f in traverse.frames[1:]]
    first = replace(traverse.frames[0], sigma_pan_rad=0.0, sigma_tilt_rad=0.0)
    return replace(traverse, stops=(traverse.stops[0], *stops), frames=(first, *frames))


def test_expected_score_with_own_cameras_is_the_redundancy(traverse: Traverse) -> None:
    """Without telemetry's part: each determined unknown of cameras and points takes one equation."""
    loose = cross_validate(loosened(traverse, 1.0), PLAIN, halvings=1)
    assert loose.warnings == ()
    # The turn of the second mast about its axis and its frames' common pan are told apart by telemetry alone.
    unknowns = 2 * (len(traverse.frames) - 1) + 6 - 1
    for s in loose.scores:
        assert s.scored == s.tracks
        redundancy = 2 * s.observations - 3 * s.tracks - unknowns
        assert s.own_expected_px == pytest.approx(0.3 * np.sqrt(redundancy / s.observations), rel=1e-6)


def test_what_nothing_holds_has_no_sigmas_but_differences(traverse: Traverse) -> None:
    free = cross_validate(loosened(traverse, 1e9), PLAIN, halvings=1)
    assert free.warnings[0].startswith("no formal sigmas to compare with: nothing holds")
    assert free.warnings[1].startswith("first random half 1 has no formal sigmas: nothing holds")
    assert np.isnan(free.relative_pointing.honest).all()
    assert np.isfinite(free.relative_pointing.upper_lower.difference).all()
    for s in free.scores:
        assert 0.2 < s.own_px < s.other_px < 0.5
        assert np.isnan([s.own_expected_px, s.other_expected_px]).all()


def test_exact_halves_agree() -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, noise_px=0.0, prior="truth"), seed=3)
    exact = cross_validate(simulation.traverse, PLAIN, halvings=1)
    for sigmas in (exact.pointing, exact.relative_pointing, exact.stops):
        for spread in (sigmas.random, sigmas.upper_lower):
            assert spread.difference.max() < 1e-8
        assert np.array_equal(sigmas.honest, sigmas.formal)
    assert max(s.other_px for s in exact.scores) < 1e-5


@pytest.mark.slow
def test_the_same_arguments_give_the_same_numbers(
    traverse: Traverse, solution: Solution, found: CrossValidation
) -> None:
    told: list[tuple[str, int, int]] = []
    again = cross_validate(
        traverse, PLAIN, halvings=2, seed=3, progress=lambda *arguments: told.append(arguments)
    )
    assert np.array_equal(again.pointing.random.ratio, found.pointing.random.ratio)
    assert np.array_equal(again.stops.honest, found.stops.honest)
    assert again.scores == found.scores
    assert [(done, total) for _, done, total in told] == [(i, 6) for i in range(1, 7)]
    other = cross_validate(traverse, PLAIN, solution=solution, halvings=2, seed=4)
    assert not np.array_equal(other.pointing.random.ratio, found.pointing.random.ratio)
    assert np.array_equal(other.pointing.upper_lower.ratio, found.pointing.upper_lower.ratio)


OPTIONS = {
    "explicit": SolveOptions(rig="held", loss="none", landmarks="explicit"),
    "firm tie": SolveOptions(
        rig="held", loss="none", tie="soft", flex=Flex(rotation_rad=1e-6, translation_m=1e-5)
    ),
    "soft tie": SolveOptions(rig="held", loss="none", tie="soft"),
    "circle": SolveOptions(rig="held", loss="none", model="circle"),
    "free": SolveOptions(rig="held", loss="none", model="free"),
}


@pytest.mark.parametrize("name", slow_but_for(["soft tie"], OPTIONS))
def test_models_ties_and_landmarks(traverse: Traverse, found: CrossValidation, name: str) -> None:
    other = cross_validate(traverse, OPTIONS[name], halvings=1)
    assert other.warnings == ()
    for sigmas in (other.pointing, other.relative_pointing, other.stops):
        assert np.isfinite(sigmas.honest).all()
    if name in {"explicit", "firm tie"}:  # the rigid mast in other words
        for a, b in zip(
            (other.relative_pointing, other.stops), (found.relative_pointing, found.stops), strict=True
        ):
            assert a.formal == pytest.approx(b.formal, rel=0.02)
            assert a.upper_lower.difference == pytest.approx(b.upper_lower.difference, rel=0.02, abs=1e-6)
            assert a.upper_lower.ratio == pytest.approx(b.upper_lower.ratio, rel=0.02, abs=0.01, nan_ok=True)


def test_measured_sigmas_stay_what_the_solution_made_them(traverse: Traverse) -> None:
    """Noise is half of what was thought: halves take it as the solution does."""
    obs = traverse.observations
    assert obs is not None
    t = traverse.with_observations(replace(obs, sigma_px=2 * obs.sigma_px, origin="images"))
    solution = solve(t, PLAIN)
    assert np.median(solution.sigma_px) == pytest.approx(0.3, rel=0.1)
    measured = cross_validate(t, PLAIN, solution=solution, halvings=1)
    assert measured.pointing.formal == pytest.approx(solution.angle_sigma_rad, rel=1e-3)
    scores = [s for s in measured.scores if s.splitting == "random"]
    assert np.mean([s.own_px / s.own_expected_px for s in scores]) == pytest.approx(1.0, rel=0.02)


# --- what halves lose ---


def lower_only(traverse: Traverse, frame: int) -> Traverse:
    """A traverse of which one frame is seen only by tracks in the lower half."""
    obs = traverse.observations
    assert obs is not None
    upper = upper_half(traverse, measurements_of(traverse))[np.unique(obs.track, return_inverse=True)[1]]
    of_frame = traverse.image_frame[obs.image] == frame
    return traverse.with_observations(obs.select(~(of_frame & upper)))


def test_a_frame_that_a_half_does_not_see_is_said_and_not_judged() -> None:
    t = simulate(mer_navcam(), replace(SMALL, stops=1, pans=4, points_per_image=25), seed=0).traverse
    t = lower_only(t, 0)
    lost = cross_validate(t, PLAIN, halvings=1)
    assert np.isnan(lost.pointing.upper_lower.sigma[0]).all()
    assert np.isfinite(lost.pointing.upper_lower.sigma[1:]).all()
    assert np.isfinite(lost.pointing.honest).all()  # random halves see it
    of_frame = (lost.pairs == 0).any(axis=1)
    assert of_frame.any()
    assert np.array_equal(np.isnan(lost.relative_pointing.upper_lower.ratio[:, 0]), of_frame)
    (warning,) = lost.warnings
    assert warning.startswith(f"1 frame ({t.frames[0].id}) that the upper or the lower half does not see")
    upper, lower = lost.scores[-2:]
    assert upper.scored == upper.tracks
    # Tracks of the lost frame would be scored by its telemetry.
    assert 0 < lower.scored < lower.tracks
    assert lower.other_px < 2 * lower.other_expected_px


def test_a_stop_that_a_half_cuts_off_is_said_and_not_judged() -> None:
    t = simulate(mer_navcam(), SMALL, seed=0).traverse
    obs = t.observations
    assert obs is not None
    stop, track = t.image_stop[obs.image], np.unique(obs.track, return_inverse=True)[1]
    across = (np.bincount(track, stop == 0) > 0) & (np.bincount(track, stop == 1) > 0)
    upper = upper_half(t, measurements_of(t))
    apart = (across & upper)[track] & (stop == 1)
    cut = t.with_observations(replace(obs, track=obs.track + apart * (1 + obs.track.max())))
    lost = cross_validate(cut, PLAIN, halvings=1)
    assert np.isfinite(lost.stops.upper_lower.sigma[0]).all()
    assert np.isnan(lost.stops.upper_lower.sigma[1]).all()
    assert np.isfinite(lost.stops.random.sigma[1]).all()
    assert any(f"1 stop ({t.stops[1].id}) that the upper or the lower half" in w for w in lost.warnings)


def test_an_empty_half_says_nothing() -> None:
    t = simulate(mer_navcam(), replace(SMALL, stops=1), seed=0).traverse
    obs = t.observations
    assert obs is not None
    upper = upper_half(t, measurements_of(t))[np.unique(obs.track, return_inverse=True)[1]]
    low = cross_validate(t.with_observations(obs.select(~upper)), PLAIN, halvings=1)
    assert low.warnings == ("upper half says nothing: no track is of it",)
    assert np.isnan(low.pointing.upper_lower.sigma).all()
    assert np.isnan(low.pointing.upper_lower.overall)
    assert np.isnan([low.scores[-1].other_px, low.scores[-2].own_px, *low.score_px("upper_lower")]).all()
    assert (low.scores[-2].tracks, low.scores[-2].scored, low.scores[-1].scored) == (0, 0, 0)
    assert np.array_equal(low.pointing.honest, np.fmax(low.pointing.random.sigma, low.pointing.formal))


def test_a_half_that_does_not_converge_says_nothing(traverse: Traverse) -> None:
    options = SolveOptions(rig="held", loss="none", max_iterations=1, relative_decrease=0.0)
    found = cross_validate(traverse, options, halvings=1)
    assert np.isnan(found.pointing.honest).all()
    text = "\n".join(found.warnings)
    assert "the solution has not converged" in text
    assert "lower half says nothing: not converged (iteration limit of 1)" in text
    assert "first random half 1 says nothing" in text


def test_where_telemetry_holds_everything_there_is_nothing_to_tell(traverse: Traverse) -> None:
    t = replace(
        traverse,
        stops=tuple(replace(s, sigma_rotation_rad=0.0, sigma_translation_m=0.0) for s in traverse.stops),
        frames=tuple(replace(f, sigma_pan_rad=0.0, sigma_tilt_rad=0.0) for f in traverse.frames),
    )
    held = cross_validate(t, PLAIN, halvings=1)
    assert not held.pointing.honest.any()
    assert not held.stops.upper_lower.difference.any()
    assert np.isnan(held.pointing.random.overall)
    for s in held.scores:
        assert s.own_px == pytest.approx(s.other_px)
        assert s.own_expected_px == pytest.approx(s.other_expected_px)


# --- bad input ---


def test_refusals(traverse: Traverse, solution: Solution) -> None:
    obs = traverse.observations
    assert obs is not None
    with pytest.raises(InputError, match=r"cross-validation: halvings: expected 1 or more, found 0"):
        cross_validate(traverse, PLAIN, solution=solution, halvings=0)
    with pytest.raises(InputError, match=r"cross-validation: seed: expected 0 or more, found -1"):
        cross_validate(traverse, PLAIN, solution=solution, seed=-1)
    few = np.isin(obs.track, np.unique(obs.track)[:3])
    with pytest.raises(InputError, match=r"expected 4 used tracks or more to halve, found 3"):
        cross_validate(traverse.with_observations(obs.select(few)), PLAIN)
    with pytest.raises(SolveError, match="two or more images"):
        cross_validate(traverse.with_observations(obs.select(np.array([0]))), PLAIN)
    with pytest.raises(InputError, match="find_observations"):
        cross_validate(replace(traverse, observations=None), PLAIN)


@pytest.mark.parametrize(
    ("seed", "options", "model", "what"),
    [
        (2, SMALL, "mast", "other observations"),
        (1, replace(SMALL, stops=3), "mast", "other stops"),
        (1, replace(SMALL, pans=4), "mast", "other frames"),
        (1, SMALL, "free", "one of the model mast"),
    ],
)
def test_solutions_of_others_are_refused(
    solution: Solution, seed: int, options: SimulationOptions, model: str, what: str
) -> None:
    other = simulate(mer_navcam(), options, seed=seed).traverse
    with pytest.raises(InputError, match=f"^solution: expected one of .*found .*{what}$"):
        cross_validate(other, SolveOptions(rig="held", model=model), solution=solution)  # type: ignore[arg-type]  # parametrised


def test_equal_observations_in_other_arrays_are_the_same(
    traverse: Traverse, solution: Solution, found: CrossValidation
) -> None:
    obs = traverse.observations
    assert obs is not None
    copied = traverse.with_observations(obs.select(np.arange(len(obs))))
    again = cross_validate(copied, PLAIN, solution=solution, halvings=2, seed=3)
    assert np.array_equal(again.pointing.honest, found.pointing.honest)


# --- files ---


def test_solution_json_holds_it(solution: Solution, found: CrossValidation, tmp_path: Path) -> None:
    whole = solution.with_cross_validation(found)
    write_results(whole, tmp_path / "out", report=False)
    entry = read_solution_json(tmp_path / "out" / "solution.json").cross_validation
    assert entry is not None
    t = solution.traverse
    assert [f.id for f in entry.frames] == [f.id for f in t.frames]
    assert [s.id for s in entry.stops] == [s.id for s in t.stops]
    assert entry.frames[2].tilt_rad.formal == found.pointing.formal[2, 1]
    assert entry.frames[2].tilt_rad.honest == found.pointing.honest[2, 1]
    assert entry.frames[2].tilt_rad.random.sigma == found.pointing.random.sigma[2, 1]
    assert entry.frames[2].tilt_rad.upper_lower.difference == found.pointing.upper_lower.difference[2, 1]
    i, j = found.pairs[1]
    assert entry.pairs[1].frames == [t.frames[i].id, t.frames[j].id]
    assert entry.pairs[1].tracks == found.pair_tracks[1]
    assert entry.pairs[1].pan_rad.upper_lower.ratio == found.relative_pointing.upper_lower.ratio[1, 0]
    assert entry.stops[1].translation_m[2].honest == found.stops.honest[1, 5]
    assert entry.stops[0].rotation_rad[0].random.ratio is None  # held
    assert [s.other_px for s in entry.scores] == [s.other_px for s in found.scores]
    raw = json.loads((tmp_path / "out" / "solution.json").read_text())
    assert list(raw)[-1] == "cross_validation"
    assert type(entry).model_validate(raw["cross_validation"]) == entry


def test_report_shows_it(solution: Solution, found: CrossValidation) -> None:
    page = make_page(solution.with_cross_validation(found))
    assert "<h2>Cross-validation</h2>" in page
    assert "<h2>Cross-validation</h2>" not in make_page(solution)
    section = unescape(cross_validation_section(found, solution.traverse))
    pair = " → ".join(solution.traverse.frames[f].id for f in found.pairs[0])
    assert pair in section
    assert f"{1e3 * found.relative_pointing.formal[0, 0]:.4f}" in section
    assert f"{1e3 * found.relative_pointing.honest[0, 0]:.4f}" in section
    rows = section.count("<tr>") - 2 - len(found.scores)
    n_held = int(np.sum(found.stops.formal == 0))
    assert (
        rows
        == found.relative_pointing.formal.size + found.pointing.formal.size + found.stops.formal.size - n_held
    )


def test_report_escapes_what_users_wrote(found: CrossValidation, traverse: Traverse) -> None:
    frames = tuple(replace(f, id=f"<b>{f.id}") for f in traverse.frames)
    hostile = replace(
        traverse, frames=frames, images=tuple(replace(i, frame=f"<b>{i.frame}") for i in traverse.images)
    )
    section = cross_validation_section(replace(found, warnings=("<i>",)), hostile)
    assert "<b>" not in section
    assert "<li>&lt;i&gt;</li>" in section
