"""What of a rig is free: exact solves, held entries bit for bit, explicit landmarks and GTSAM's marginals."""

from dataclasses import replace
from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph import (
    Freedom,
    Sharing,
    Solution,
    SolveOptions,
    Traverse,
    simulate,
    solve,
)
from pancam_graph.cameras import CAHVOR, Brown
from pancam_graph.data._sharing import FIXED, Scope, parse_sharing
from pancam_graph.graph import ExplicitLandmarks, Flex, Model, SoftTemplate, Tie
from pancam_graph.rigs import Eye, Rig, mer_navcam
from support.parameters import slow_but_for
from support.shared_rigs import FOCAL, TWO_TILTS, WRONG, loose, simulated, start_of
from support.solving import fitted, solution_from

NEAR_M = 20.0


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


QUICK = [
    ("calibration and mounts per eye", "hard"),
    ("calibration and mounts per stop", "hard"),
    ("focal and mounts' turns per image", "hard"),
    ("calibration of all", "soft"),
    ("axis of all", "soft"),
    ("axis per stop", "hard"),
    ("focal per image, circle", "soft"),
    ("focal per stop, free", "soft"),
    ("radius per eye", "soft"),
]
"""Each quantity, scope, model and tie at least once."""


def assert_rigs_agree(found: Rig, true: Rig, tolerance: float) -> None:
    for a, b in zip(found.eyes, true.eyes, strict=True):
        assert np.abs(a.head_T_camera.localCoordinates(b.head_T_camera)).max() < tolerance
        difference = a.camera.pinhole.calibration_matrix - b.camera.pinhole.calibration_matrix
        assert np.abs(difference).max() < 1e3 * tolerance
    assert np.abs(found.pan_T_tilt.localCoordinates(true.pan_T_tilt)).max() < tolerance


@pytest.mark.parametrize(
    ("name", "tie"),
    slow_but_for(
        QUICK, [(name, tie) for name in EXACT for tie in ("soft", "hard")[: 1 + (EXACT[name][0] == "mast")]]
    ),
)
def test_without_noise_the_true_rig_comes_back(name: str, tie: Tie) -> None:
    """From a wrong rig and telemetry. Priors of telemetry are centred on the truth; the rig has none."""
    model, wrong, sharing = EXACT[name]
    tilts = (-0.3,) if "radius" in name else TWO_TILTS.tilts_rad  # an error of radius is one at one tilt
    simulation = simulated(1, noise_px=0.0, prior="truth", tilts_rad=tilts, **wrong)
    options = SolveOptions(
        rig="held",
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


@pytest.mark.parametrize("model", slow_but_for("mast", ["mast", "circle", "free"]))
def test_saying_that_all_is_held_changes_no_bit(model: Model) -> None:
    t = simulated().traverse
    plain = solve(t, SolveOptions(rig="held", model=model))
    said = solve(t, SolveOptions(model=model, sharing=parse_sharing(["calibration=fixed", "mounts=fixed"])))
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
    solution = solve(t, SolveOptions(rig="held", loss="none", tie=tie, sharing=sharing))  # type: ignore[arg-type]  # parametrised
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
        solve(t, SolveOptions(rig="held", model="circle", loss="none", sharing=Sharing(radius=radius)))
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


@pytest.mark.parametrize("scope", slow_but_for("eye", ["eye", "stop"]))
def test_a_distorted_camera_keeps_its_distortion_as_its_calibration_moves(scope: Scope) -> None:
    options = replace(TWO_TILTS, noise_px=0.0, prior="truth", focal_error=3e-3)
    simulation = simulate(distorted(), options, seed=1)
    sharing = Sharing(calibration=loose("calibration", scope, "fx_px", "fy_px", "cx_px", "cy_px"))
    solution = solve(
        simulation.traverse,
        SolveOptions(rig="held", loss="none", sharing=sharing, relative_decrease=1e-12),
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


@pytest.mark.slow
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


HARD_TIES = {
    "chosen": Sharing(
        calibration=Freedom(scope="eye"), mounts=Freedom(scope="eye"), pan_T_tilt=Freedom(scope="all")
    ),
    "all that flexes": Sharing(flex=Freedom(scope="frame", sigma={"twist_rad": 2e-3})),
    "by default": None,
}


@pytest.mark.slow
@pytest.mark.parametrize("sharing", HARD_TIES.values(), ids=HARD_TIES)
def test_a_hard_tie_has_the_explicit_optimum_too(sharing: Sharing | None) -> None:
    ours, theirs = (
        solve(
            near(),
            SolveOptions(loss="none", landmarks=way, sharing=sharing, relative_decrease=1e-12),
        )
        for way in ("eliminated", "explicit")
    )
    assert ours.cost_final == pytest.approx(theirs.cost_final, rel=1e-6)
    off = ours.final.pan_tilt_rad - theirs.final.pan_tilt_rad
    assert np.abs(off / ours.angle_sigma_rad).max() < 0.01
    np.testing.assert_allclose(ours.angle_sigma_rad, theirs.angle_sigma_rad, rtol=1e-4)
    if sharing is None or sharing.flex != FIXED:
        rigs = ours.final.rig, theirs.final.rig
        twist, other = (rig.flex[:, 0] for rig in rigs if rig is not None and rig.flex is not None)
        assert np.abs(twist).max() > 1e-6
        np.testing.assert_allclose(twist, other, atol=0.01 * np.abs(twist).max())
    for a, b in zip(ours.refined, theirs.refined, strict=True):
        assert a.change == pytest.approx(b.change, abs=0.01 * a.sigma)
        assert a.sigma == pytest.approx(b.sigma, rel=1e-3)


@pytest.mark.parametrize(
    "name",
    slow_but_for(
        "calibration, circle", ["mounts per stop and axis", "calibration, circle", "calibration, free"]
    ),
)
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
    fixed, free = (solve(t, SolveOptions(rig="held", loss="none", sharing=s)) for s in (None, mounts))
    assert np.all(free.angle_sigma_rad[:, 1] > 1.2 * fixed.angle_sigma_rad[:, 1])
