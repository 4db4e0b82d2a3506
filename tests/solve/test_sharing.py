"""What of a rig is free: choices and their refusals, exact and honest solves, what nothing holds."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pancam_graph import (
    Freedom,
    Sharing,
    SimulationOptions,
    Solution,
    SolveOptions,
    Traverse,
    find_observations,
    read_pds,
    simulate,
    solve,
)
from pancam_graph.base.errors import InputError
from pancam_graph.cameras import CAHVOR, Brown
from pancam_graph.data import ENTRIES, Quantity, default_sigma
from pancam_graph.data._sharing import Scope, parse_sharing
from pancam_graph.graph import ExplicitLandmarks, Flex, Model, SoftTemplate, Tie
from pancam_graph.initialise import Start
from pancam_graph.rigs import Eye, Rig, exomars_pancam, mer_navcam
from pancam_graph.simulate import Simulation
from support.solving import fitted, solution_from

FOCAL = ("focal",)
WRONG = {"focal_error": 3e-3, "mount_error_rad": 2e-3, "mount_error_m": 2e-3}
TWO_TILTS = SimulationOptions(stops=2, pans=4, sweep_rad=2.0, tilts_rad=(-0.1, -0.5), points_per_image=20)
NEAR_M = 20.0


def loose(quantity: Quantity, scope: Scope, *entries: str) -> Freedom:
    """Free, and held by no prior."""
    free = entries or ENTRIES[quantity]
    return Freedom(scope=scope, free=free, sigma=dict.fromkeys(free, np.inf))


def start_of(simulation: Simulation) -> Start:
    telemetry = simulation.telemetry_start
    return Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)


# --- choices ---


WITHOUT: list[tuple[Quantity, Model]] = [
    ("radius", "mast"),
    ("radius", "free"),
    ("mounts", "free"),
    ("mounts", "circle"),
    ("pan_T_tilt", "free"),
    ("pan_T_tilt", "circle"),
]
"""Quantities that a model does not have."""


def shared_by_stop(quantity: Quantity, model: Model) -> SolveOptions:
    sharing: dict[str, Any] = {quantity: Freedom(scope="stop")}
    return SolveOptions(model=model, sharing=Sharing(**sharing))


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "scope": (lambda: Sharing(calibration=Freedom(scope="each")), r"calibration: scope: .*found 'each'"),  # type: ignore[arg-type]  # the mistake under test
    "mounts all": (
        lambda: Sharing(mounts=Freedom(scope="all")),
        r"mounts: scope: .*each eye has its own mount",
    ),
    "axis per eye": (lambda: Sharing(pan_T_tilt=Freedom(scope="eye")), r"pan_T_tilt: scope: .*one tilt axis"),
    "fixed and free": (
        lambda: Sharing(calibration=Freedom(free=("fx_px",))),
        r"calibration: expected a scope other than fixed .*found fixed with fx_px",
    ),
    "fixed with a sigma": (
        lambda: Sharing(radius=Freedom(sigma={"radius_m": 1.0})),
        r"found fixed with radius_m",
    ),
    "unknown entry": (
        lambda: Sharing(calibration=Freedom(scope="eye", free=("fx",))),
        r"calibration: free: expected entries of focal, fx_px, fy_px, skew_px, cx_px, cy_px; found 'fx'",
    ),
    "entry of another": (lambda: Sharing(mounts=Freedom(scope="eye", free=("focal",))), r"found 'focal'"),
    "entry twice": (lambda: Sharing(mounts=Freedom(scope="eye", free=("x_m", "x_m"))), r"found x_m twice"),
    "no entry": (
        lambda: Sharing(mounts=Freedom(scope="eye", free=())),
        r"expected one entry or more, found none",
    ),
    "focal twice": (
        lambda: Sharing(calibration=Freedom(scope="all", free=("fy_px", "focal"))),
        r"either focal or fx_px and fy_px, found both",
    ),
    "sigma of what is held": (
        lambda: Sharing(mounts=Freedom(scope="eye", free=("x_m",), sigma={"y_m": 1.0})),
        r"sigma: expected free entries \(x_m\), found y_m, which is held",
    ),
    "unknown sigma": (lambda: Sharing(mounts=Freedom(scope="eye", sigma={"y": 1.0})), r"sigma: .*found 'y'"),
    "sigma 0": (
        lambda: Sharing(mounts=Freedom(scope="eye", sigma={"y_m": 0.0})),
        r"y_m: expected a number above 0, found 0.0",
    ),
    "sigma not a number": (lambda: Sharing(mounts=Freedom(scope="eye", sigma={"y_m": np.nan})), r"found nan"),
    **{
        f"{quantity} with {model}": (
            partial(shared_by_stop, quantity, model),
            rf"sharing: {quantity}: expected fixed with the model {model}, whose .*; found stop",
        )
        for quantity, model in WITHOUT
    },
    "word": (lambda: parse_sharing(["calibration"]), r"expected QUANTITY=SCOPE .*found 'calibration'"),
    "unknown quantity": (
        lambda: parse_sharing(["focal=eye"]),
        r"one of calibration, mounts, .*found 'focal=eye'",
    ),
    "quantity twice": (lambda: parse_sharing(["mounts=eye", "mounts=stop"]), r"found mounts twice"),
    "scope of a word": (
        lambda: parse_sharing(["mounts=eyes"]),
        r"mounts=eyes: expected one of .*found 'eyes'",
    ),
    "number of a word": (lambda: parse_sharing(["mounts=eye:x_m~wide"]), r"after x_m~, found 'wide'"),
    "nothing after the colon": (lambda: parse_sharing(["mounts=eye:"]), r"found ''"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_means_nothing_is_refused_in_one_sentence(case: str) -> None:
    make, text = REFUSED[case]
    with pytest.raises(InputError, match=text) as caught:
        make()
    assert str(caught.value).startswith("sharing: ")
    assert "\n" not in str(caught.value)


def test_words_of_a_command_line() -> None:
    found = parse_sharing(["calibration=eye:cx_px,fx_px~2.5", "mounts=stop", "radius=fixed"])
    assert found == Sharing(
        calibration=Freedom(scope="eye", free=("cx_px", "fx_px"), sigma={"fx_px": 2.5}),
        mounts=Freedom(scope="stop"),
        radius=Freedom(),
    )
    assert parse_sharing([]) is None
    assert parse_sharing([], found) == found
    again = parse_sharing(["mounts=eye:x_m~inf"], found)
    assert again == replace(found, mounts=Freedom(scope="eye", free=("x_m",), sigma={"x_m": np.inf}))


def freedoms(quantity: Quantity) -> st.SearchStrategy[Freedom]:
    entries = st.lists(st.sampled_from(ENTRIES[quantity]), min_size=1, unique=True)
    number = st.floats(1e-300, 1e300) | st.just(np.inf)
    return entries.flatmap(
        lambda free: st.dictionaries(st.sampled_from(free), number).map(
            lambda sigma: Freedom(scope="stop", free=tuple(free), sigma=sigma)
        )
    )


@settings(max_examples=50, derandomize=True, database=None, deadline=None)
@given(freedoms("mounts"))
def test_any_freedom_can_be_said_in_a_word(freedom: Freedom) -> None:
    assert freedom.free is not None
    names = [f"{e}~{freedom.sigma[e]!r}" if e in freedom.sigma else e for e in freedom.free]
    assert parse_sharing([f"mounts=stop:{','.join(names)}"]) == Sharing(mounts=freedom)


def test_each_model_has_its_own_default() -> None:
    assert not Sharing().for_model("mast").any_free
    assert not Sharing().for_model("free").any_free
    assert Sharing().for_model("circle").radius == Freedom(scope="eye")
    assert not Sharing(radius=Freedom()).for_model("circle").any_free


def test_options_go_before_the_traverse_and_the_traverse_before_the_default() -> None:
    t = replace(simulated().traverse, sharing=Sharing(mounts=Freedom(scope="eye", free=("x_m",))))
    assert {r.quantity for r in solve(t).refined} == {"mounts"}
    other = Sharing(calibration=Freedom(scope="all", free=FOCAL))
    assert {r.quantity for r in solve(t, SolveOptions(sharing=other)).refined} == {"calibration"}
    assert solve(t, SolveOptions(sharing=Sharing())).refined == ()
    with pytest.raises(InputError, match="mounts: expected fixed with the model free"):
        solve(t, SolveOptions(model="free"))


def test_priors_are_those_given_or_the_default() -> None:
    calibration = Freedom(
        scope="eye", free=("fx_px", "fy_px", "skew_px"), sigma={"fy_px": 0.5, "skew_px": np.inf}
    )
    found = solve(
        simulated().traverse, SolveOptions(loss="none", sharing=Sharing(calibration=calibration))
    ).refined
    focal = simulated().traverse.rig.pinholes[0].fx_px
    assert [r.entry for r in found] == 2 * ["fx_px", "fy_px", "skew_px"]
    assert [r.camera for r in found] == 3 * ["left"] + 3 * ["right"]
    assert [r.prior_sigma for r in found[:3]] == [default_sigma("fx_px", focal), 0.5, np.inf]
    assert found[0].prior_sigma == pytest.approx(3e-3 * focal)
    for r in found:
        assert r.sigma < r.prior_sigma


# --- exact, and bit for bit ---


@cache
def simulated(seed: int = 2, **changes: Any) -> Simulation:
    return simulate(mer_navcam(), replace(TWO_TILTS, **changes), seed=seed)


EXACT: dict[str, tuple[Model, dict[str, float], Sharing]] = {
    **{
        f"calibration and mounts per {scope}": (
            "mast",
            WRONG,
            Sharing(calibration=loose("calibration", scope, *FOCAL), mounts=loose("mounts", scope)),
        )
        for scope in ("eye", "stop")
    },
    "focal and mounts' turns per image": (
        "mast",
        {"focal_error": 3e-3, "mount_error_rad": 2e-3},
        Sharing(
            calibration=loose("calibration", "image", *FOCAL),
            mounts=loose("mounts", "image", "rx_rad", "ry_rad", "rz_rad"),
        ),
    ),
    **{
        f"calibration of {scope}": ("mast", {}, Sharing(calibration=loose("calibration", scope)))
        for scope in ("all", "eye", "stop", "image")
    },
    "axis of all": ("mast", {}, Sharing(pan_T_tilt=loose("pan_T_tilt", "all"))),
    "axis per stop": ("mast", {}, Sharing(pan_T_tilt=loose("pan_T_tilt", "stop", "rx_rad", "x_m", "y_m"))),
    **{
        f"focal per {scope}, {model}": (
            model,
            {"focal_error": 3e-3},
            Sharing(calibration=loose("calibration", scope, *FOCAL)),
        )
        for scope in ("eye", "stop", "image")
        for model in ("circle", "free")
    },
    **{
        f"radius per {scope}": ("circle", {"radius_error_m": 3e-3}, Sharing(radius=loose("radius", scope)))
        for scope in ("eye", "stop", "image")
    },
}


def assert_rigs_agree(found: Rig, true: Rig, tolerance: float) -> None:
    for a, b in zip(found.eyes, true.eyes, strict=True):
        assert np.abs(a.head_T_camera.localCoordinates(b.head_T_camera)).max() < tolerance
        difference = a.camera.pinhole.calibration_matrix - b.camera.pinhole.calibration_matrix
        assert np.abs(difference).max() < 1e3 * tolerance
    assert np.abs(found.pan_T_tilt.localCoordinates(true.pan_T_tilt)).max() < tolerance


@pytest.mark.parametrize(
    ("name", "tie"),
    [(name, tie) for name in EXACT for tie in ("soft", "hard")[: 1 + (EXACT[name][0] == "mast")]],
)
def test_without_noise_the_true_rig_comes_back(name: str, tie: Tie) -> None:
    """From a wrong rig and telemetry. Priors of telemetry are centred on the truth; the rig has none."""
    model, wrong, sharing = EXACT[name]
    tilts = (-0.3,) if "radius" in name else TWO_TILTS.tilts_rad  # an error of radius is one at one tilt
    simulation = simulated(1, noise_px=0.0, prior="truth", tilts_rad=tilts, **wrong)
    options = SolveOptions(
        loss="none",
        model=model,
        tie=tie,
        sharing=sharing,
        relative_decrease=1e-12,
    )
    solution = solve(simulation.traverse, options, start=start_of(simulation))
    assert solution.converged
    assert solution.cost_initial > 1e3
    assert solution.cost_final < 1e-9
    assert solution.final.pan_tilt_rad == pytest.approx(simulation.truth.pan_tilt_rad, abs=1e-8)
    for found, true in zip(solution.final.world_T_mast, simulation.truth.world_T_mast, strict=True):
        assert np.abs(true.localCoordinates(found)).max() < 1e-7
    if "radius" in name:
        t, rig = simulation.traverse, simulation.truth.rig
        for r in solution.refined:
            eye = rig.eye_index(r.camera or "")
            true_m = rig.circle(eye, -0.3)[0] - t.rig.circle(eye, -0.3)[0]
            assert abs(true_m) > 1e-5
            assert r.change == pytest.approx(true_m, abs=1e-8)
    elif "per" not in name or "per eye" in name:
        assert_rigs_agree(solution.rig, simulation.truth.rig, 1e-7)
    else:
        correction = solution.final.rig
        assert correction is not None
        focal_px = [p.fx_px for p in simulation.truth.rig.pinholes]
        claimed = [p.fx_px for p in simulation.traverse.rig.pinholes]
        change = np.subtract(focal_px, claimed)[simulation.traverse.image_eye]
        assert correction.calibration_px[:, 0] == pytest.approx(change, abs=1e-4)


def equal_bits(a: Solution, b: Solution) -> bool:
    masts = zip(a.final.world_T_mast, b.final.world_T_mast, strict=True)
    return (
        a.cost_history == b.cost_history
        and all(np.array_equal(p.matrix(), q.matrix()) for p, q in masts)
        and np.array_equal(a.final.pan_tilt_rad, b.final.pan_tilt_rad)
        and np.array_equal(a.final.landmarks_m, b.final.landmarks_m, equal_nan=True)
        and np.array_equal(a.stop_covariance, b.stop_covariance)
        and a.warnings == b.warnings
    )


@pytest.mark.parametrize("model", ["mast", "circle", "free"])
def test_saying_the_default_changes_no_bit(model: str) -> None:
    t = simulated().traverse
    plain = solve(t, SolveOptions(model=model))  # type: ignore[arg-type]  # parametrised
    said = solve(t, SolveOptions(model=model, sharing=parse_sharing(["calibration=fixed", "mounts=fixed"])))  # type: ignore[arg-type]  # parametrised
    assert equal_bits(plain, replace(said, warnings=plain.warnings))
    assert (plain.final.rig is None) == (model != "circle")
    assert plain.rig.eyes == t.rig.eyes
    assert [r.entry for r in plain.refined] == (["radius_m", "radius_m"] if model == "circle" else [])


@pytest.mark.parametrize("tie", ["hard", "soft"])
def test_what_is_held_stays_bit_for_bit(tie: str) -> None:
    sharing = Sharing(
        calibration=Freedom(scope="eye", free=("fx_px", "fy_px")),
        mounts=Freedom(scope="eye", free=("rx_rad", "ry_rad", "rz_rad")),
        pan_T_tilt=Freedom(scope="all", free=("x_m",)),
    )
    t = simulated(**WRONG).traverse
    solution = solve(t, SolveOptions(loss="none", tie=tie, sharing=sharing))  # type: ignore[arg-type]  # parametrised
    for found, given_ in zip(solution.rig.eyes, t.rig.eyes, strict=True):
        before, after = given_.camera.pinhole, found.camera.pinhole
        assert (after.cx_px, after.cy_px, after.skew_px) == (before.cx_px, before.cy_px, before.skew_px)
        assert after.fx_px != before.fx_px
        assert np.array_equal(found.head_T_camera.translation(), given_.head_T_camera.translation())
        assert not np.array_equal(
            found.head_T_camera.rotation().matrix(), given_.head_T_camera.rotation().matrix()
        )
    axis = solution.rig.pan_T_tilt
    assert np.array_equal(axis.rotation().matrix(), t.rig.pan_T_tilt.rotation().matrix())
    assert axis.translation()[1:].tolist() == t.rig.pan_T_tilt.translation()[1:].tolist()
    assert axis.translation()[0] != t.rig.pan_T_tilt.translation()[0]
    assert solution.final.rig is not None
    assert not solution.final.rig.calibration_px[:, 2:].any()
    assert not solution.final.rig.mount[:, 3:].any()


def test_a_fixed_radius_is_the_rigs() -> None:
    t = simulated().traverse
    free, fixed = (
        solve(t, SolveOptions(model="circle", loss="none", sharing=Sharing(radius=radius)))
        for radius in (None, Freedom())
    )
    assert fixed.refined == ()
    assert fixed.cost_final > free.cost_final


# --- distorted cameras ---


def distorted() -> Rig:
    """One eye of each distorted kind, both with ten times a rover's distortion."""
    base = mer_navcam()
    left, right = base.eyes
    k = right.camera.pinhole.calibration_matrix
    bent = CAHVOR(
        width_px=1024,
        height_px=1024,
        C=np.zeros(3),
        A=np.array([0.0, 0.0, 1.0]),
        H=k[0],
        V=k[1],
        O=np.array([0.01, -0.02, 1.0]) / np.linalg.norm([0.01, -0.02, 1.0]),
        R=np.array([1e-3, 0.15, -0.05]),
    )
    p = left.camera.pinhole
    numbers = {"fx_px": p.fx_px, "fy_px": p.fy_px, "cx_px": p.cx_px, "cy_px": p.cy_px}
    brown = Brown(width_px=1024, height_px=1024, **numbers, distortion=(-0.15, 0.05, 1e-3, -2e-3, 0.01))
    eyes = [
        Eye(name="left", camera=brown, head_T_camera=left.head_T_camera),
        Eye(name="right", camera=bent, head_T_camera=right.head_T_camera),
    ]
    return Rig(name="distorted", pan_T_tilt=base.pan_T_tilt, eyes=tuple(eyes))


