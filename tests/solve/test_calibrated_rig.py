"""A rig that was calibrated with other images, with the covariance that they left."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest

from pancam_graph import SimulationOptions, Solution, SolveOptions, Traverse, build_graph, simulate, solve
from pancam_graph.base.geometry import FloatArray, corrected_poses
from pancam_graph.data import Observations, RigTreatment, sharing_within
from pancam_graph.graph import HardTemplate
from pancam_graph.results import calibrated_rig
from pancam_graph.rigs import Rig, RigCovariance, mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.smoother._incremental import solve_incrementally
from support.small_drives import near_part

TO_THE_END = SolveOptions(loss="none", relative_decrease=1e-12)


@cache
def drives() -> tuple[Simulation, Simulation]:
    """Two drives of one unit, whose rig is off by what its uncertainty says."""
    options = SimulationOptions(stops=1, pans=5, sweep_rad=2.0, points_per_image=30, rig_error="drawn")
    return simulate(mer_navcam(), options, seed=11), simulate(mer_navcam(), options, seed=12)


def claimed() -> Rig:
    return drives()[0].traverse.rig


@cache
def calibrated() -> Solution:
    return solve(drives()[0].traverse, TO_THE_END)


@cache
def second() -> Traverse:
    return replace(drives()[1].traverse, rig=calibrated_rig(calibrated()))


def together() -> Traverse:
    """Both drives as one, with no point in common."""
    first, other = (replace(d.traverse, rig=claimed()) for d in drives())
    assert first.observations is not None
    assert other.observations is not None
    far = gtsam.Pose3(gtsam.Rot3(), np.array([500.0, 0.0, 0.0]))
    a, b = first.observations, other.observations
    stops = [replace(s, id=f"b{s.id}", world_T_mast=far * s.world_T_mast) for s in other.stops]
    frames = [replace(f, id=f"b{f.id}", stop=f"b{f.stop}") for f in other.frames]
    images = [replace(i, id=f"b{i.id}", frame=f"b{i.frame}") for i in other.images]
    return replace(
        first,
        stops=(*first.stops, *stops),
        frames=(*first.frames, *frames),
        images=(*first.images, *images),
        observations=Observations(
            image=np.concatenate([a.image, len(first.images) + b.image]),
            track=np.concatenate([a.track, a.track.max() + 1 + b.track]),
            uv_px=np.concatenate([a.uv_px, b.uv_px]),
            sigma_px=np.concatenate([a.sigma_px, b.sigma_px]),
        ),
    )


def numbers(rig: Rig, about: Rig) -> FloatArray:
    """Corrections from one rig to another in the order of `RigVariables`, by an independent formula."""
    out, mounts = [], []
    for eye, nominal in zip(rig.eyes, about.eyes, strict=True):
        K, K0 = (e.camera.pinhole.calibration_matrix for e in (eye, nominal))
        focal = K[0, 0] / K0[0, 0] - 1
        out += [focal, K[1, 1] / K0[1, 1] - 1 - focal, *(K - K0)[[0, 0, 1], [1, 2, 2]]]
        mounts += pose_numbers(eye.head_T_camera, nominal.head_T_camera)
    return np.array([*out, *mounts, *pose_numbers(rig.pan_T_tilt, about.pan_T_tilt)])


def pose_numbers(pose: gtsam.Pose3, about: gtsam.Pose3) -> list[float]:
    apart = about.between(pose)
    return [*gtsam.Rot3.Logmap(apart.rotation()), *apart.translation()]


def test_one_drive_after_the_other_is_both_at_once() -> None:
    """A posterior as the next prior: what Bayes' rule says, to second order in the corrections."""
    after, both = solve(second(), TO_THE_END), solve(together(), TO_THE_END)
    assert after.rig_covariance is not None
    assert both.rig_covariance is not None
    sigma = np.sqrt(np.diag(both.rig_covariance.matrix))
    apart = (numbers(after.rig, claimed()) - numbers(both.rig, claimed())) / sigma
    assert np.abs(apart).max() < 0.03
    ratio = after.rig_covariance.matrix / np.outer(sigma, sigma)
    np.testing.assert_allclose(ratio, both.rig_covariance.matrix / np.outer(sigma, sigma), atol=0.01)
    n = len(second().frames)
    np.testing.assert_allclose(after.angle_sigma_rad, both.angle_sigma_rad[-n:], rtol=0.001)
    apart = (after.final.pan_tilt_rad - both.final.pan_tilt_rad[-n:]) / after.angle_sigma_rad
    assert np.abs(apart).max() < 0.01


