"""What of a rig is free: sigmas against errors, and what images do not tell or nothing holds."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph import (
    Freedom,
    Sharing,
    Solution,
    SolveOptions,
    find_observations,
    read_pds,
    simulate,
    solve,
)
from pancam_graph.data import ENTRIES
from pancam_graph.rigs import exomars_pancam
from support.shared_rigs import FOCAL, TWO_TILTS, loose, simulated

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
        solution = solve(t, SolveOptions(rig="held", loss="none", model=model, sharing=sharing))  # type: ignore[arg-type]  # parametrised
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
    solution = solve(simulation.traverse, SolveOptions(rig="held", sharing=sharing))
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
    mounts = solve(t, SolveOptions(rig="held", loss="none", sharing=Sharing(mounts=Freedom(scope="eye"))))
    assert "rx_rad" in unseen(mounts)
    assert "mounts left" in unseen(mounts)
    assert "mounts right" in unseen(mounts)
    by_name = {(r.camera, r.entry): r for r in mounts.refined}
    # Telemetry of 16 frames knows their mean tilt to a quarter of what it knows of each: no better the turn.
    assert 1.34e-3 / 4 < by_name["left", "rx_rad"].sigma < 1.3 * 1.34e-3 / 4
    axis = solve(
        t,
        SolveOptions(
            rig="held", loss="none", sharing=Sharing(pan_T_tilt=Freedom(scope="all", free=("z_m", "ry_rad")))
        ),
    )
    assert unseen(axis).startswith("images say next to nothing of 2 directions (")
    lift = next(r for r in axis.refined if r.entry == "z_m")
    assert lift.sigma == pytest.approx(lift.prior_sigma, rel=1e-3)


def test_what_images_do_tell_is_not_named() -> None:
    sharing = Sharing(calibration=Freedom(scope="eye", free=FOCAL))
    assert unseen(solve(simulated().traverse, SolveOptions(rig="held", loss="none", sharing=sharing))) == ""


def test_what_nothing_holds_is_named_however_it_comes_out() -> None:
    """At the one stop, which is held, a lift of the tilt axis lifts the cameras with all they see.

    What is left of such a direction is rounding, which may pass for a little information.
    """
    t = simulated(2, stops=1).traverse
    solution = solve(
        t,
        SolveOptions(rig="held", loss="none", sharing=Sharing(pan_T_tilt=loose("pan_T_tilt", "all", "z_m"))),
    )
    assert len([w for w in solution.warnings if "pan_T_tilt z_m" in w]) == 1
    assert not solution.refined[0].sigma < 1.0


def test_where_nothing_holds_an_entry_there_are_no_uncertainties_and_it_is_named() -> None:
    t = simulated(2, stops=1).traverse
    assert t.observations is not None
    blind = 3
    seen = t.with_observations(t.observations.select(t.observations.image != blind))
    sharing = Sharing(calibration=loose("calibration", "image", *FOCAL))
    solution = solve(seen, SolveOptions(rig="held", loss="none", sharing=sharing))
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
    solution = solve(without, SolveOptions(rig="held", loss="none", sharing=sharing))
    assert [r.camera for r in solution.refined] == ["wac-left", "wac-right"]
    assert solution.rig.eyes[2] == t.rig.eyes[2]


def test_eyes_may_share_a_correction_though_their_numbers_differ() -> None:
    rig = exomars_pancam()
    simulation = simulate(rig, replace(TWO_TILTS, stops=1, tilts_rad=(-0.2,)), seed=0)
    sharing = Sharing(calibration=Freedom(scope="all", free=("focal", "cx_px")))
    assert len({p.fx_px for p in rig.pinholes}) > len({p.cx_px for p in rig.pinholes}) == 1
    solution = solve(simulation.traverse, SolveOptions(rig="held", loss="none", sharing=sharing))
    focal, column = solution.refined
    assert (focal.nominal, column.nominal) == (1.0, rig.pinholes[0].cx_px)
    for found, given_ in zip(solution.rig.pinholes, rig.pinholes, strict=True):
        assert found.fx_px / given_.fx_px == pytest.approx(1 + focal.change, rel=1e-12)
        assert found.fy_px / given_.fy_px == pytest.approx(1 + focal.change, rel=1e-12)
        assert found.cx_px - given_.cx_px == pytest.approx(column.change, abs=1e-9)
    common = Sharing(calibration=Freedom(scope="all", free=("fx_px",)))
    assert (
        solve(simulation.traverse, SolveOptions(rig="held", loss="none", sharing=common)).refined[0].nominal
        is None
    )


# --- real ---


@pytest.mark.slow
def test_a_free_focal_length_of_opportunity(request: pytest.FixtureRequest) -> None:
    """Over the same observations, weighted alike, it fits better; by half a per cent it is not wrong."""
    matched = find_observations(read_pds(request.getfixturevalue("opportunity_folder")))
    first = solve(matched, SolveOptions(rig="held"))
    assert matched.observations is not None
    assert first.covariance_px2 is not None
    kept = replace(
        matched.observations.select(first.used),
        origin="given",
        sigma_px=first.sigma_px[first.used],
        covariance_px2=first.covariance_px2[first.used],
    )
    t = matched.with_observations(kept)
    sharing = Sharing(calibration=Freedom(scope="eye", free=FOCAL))
    for model in ("mast", "circle", "free"):
        fixed, free = (
            solve(t, SolveOptions(rig="held", model=model, loss="none", sharing=s)) for s in (None, sharing)
        )
        assert free.converged
        assert free.cost_final < fixed.cost_final
        focal = free.refined[0]
        assert abs(focal.change) < 5e-3
        assert focal.sigma < 6e-4
