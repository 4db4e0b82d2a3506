"""Regular and shared parameters in turn: the joint optimum, at the speed theory says, and what ends it."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from pancam_graph import (
    Freedom,
    Sharing,
    SimulationOptions,
    Solution,
    SolveOptions,
    Traverse,
    cross_validate,
    simulate,
    solve,
)
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import ENTRIES, Quantity
from pancam_graph.data._sharing import Scope
from pancam_graph.elimination import Posture
from pancam_graph.graph import Flex
from pancam_graph.initialise import Start
from pancam_graph.landmarks import SQUARED
from pancam_graph.rigs import mer_navcam
from pancam_graph.solve import Fitted
from pancam_graph.solve import _alternation as alternation
from support.elimination_reference import whole
from support.parameters import slow_but_for
from support.solving import fitted

SMALL = SimulationOptions(stops=2, pans=3, sweep_rad=1.5, points_per_image=15)
LOOSE = Flex(rotation_rad=0.02, translation_m=5e-3)


def firm(quantity: Quantity, scope: Scope, sigma: float, *entries: str) -> Freedom:
    """Free about the rig's values; priors firm enough that alternation does not take forever."""
    free = entries or ENTRIES[quantity]
    known = {entry: 4 * sigma if entry.endswith("_m") else sigma for entry in free}
    return Freedom(scope=scope, free=free, sigma=known)


SHARED = {
    "radius": SolveOptions(model="circle", rig="held", flex=LOOSE),
    "radius of all": SolveOptions(
        model="circle", flex=LOOSE, sharing=Sharing(radius=Freedom(scope="all", sigma={"radius_m": 1e-2}))
    ),
    "calibration": SolveOptions(
        sharing=Sharing(calibration=firm("calibration", "eye", 0.05, "fx_px", "fy_px", "cx_px", "cy_px"))
    ),
    "calibration of free cameras": SolveOptions(
        model="free", sharing=Sharing(calibration=firm("calibration", "all", 0.02, "fx_px", "cx_px"))
    ),
    "mounts": SolveOptions(sharing=Sharing(mounts=firm("mounts", "eye", 2e-5))),
    "axis, focal length": SolveOptions(
        sharing=Sharing(
            pan_T_tilt=firm("pan_T_tilt", "all", 1e-5), calibration=firm("calibration", "all", 2e-5, "focal")
        )
    ),
}
"""Options by what is shared."""


def ways(name: str, **changes: object) -> tuple[SolveOptions, SolveOptions]:
    """Joint, and in turn."""
    options = replace(SHARED[name], loss="none", relative_decrease=1e-10, max_iterations=1000, **changes)  # type: ignore[arg-type]  # options by name
    return options, replace(options, method="alternation")


@cache
def traverse() -> Traverse:
    """The second stop's rotation is held, and a pan."""
    t = simulate(mer_navcam(), SMALL, seed=5).traverse
    frames = (*t.frames[:-1], replace(t.frames[-1], sigma_pan_rad=0.0))
    return replace(t, stops=(t.stops[0], replace(t.stops[1], sigma_rotation_rad=0.0)), frames=frames)


@cache
def solved(name: str, method: str) -> Solution:
    return solve(traverse(), ways(name)[method == "alternation"])


# --- the same optimum ---


@pytest.mark.parametrize("name", slow_but_for("axis, focal length", SHARED))
def test_both_ways_lead_to_one_optimum_the_joint_one_sooner(name: str) -> None:
    joint, turns = solved(name, "joint"), solved(name, "alternation")
    assert turns.converged
    assert turns.method == "alternation"
    assert turns.cost_final == pytest.approx(joint.cost_final, rel=1e-8)
    assert turns.iterations > joint.iterations
    assert np.abs(turns.final.pan_tilt_rad - joint.final.pan_tilt_rad).max() < 1e-6
    for a, b in zip(turns.final.world_T_mast, joint.final.world_T_mast, strict=True):
        assert np.abs(a.localCoordinates(b)).max() < 1e-4
    for c, d in zip(turns.refined, joint.refined, strict=True):
        assert c.change == pytest.approx(d.change, abs=0.01 * d.sigma)
        assert c.sigma == pytest.approx(d.sigma, rel=1e-3)
    assert turns.stop_covariance == pytest.approx(joint.stop_covariance, rel=1e-2, abs=1e-9)


@pytest.mark.parametrize("name", slow_but_for(["radius", "axis, focal length"], SHARED))
def test_the_cost_never_rises_and_is_the_true_one(name: str) -> None:
    turns = solved(name, "alternation")
    # Where ties are soft a rigid mast comes first; the change from one to the other is no step.
    begin = 0 if ways(name)[1].firm_tie == "hard" else 4
    assert turns.iterations > begin + 5
    assert all(after <= before for before, after in pairwise(turns.cost_history[begin:]))
    assert turns.cost_final == pytest.approx(turns.cost_history[-1], rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHARED)