@pytest.mark.parametrize("scope", ["eye", "stop"])
def test_a_distorted_camera_is_carried_anew_as_its_calibration_moves(scope: Scope) -> None:
    options = replace(TWO_TILTS, noise_px=0.0, prior="truth", focal_error=3e-3)
    simulation = simulate(distorted(), options, seed=1)
    sharing = Sharing(calibration=loose("calibration", scope, "fx_px", "fy_px", "cx_px", "cy_px"))
    solution = solve(
        simulation.traverse,
        SolveOptions(loss="none", sharing=sharing, relative_decrease=1e-12),
        start=start_of(simulation),
    )
    assert solution.converged
    assert solution.rms_initial_px > 1.0
    assert solution.rms_final_px < 1e-6
    assert solution.final.pan_tilt_rad == pytest.approx(simulation.truth.pan_tilt_rad, abs=1e-8)
    true = [p.fx_px for p in simulation.truth.rig.pinholes]
    for r in solution.refined:
        if r.entry == "fx_px":
            assert r.nominal is not None
            assert r.nominal + r.change == pytest.approx(
                true[simulation.truth.rig.eye_index(r.camera or "")], abs=1e-5
            )
    if scope == "eye":
        assert_rigs_agree(solution.rig, simulation.truth.rig, 1e-7)
        assert [type(e.camera) for e in solution.rig.eyes] == [Brown, CAHVOR]