def test_with_sigmas_alone_it_is_not() -> None:
    """What is lost without the correlations: the test above could not pass by accident."""
    rig = calibrated_rig(calibrated())
    joint = rig.uncertainty.covariance
    assert joint is not None
    alone = replace(joint, matrix=np.diag(np.diag(joint.matrix)))
    told = replace(second(), rig=replace(rig, uncertainty=replace(rig.uncertainty, covariance=alone)))
    after, both = solve(told, TO_THE_END), solve(together(), TO_THE_END)
    n = len(told.frames)
    assert np.abs(after.angle_sigma_rad / both.angle_sigma_rad[-n:] - 1).max() > 0.1
    assert both.rig_covariance is not None
    apart = numbers(after.rig, claimed()) - numbers(both.rig, claimed())
    assert np.abs(apart / np.sqrt(np.diag(both.rig_covariance.matrix))).max() > 0.3


@pytest.mark.slow
def test_a_calibrated_rig_is_surer() -> None:
    found, without = solve(second()), solve(replace(second(), rig=claimed()))
    assert found.passed
    for after, before in zip(found.refined, without.refined, strict=True):
        assert (after.quantity, after.entry, after.camera) == (before.quantity, before.entry, before.camera)
        assert after.prior_sigma <= before.prior_sigma
        assert after.sigma <= 1.01 * before.sigma
    focal = [next(r for r in s.refined if r.entry == "focal") for s in (found, without)]
    assert focal[0].sigma < 0.8 * focal[1].sigma


def test_corrections_of_a_corrected_rig_have_this_jacobian() -> None:
    rng = np.random.default_rng(4)
    uncertainty = replace(claimed().uncertainty, mount_rad=0.1, focal=0.1, aspect=0.1, tilt_axis_rad=0.1)
    rig = replace(claimed(), uncertainty=uncertainty)
    traverse = replace(drives()[0].traverse, rig=rig)
    template = HardTemplate(traverse, sharing_within(uncertainty, "mast").for_model("mast"))
    free = template.rig_variables
    sigma = np.concatenate([v.sigma for v in free.variables])
    at, step = sigma * rng.standard_normal(len(sigma)), 1e-6 * sigma

    def corrected(values: FloatArray) -> Rig:
        eyes = []
        for i, eye in enumerate(rig.eyes):
            focal, aspect, skew, cx, cy = values[5 * i : 5 * i + 5]
            K = eye.camera.pinhole.calibration_matrix
            K[1, 1] *= 1 + focal + aspect
            K[0] = [K[0, 0] * (1 + focal), K[0, 1] + skew, K[0, 2] + cx]
            K[1, 2] += cy
            mount = moved(eye.head_T_camera, values[10 + 6 * i : 16 + 6 * i])
            eyes.append(replace(eye, camera=eye.camera.with_calibration(K), head_T_camera=mount))
        return replace(rig, eyes=tuple(eyes), pan_T_tilt=moved(rig.pan_T_tilt, values[22:]))

    def moved(pose: gtsam.Pose3, correction: FloatArray) -> gtsam.Pose3:
        R, t = corrected_poses(pose.rotation().matrix(), pose.translation(), correction)
        return gtsam.Pose3(gtsam.Rot3(R), t)

    values, end = gtsam.Values(), np.cumsum([len(v.entries) for v in free.variables])
    for v, e in zip(free.variables, end, strict=True):
        values.insert(v.key, at[e - len(v.entries) : e])
    found = np.zeros((len(at), len(at)))
    for v, e in zip(free.variables, end, strict=True):
        part = slice(e - len(v.entries), e)
        found[part, part] = free._moved(v, values)
    for j in range(len(at)):
        ahead, back = (corrected(at + sign * step * (np.arange(len(at)) == j)) for sign in (1, -1))
        middle = corrected(at)
        numeric = (numbers(ahead, middle) - numbers(back, middle)) / (2 * step[j])
        np.testing.assert_allclose(found[:, j] * sigma[j] / sigma, numeric * sigma[j] / sigma, atol=1e-5)


def independent(rig: Rig) -> Rig:
    """A rig that states its own sigmas as a covariance."""
    u = rig.uncertainty
    template = HardTemplate(drives()[0].traverse, sharing_within(u, "mast").for_model("mast"))
    entries = [e for key in template.rig_variables.keys for e in template.rig_variables._entries_of(key)]
    joint = RigCovariance(entries=tuple(entries), matrix=u.covariance_of(entries))
    return replace(rig, uncertainty=replace(u, covariance=joint))


@pytest.mark.parametrize("treatment", ["estimated", "considered"])
def test_a_diagonal_covariance_is_its_sigmas(treatment: RigTreatment) -> None:
    options = replace(TO_THE_END, rig=treatment)
    traverse = drives()[0].traverse
    rigs = (claimed(), independent(claimed()))
    by_sigmas, by_matrix = (solve(replace(traverse, rig=rig), options) for rig in rigs)
    np.testing.assert_allclose(by_matrix.angle_sigma_rad, by_sigmas.angle_sigma_rad, rtol=1e-6)
    np.testing.assert_allclose(by_matrix.final.pan_tilt_rad, by_sigmas.final.pan_tilt_rad, atol=1e-9)