def test_without_noise_the_truth_comes_back(name: str) -> None:
    simulation = simulate(mer_navcam(), replace(SMALL, noise_px=0.0, prior="truth"), seed=3)
    telemetry = simulation.telemetry_start
    start = Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)
    solution = solve(simulation.traverse, ways(name, residual_sigmas=1e-9)[1], start=start)
    assert solution.cost_initial > 1e3
    assert solution.stop_reason == "residuals below 1e-09 sigma"
    for found, true in zip(solution.final.world_T_mast, simulation.truth.world_T_mast, strict=True):
        assert np.abs(true.localCoordinates(found)).max() < 1e-8
    assert solution.final.pan_tilt_rad == pytest.approx(simulation.truth.pan_tilt_rad, abs=1e-9)


def test_gains_shrink_as_fast_as_theory_says() -> None:
    """Of one shared number. What a round leaves of its error is 1 - S / H, of the cost the square of that.

    S is its information with all else at its best, H with all else held.
    """
    options = replace(
        SHARED["calibration"],
        sharing=Sharing(calibration=firm("calibration", "all", 1e-4, "focal")),
        loss="none",
        method="alternation",
    )
    adjustment = fitted(traverse(), replace(options, max_iterations=40))
    point = alternation._Point(adjustment.problem, SQUARED)
    panels = point.panels()
    S = whole(panels)[0]
    free = np.setdiff1d(np.arange(len(S) - 1), point.held_columns)
    own = S[-1, -1] - S[-1, free] @ np.linalg.solve(S[np.ix_(free, free)], S[free, -1])
    held = point.system.put_back(panels, point.template.linkage.n_groups - 1)[0]
    rate = (1 - own / held[0, 0]) ** 2
    gains = -np.diff(adjustment.outcome.costs)
    assert 0.5 < rate < 0.99
    assert gains[15:30] / gains[14:29] == pytest.approx(rate, rel=1e-3)


def test_outliers_are_sought_jointly_and_the_same_ones_go() -> None:
    t = simulate(mer_navcam(), replace(SMALL, points_per_image=20, outliers=0.02), seed=1).traverse
    joint, turns = (
        solve(t, replace(options, loss="huber", relative_decrease=1e-7)) for options in ways("radius")
    )
    assert 0 < (~joint.used).sum() < 0.1 * len(joint.used)
    assert turns.reason == joint.reason
    assert turns.cost_final == pytest.approx(joint.cost_final, rel=1e-6)


@pytest.mark.slow
def test_halves_of_the_tracks_are_solved_in_turn_too() -> None:
    found = cross_validate(traverse(), ways("radius")[1], solution=solved("radius", "alternation"))
    expected = cross_validate(traverse(), ways("radius")[0], solution=solved("radius", "joint"))
    assert found.pointing.ratio == pytest.approx(expected.pointing.ratio, rel=1e-2, nan_ok=True)


# --- what is held ---


@pytest.mark.parametrize("name", slow_but_for("radius", ["radius", "calibration", "mounts"]))
def test_what_telemetry_or_the_rig_holds_stays_bit_for_bit(name: str) -> None:
    solution, t = solved(name, "alternation"), traverse()
    assert solution.final.pan_tilt_rad[0, 0] != t.pan_tilt_rad[0, 0]
    assert np.array_equal(
        solution.final.world_T_mast[1].rotation().matrix(), t.stops[1].world_T_mast.rotation().matrix()
    )
    assert solution.final.world_T_mast[1].x() != t.stops[1].world_T_mast.x()
    assert np.array_equal(solution.final.world_T_mast[0].matrix(), t.stops[0].world_T_mast.matrix())
    if name != "radius":  # whose angles are those that its free rotations show
        assert solution.final.pan_tilt_rad[-1, 0] == t.pan_tilt_rad[-1, 0]
    assert {r.entry for r in solution.refined} == {
        "radius": {"radius_m"},
        "calibration": {"fx_px", "fy_px", "cx_px", "cy_px"},
        "mounts": set(ENTRIES["mounts"]),
    }[name]


# --- stalls ---


def refusing(monkeypatch: pytest.MonkeyPatch, which: str, *, times: int) -> list[int]:
    """Make every step of a set look worse for so many tries; returns how many there were."""
    kind = {"regular": alternation._Regular, "shared": alternation._Shared}[which]
    truly: Callable[..., float] = kind.cost_at
    tries = [0]

    def cost_at(self: alternation._Set, posture: Posture, step: FloatArray) -> float:
        tries[0] += 1
        return np.inf if tries[0] <= times else truly(self, posture, step)

    monkeypatch.setattr(kind, "cost_at", cost_at)
    return tries