# --- the same as explicit landmarks, and as GTSAM's marginals ---

FIRM = Flex(rotation_rad=1e-4, translation_m=1e-3)
COMPARED: dict[str, tuple[str, Flex | None, Sharing]] = {
    "mounts": ("mast", FIRM, Sharing(mounts=Freedom(scope="eye"))),
    "mounts per stop and axis": (
        "mast",
        FIRM,
        Sharing(mounts=Freedom(scope="stop"), pan_T_tilt=Freedom(scope="all")),
    ),
    "all but focal": (
        "mast",
        FIRM,
        Sharing(calibration=Freedom(scope="eye", free=("cx_px", "skew_px")), mounts=Freedom(scope="eye")),
    ),
    "calibration of all": ("mast", FIRM, Sharing(calibration=Freedom(scope="all", free=("focal", "cx_px")))),
    "calibration per stop": ("mast", FIRM, Sharing(calibration=Freedom(scope="stop"))),
    "focal per image": ("mast", FIRM, Sharing(calibration=loose("calibration", "image", *FOCAL))),
    "calibration, circle": ("circle", None, Sharing(calibration=Freedom(scope="eye"))),
    "radius per stop": ("circle", None, Sharing(radius=Freedom(scope="stop"))),
    "calibration, free": ("free", None, Sharing(calibration=Freedom(scope="eye"))),
}