def test_considered_is_as_unsure_as_its_covariance_says() -> None:
    """A considered rig moves nothing: its sigmas lie between those of a held and of a loose rig."""
    held, joint = (solve(second(), replace(TO_THE_END, rig=rig)) for rig in ("held", "considered"))
    loose = solve(replace(second(), rig=claimed()), replace(TO_THE_END, rig="considered"))
    assert np.all(joint.angle_sigma_rad >= held.angle_sigma_rad)
    assert np.all(joint.angle_sigma_rad <= 1.001 * loose.angle_sigma_rad)


@pytest.mark.slow
def test_stop_by_stop_a_covariance_counts_as_in_one_solve() -> None:
    """Also where the second eye is first seen at the second stop."""
    options = SimulationOptions(stops=2, pans=4, points_per_image=20, spacing_m=3.0)
    traverse = replace(simulate(mer_navcam(), options, seed=5).traverse, rig=calibrated_rig(calibrated()))
    keep = [not (i.camera == "right" and traverse.image_stop[r] == 0) for r, i in enumerate(traverse.images)]
    rows = np.flatnonzero(keep)
    observed = traverse.observations
    assert observed is not None
    place = np.cumsum(keep) - 1
    took = np.flatnonzero(np.array(keep)[observed.image])
    few = replace(
        traverse,
        images=tuple(traverse.images[r] for r in rows),
        observations=replace(observed.select(took), image=place[observed.image[took]]),
    )
    for given in (traverse, few):
        # Without a loss: of two ways to the optimum, each may leave out another observation at the limit.
        options_of_both = SolveOptions(loss="none")
        batch, stepwise = solve(given, options_of_both), solve_incrementally(given, options_of_both)
        assert stepwise.cost_final == pytest.approx(batch.cost_final, rel=1e-3)
        np.testing.assert_allclose(stepwise.angle_sigma_rad, batch.angle_sigma_rad, rtol=0.02)


@pytest.mark.slow
def test_terrain_points_as_variables_have_the_same_prior() -> None:
    options = SimulationOptions(stops=1, pans=3, sweep_rad=1.2, points_per_image=8, noise_px=0.1)
    drive = near_part(simulate(mer_navcam(), options, seed=6))
    traverse = replace(drive, rig=calibrated_rig(calibrated()))
    batch = solve(traverse, TO_THE_END)
    explicit = solve(traverse, replace(TO_THE_END, landmarks="explicit"))
    assert explicit.cost_final == pytest.approx(batch.cost_final, rel=1e-6)
    sigma = np.array([r.sigma for r in batch.refined])
    apart = [a.change - b.change for a, b in zip(batch.refined, explicit.refined, strict=True)]
    assert np.abs(apart / sigma).max() < 1e-3
    graph, values = build_graph(traverse, TO_THE_END)
    ours = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert graph.error(ours) == pytest.approx(batch.cost_final, rel=1e-6)


def test_an_eye_without_images_keeps_its_covariance() -> None:
    """Also its correlations with other eyes without images; none with what was estimated."""
    traverse = second()
    left = np.array([i.camera == "left" for i in traverse.images])
    observed = traverse.observations
    assert observed is not None
    took = np.flatnonzero(left[observed.image])
    one = replace(
        traverse,
        images=tuple(i for i in traverse.images if i.camera == "left"),
        observations=replace(observed.select(took), image=(np.cumsum(left) - 1)[observed.image[took]]),
    )
    before = traverse.rig.uncertainty.covariance
    found = solve(one).rig_covariance
    assert before is not None
    assert found is not None
    assert set(found.entries) == set(before.entries)
    right = [e for e in before.entries if e.camera == "right"]
    nothing = np.zeros(len(right))
    np.testing.assert_array_equal(found.among(right, nothing), before.among(right, nothing))


def test_only_an_estimated_rig_has_a_covariance() -> None:
    traverse = drives()[0].traverse
    assert solve(traverse, SolveOptions(rig="held")).rig_covariance is None
    assert calibrated_rig(solve(traverse, SolveOptions(rig="held"))) is traverse.rig
    rig = calibrated_rig(calibrated())
    assert rig.uncertainty.covariance is not None
    assert len(rig.uncertainty.covariance.pictures) == len(traverse.images)
    assert rig.uncertainty.source.endswith(f"; refined with {traverse.name}")
    again = calibrated_rig(solve(second()))
    assert again.uncertainty.source.count("; refined with ") == 1
    assert again.uncertainty.covariance is not None
    assert len(again.uncertainty.covariance.pictures) == len(traverse.images) + len(second().images)