@pytest.mark.parametrize("name", slow_but_for("radius", ["radius", "calibration"]))
@pytest.mark.parametrize("which", slow_but_for("shared", ["regular", "shared"]))
def test_a_set_that_stalls_rests_and_is_tried_again(
    which: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = refusing(monkeypatch, which, times=5)
    monkeypatch.setattr(alternation, "_MOST", 1e-4)  # it gives up after a few
    turns = solve(traverse(), ways(name)[1])
    assert tries[0] > 5
    assert turns.converged
    assert turns.cost_final == pytest.approx(solved(name, "joint").cost_final, rel=1e-8)


def test_where_what_is_shared_stalls_for_good_the_others_go_to_their_own_optimum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refusing(monkeypatch, "shared", times=10**9)
    turns = solve(traverse(), ways("radius")[1])
    held = solve(traverse(), replace(ways("radius")[0], sharing=Sharing(radius=Freedom())))
    assert turns.converged
    assert turns.stop_reason == "no step lowers the cost"
    assert turns.cost_final == pytest.approx(held.cost_final, rel=1e-9)
    assert all(r.change == 0.0 for r in turns.refined)


def test_where_all_else_stalls_for_good_only_what_is_shared_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    refusing(monkeypatch, "regular", times=10**9)
    turns = solve(traverse(), ways("calibration")[1])
    assert turns.stop_reason == "no step lowers the cost"
    assert np.array_equal(turns.final.pan_tilt_rad, turns.initial.pan_tilt_rad)
    assert any(r.change != 0.0 for r in turns.refined)
    assert turns.cost_final < turns.cost_initial


# --- what ends it ---

BARE = replace(
    SHARED["radius"], loss="none", relative_decrease=0.0, residual_sigmas=0.0, method="alternation"
)
CRITERIA: dict[str, tuple[dict[str, float], str]] = {
    "residuals": ({"residual_sigmas": 1.6}, "residuals below 1.6 sigma"),
    "gradient": ({"max_gradient": 1e3}, "gradient below 1000"),
    "step": ({"relative_step": 1e-4}, "relative step below 0.0001"),
    "decrease": ({"relative_decrease": 1e-6}, "relative decrease below 1e-06"),
}


@cache
def ended(options: SolveOptions) -> Fitted:
    return fitted(traverse(), options)


@pytest.mark.parametrize("name", slow_but_for("gradient", CRITERIA))
def test_each_criterion_alone_ends_it_and_says_so(name: str) -> None:
    criterion, reason = CRITERIA[name]
    outcome = ended(replace(BARE, **criterion)).outcome  # type: ignore[arg-type]  # options by name
    assert outcome.converged
    assert outcome.reason == reason
    assert len(outcome.costs) < len(ended(BARE).outcome.costs)


def test_without_a_criterion_only_the_lack_of_a_better_step_ends_it() -> None:
    outcome = ended(BARE).outcome
    assert outcome.converged
    assert outcome.reason == "no step lowers the cost"
    assert outcome.costs[-1] == pytest.approx(solved("radius", "joint").cost_final, rel=1e-11)


def test_what_is_left_to_gain_where_the_decrease_ends_it_is_no_more_than_it_says() -> None:
    """Though a round gains a small part of that alone."""
    options = replace(SHARED["mounts"], loss="none", method="alternation", max_iterations=1000)
    turns = solve(traverse(), options)
    assert turns.stop_reason == "relative decrease below 1e-07"
    assert turns.cost_final <= solved("mounts", "joint").cost_final * (1 + 1.1e-7)


def test_the_limit_counts_rounds_and_is_not_convergence() -> None:
    outcome = ended(replace(BARE, max_iterations=3)).outcome
    assert not outcome.converged
    assert outcome.reason == "iteration limit of 3"
    assert outcome.costs[-4:] == ended(BARE).outcome.costs[: len(outcome.costs)][-4:]


# --- what is refused ---


def test_explicit_landmarks_are_refused() -> None:
    with pytest.raises(
        InputError, match=r"^method: expected joint with explicit landmarks, found alternation"
    ):
        SolveOptions(method="alternation", landmarks="explicit")


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(InputError, match=r"^method: expected one of joint, alternation; found 'both'$"):
        SolveOptions(method="both")  # type: ignore[arg-type]  # the mistake under test


@pytest.mark.parametrize(
    "options",
    [
        SolveOptions(rig="held"),
        SolveOptions(model="free", rig="held"),
        SolveOptions(model="projective"),
        SolveOptions(sharing=Sharing(calibration=firm("calibration", "stop", 0.1))),
        SolveOptions(model="circle", sharing=Sharing(radius=Freedom())),
    ],
)
def test_where_nothing_is_shared_there_is_nothing_to_take_turns(options: SolveOptions) -> None:
    text = rf"method: expected joint with the model {options.model} as it is, found alternation: nothing is"
    with pytest.raises(InputError, match=text) as caught:
        solve(traverse(), replace(options, method="alternation"))
    assert "\n" not in str(caught.value)