@cache
def near() -> Traverse:
    """A wrong rig; without landmarks that are too far for GTSAM's Cholesky of explicit ones."""
    simulation = simulated(2, points_per_image=15, **WRONG)
    t = simulation.traverse
    assert t.observations is not None
    distance = np.linalg.norm(simulation.truth.landmarks_m, axis=1)
    return t.with_observations(t.observations.select((distance < NEAR_M)[t.observations.track]))


def options_of(name: str, **changes: Any) -> SolveOptions:
    model, flex, sharing = COMPARED[name]
    given_ = {"model": model, "tie": "soft", "flex": flex, "sharing": sharing, "loss": "none"}
    return SolveOptions(**given_ | {"relative_decrease": 1e-12} | changes)


@pytest.mark.parametrize("name", COMPARED)
def test_landmarks_eliminated_or_explicit_give_one_optimum(name: str) -> None:
    ours, theirs = (solve(near(), options_of(name, landmarks=way)) for way in ("eliminated", "explicit"))
    assert ours.converged
    assert theirs.converged
    assert ours.cost_final == pytest.approx(theirs.cost_final, rel=1e-8)
    for a, b in zip(ours.refined, theirs.refined, strict=True):
        assert (a.quantity, a.entry, a.camera, a.stop, a.image) == (
            b.quantity,
            b.entry,
            b.camera,
            b.stop,
            b.image,
        )
        assert a.change == pytest.approx(b.change, abs=1e-3 * a.sigma)
        assert a.sigma == pytest.approx(b.sigma, rel=1e-5)
    assert max(abs(a.change) / a.sigma for a in ours.refined) > 1  # or else nothing was compared


def test_a_hard_tie_has_the_explicit_optimum_too() -> None:
    sharing = Sharing(
        calibration=Freedom(scope="eye"), mounts=Freedom(scope="eye"), pan_T_tilt=Freedom(scope="all")
    )
    ours, theirs = (
        solve(near(), SolveOptions(loss="none", landmarks=way, sharing=sharing, relative_decrease=1e-12))
        for way in ("eliminated", "explicit")
    )
    assert ours.cost_final == pytest.approx(theirs.cost_final, rel=1e-6)
    for a, b in zip(ours.refined, theirs.refined, strict=True):
        assert a.change == pytest.approx(b.change, abs=0.01 * a.sigma)
        assert a.sigma == pytest.approx(b.sigma, rel=1e-3)


@pytest.mark.parametrize("name", ["mounts per stop and axis", "calibration, circle", "calibration, free"])
def test_sigmas_are_gtsams(name: str) -> None:
    adjustment = fitted(near(), options_of(name))
    problem, solution = adjustment.problem, solution_from(adjustment)
    assert isinstance(problem.template, SoftTemplate)
    explicit = ExplicitLandmarks(problem.template, problem.measurements)
    graph = explicit.calibrations.in_place(problem.factors.graph)
    graph.push_back(explicit.factors(problem.kept))
    marginals = gtsam.Marginals(
        graph, explicit.with_landmarks(problem.values, problem.points_m(), problem.present)
    )
    expected = []
    for v in problem.template.rig_variables.variables:
        key = v.key
        if v.quantity == "calibration":  # all five are free: GTSAM's own variable has the same columns
            key = explicit.calibrations.key(v.first)
        expected += np.sqrt(np.diag(marginals.marginalCovariance(key))).tolist()
    assert [r.sigma for r in solution.refined] == pytest.approx(expected, rel=1e-5)
    sigma = np.sqrt(np.diag(marginals.marginalCovariance(gtsam.symbol("M", 1))))
    assert np.sqrt(np.diag(solution.stop_covariance[1])) == pytest.approx(sigma, rel=1e-5)


def test_pointing_is_less_sure_where_the_rig_is() -> None:
    t, mounts = near(), Sharing(mounts=Freedom(scope="eye"))
    fixed, free = (solve(t, SolveOptions(loss="none", sharing=s)) for s in (None, mounts))
    assert np.all(free.angle_sigma_rad[:, 1] > 1.2 * fixed.angle_sigma_rad[:, 1])


# --- honest ---

DRAWN = {"focal_error": 3e-3, "mount_error_rad": 5e-3, "mount_error_m": 2e-3}
"""The errors that default priors expect."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "wrong", "sharing"),
    [
        ("mast", DRAWN, Sharing(calibration=Freedom(scope="eye", free=FOCAL), mounts=Freedom(scope="eye"))),
        ("mast", {"focal_error": 3e-3}, Sharing(calibration=Freedom(scope="eye", free=FOCAL))),
        ("free", {"focal_error": 3e-3}, Sharing(calibration=Freedom(scope="eye", free=FOCAL))),
    ],
    ids=["focal and mounts", "focal", "focal, free"],
)
def test_errors_have_the_variance_that_their_sigmas_say(
    model: str, wrong: dict[str, float], sharing: Sharing
) -> None:
    """Sixty seeds, rigs drawn from the priors; intervals of 95 % from the spread between seeds.

    It does not show that the covariance is right in every direction, only in the mean over each kind.
    """
    angles, rigs, stops, focal = [], [], [], []
    for seed in range(60):
        simulation = simulated.__wrapped__(seed, **wrong)
        t, truth = simulation.traverse, simulation.truth
        solution = solve(t, SolveOptions(loss="none", model=model, sharing=sharing))  # type: ignore[arg-type]  # parametrised
        assert solution.converged
        error = solution.final.pan_tilt_rad - truth.pan_tilt_rad
        angles.append(np.mean((error / solution.angle_sigma_rad) ** 2))
        shift = truth.world_T_mast[1].localCoordinates(solution.final.world_T_mast[1])
        stops.append(shift @ np.linalg.solve(solution.stop_covariance[1], shift) / 6)
        off = []
        for r in solution.refined:
            eye = t.rig.eye_index(r.camera or "")
            given_, true = t.rig.eyes[eye], truth.rig.eyes[eye]
            change = true.camera.pinhole.fx_px / given_.camera.pinhole.fx_px - 1
            if r.entry == "focal":
                focal.append((r.change - change) / r.sigma)
            else:
                between = given_.head_T_camera.between(true.head_T_camera)
                correction = [*gtsam.Rot3.Logmap(between.rotation()), *between.translation()]
                change = correction[ENTRIES["mounts"].index(r.entry)]
            off.append(((r.change - change) / r.sigma) ** 2)
        rigs.append(np.mean(off))
    # Ties of the free model allow a flex that the simulated mast does not have: it is surer than it says.
    for found in (rigs,) if model == "free" else (angles, rigs, stops):
        assert abs(np.mean(found) - 1) < 1.96 * np.std(found) / np.sqrt(len(found)) + 0.02
    assert abs(np.mean(focal)) < 2.6 * np.std(focal) / np.sqrt(len(focal))


def test_a_wrong_rig_is_no_reason_to_reject() -> None:
    """At the start residuals are 6 px, of mounts that are as wrong as their priors say."""
    simulation = simulated(4, outliers=0.03, min_views=3, **DRAWN)
    sharing = Sharing(calibration=Freedom(scope="eye", free=FOCAL), mounts=Freedom(scope="eye"))
    solution = solve(simulation.traverse, SolveOptions(sharing=sharing))
    outlier = simulation.truth.outlier
    assert solution.rms_initial_px > 2
    assert (~outlier & solution.used).sum() >= 0.99 * (~outlier).sum()
    assert (outlier & ~solution.used).sum() >= 0.97 * outlier.sum()


# --- what nothing holds, or telemetry alone ---


def unseen(solution: Solution) -> str:
    return next((w for w in solution.warnings if "next to nothing" in w), "")


def test_what_images_do_not_tell_is_named() -> None:
    """A turn of both mounts about the tilt axis is a change of all tilts; its lift is the mast's."""
    t = simulated().traverse
    mounts = solve(t, SolveOptions(loss="none", sharing=Sharing(mounts=Freedom(scope="eye"))))
    assert "rx_rad" in unseen(mounts)
    assert "mounts left" in unseen(mounts)
    assert "mounts right" in unseen(mounts)
    by_name = {(r.camera, r.entry): r for r in mounts.refined}
    # Telemetry of 16 frames knows their mean tilt to a quarter of what it knows of each: no better the turn.
    assert 1.34e-3 / 4 < by_name["left", "rx_rad"].sigma < 1.3 * 1.34e-3 / 4
    axis = solve(
        t, SolveOptions(loss="none", sharing=Sharing(pan_T_tilt=Freedom(scope="all", free=("z_m", "ry_rad"))))
    )
    assert unseen(axis).startswith("images say next to nothing of 2 directions (")
    lift = next(r for r in axis.refined if r.entry == "z_m")
    assert lift.sigma == pytest.approx(lift.prior_sigma, rel=1e-3)


def test_what_images_do_tell_is_not_named() -> None:
    sharing = Sharing(calibration=Freedom(scope="eye", free=FOCAL))
    assert unseen(solve(simulated().traverse, SolveOptions(loss="none", sharing=sharing))) == ""


def test_what_nothing_holds_is_named_however_it_comes_out() -> None:
    """At the one stop, which is held, a lift of the tilt axis lifts the cameras with all they see.

    What is left of such a direction is rounding, which may pass for a little information.
    """
    t = simulated(2, stops=1).traverse
    solution = solve(
        t, SolveOptions(loss="none", sharing=Sharing(pan_T_tilt=loose("pan_T_tilt", "all", "z_m")))
    )
    assert len([w for w in solution.warnings if "pan_T_tilt z_m" in w]) == 1
    assert not solution.refined[0].sigma < 1.0


def test_where_nothing_holds_an_entry_there_are_no_uncertainties_and_it_is_named() -> None:
    t = simulated(2, stops=1).traverse
    assert t.observations is not None
    blind = 3
    seen = t.with_observations(t.observations.select(t.observations.image != blind))
    sharing = Sharing(calibration=loose("calibration", "image", *FOCAL))
    solution = solve(seen, SolveOptions(loss="none", sharing=sharing))
    [warning] = [w for w in solution.warnings if w.startswith("no uncertainties")]
    assert f"nothing holds calibration {t.images[blind].id} focal of the rig" in warning
    assert np.isnan([r.sigma for r in solution.refined]).all()
    assert np.isfinite([r.change for r in solution.refined]).all()
    assert solution.refined[blind].change == 0


def test_eyes_without_images_have_no_variables() -> None:
    simulation = simulate(exomars_pancam(), replace(TWO_TILTS, stops=1, tilts_rad=(-0.2,)), seed=0)
    t = simulation.traverse
    assert t.observations is not None
    kept = np.flatnonzero(t.image_eye != t.rig.eye_index("hrc"))
    row = np.full(len(t.images), -1)
    row[kept] = np.arange(len(kept))
    obs = t.observations.select(row[t.observations.image] >= 0)
    without = replace(
        t, images=tuple(t.images[i] for i in kept), observations=replace(obs, image=row[obs.image])
    )
    sharing = Sharing(calibration=Freedom(scope="eye", free=FOCAL))
    solution = solve(without, SolveOptions(loss="none", sharing=sharing))
    assert [r.camera for r in solution.refined] == ["wac-left", "wac-right"]
    assert solution.rig.eyes[2] == t.rig.eyes[2]


def test_eyes_may_share_a_correction_though_their_numbers_differ() -> None:
    rig = exomars_pancam()
    simulation = simulate(rig, replace(TWO_TILTS, stops=1, tilts_rad=(-0.2,)), seed=0)
    sharing = Sharing(calibration=Freedom(scope="all", free=("focal", "cx_px")))
    assert len({p.fx_px for p in rig.pinholes}) > len({p.cx_px for p in rig.pinholes}) == 1
    solution = solve(simulation.traverse, SolveOptions(loss="none", sharing=sharing))
    focal, column = solution.refined
    assert (focal.nominal, column.nominal) == (1.0, rig.pinholes[0].cx_px)
    for found, given_ in zip(solution.rig.pinholes, rig.pinholes, strict=True):
        assert found.fx_px / given_.fx_px == pytest.approx(1 + focal.change, rel=1e-12)
        assert found.fy_px / given_.fy_px == pytest.approx(1 + focal.change, rel=1e-12)
        assert found.cx_px - given_.cx_px == pytest.approx(column.change, abs=1e-9)
    common = Sharing(calibration=Freedom(scope="all", free=("fx_px",)))
    assert solve(simulation.traverse, SolveOptions(loss="none", sharing=common)).refined[0].nominal is None


# --- real ---


@pytest.mark.slow
def test_a_free_focal_length_of_opportunity(request: pytest.FixtureRequest) -> None:
    """Over the same observations, weighted alike, it fits better; by half a per cent it is not wrong."""
    matched = find_observations(read_pds(request.getfixturevalue("opportunity_folder")))
    first = solve(matched)
    assert matched.observations is not None
    kept = replace(
        matched.observations.select(first.used), origin="given", sigma_px=first.sigma_px[first.used]
    )
    t = matched.with_observations(kept)
    sharing = Sharing(calibration=Freedom(scope="eye", free=FOCAL))
    for model in ("mast", "circle", "free"):
        fixed, free = (solve(t, SolveOptions(model=model, loss="none", sharing=s)) for s in (None, sharing))
        assert free.converged
        assert free.cost_final < fixed.cost_final
        focal = free.refined[0]
        assert abs(focal.change) < 5e-3
        assert focal.sigma < 6e-4
