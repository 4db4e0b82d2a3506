"""Drives of distorted cameras: their optimum against independent solvers and differences of the cost."""

from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import gtsam
import numpy as np
import pytest
import scipy

from pancam_graph import Freedom, Sharing, Solution, SolveOptions, Traverse, build_graph, simulate, solve
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHVOR, CAHVORE, Brown, Camera
from pancam_graph.elimination import Linkage
from pancam_graph.landmarks import refine
from pancam_graph.rigs import Rig, mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.solve._fit import fit
from pancam_graph.solve._prepare import prepare
from pancam_graph.solve._screen import screen
from support.parameters import slow_but_for
from support.small_drives import HARD, SMALL, SOFT, near_part

FREE = Sharing(calibration=Freedom(scope="eye", free=("fx_px", "fy_px", "cx_px", "cy_px")))


def distorted(name: str) -> Rig:
    """The Navcam's rig with lenses of a kind, distorted by some pixels at the edge of the image."""
    base, eyes = mer_navcam(), []
    for eye in base.eyes:
        p = eye.camera.pinhole
        size: dict[str, Any] = {"width_px": p.width_px, "height_px": p.height_px}
        vectors: dict[str, Any] = dict(zip("HVA", p.calibration_matrix, strict=True), C=np.zeros(3))
        vectors["O"] = np.array([0.006, -0.004, 1.0]) / np.linalg.norm([0.006, -0.004, 1.0])
        vectors["R"] = np.array([1e-4, 0.05, -0.03])
        camera: Camera
        if name == "brown":
            numbers = {k: getattr(p, k) for k in ("fx_px", "fy_px", "cx_px", "cy_px", "skew_px")}
            camera = Brown(**size, **numbers, distortion=(-0.1, 0.03, 1e-3, -1e-3, 0.01))
        elif name == "cahvor":
            camera = CAHVOR(**size, **vectors)
        else:
            camera = CAHVORE(**size, **vectors, E=np.array([-0.004, 0.013, -0.024]), linearity=0.37)
        eyes.append(replace(eye, camera=camera))
    return replace(base, eyes=tuple(eyes))


@cache
def driven(name: str, stops: int = 2, points: int = 6) -> Simulation:
    return simulate(distorted(name), replace(SMALL, stops=stops, points_per_image=points), seed=3)


def by_scipy(traverse: Traverse, start: Solution) -> tuple[float, FloatArray, FloatArray]:
    """Least squares of cameras' own projections by SciPy: cost, mast translations and angles at the optimum.

    All of it in NumPy: the chain of `Traverse.camera_poses`, `Camera.project`, and the priors of telemetry.
    """
    t, obs = traverse, traverse.observations
    assert obs is not None
    _, track = np.unique(obs.track, return_inverse=True)
    seen_twice = np.bincount(track)[track] >= 2
    image, uv = obs.image[seen_twice], obs.uv_px[seen_twice]
    _, track = np.unique(obs.track[seen_twice], return_inverse=True)
    assert len(start.landmark_track) == track.max() + 1
    sigma, first = obs.sigma_px[seen_twice, None], np.zeros(6 * len(t.stops) + 2 * len(t.frames))
    n_cameras = len(first)
    origin = start.final.world_T_mast
    moves = [np.any(s.sigmas > 0) for s in t.stops]

    def poses(x: FloatArray) -> list[gtsam.Pose3]:
        steps = x[: 6 * len(t.stops)].reshape(-1, 6)
        return [p.retract(s) if m else p for p, s, m in zip(origin, steps, moves, strict=True)]

    def errors(x: FloatArray) -> FloatArray:
        masts = poses(x)
        angles = start.final.pan_tilt_rad + x[6 * len(t.stops) : n_cameras].reshape(-1, 2)
        rotation, centre = t.camera_poses(masts, angles)
        points = x[n_cameras:].reshape(-1, 3)[track]
        inside = np.einsum("nji,nj->ni", rotation[image], points - centre[image])
        projected = np.empty_like(uv)
        for i, eye in enumerate(t.rig.eyes):
            of_eye = t.image_eye[image] == i
            projected[of_eye], valid = eye.camera.project(inside[of_eye])
            assert valid.all()
        out = [((projected - uv) / sigma).ravel()]
        for stop, mast, moved in zip(t.stops, masts, moves, strict=True):
            if moved:
                there = stop.world_T_mast.between(mast)
                out.append(gtsam.Pose3.Logmap(there) / stop.sigmas)
        sigmas = np.array([f.sigmas_rad for f in t.frames])
        out.append(((angles - t.pan_tilt_rad) / sigmas).ravel())
        return np.concatenate(out)

    x = np.concatenate([first, start.final.landmarks_m.ravel()])
    rng = np.random.default_rng(0)
    x[:n_cameras] += 1e-4 * rng.normal(size=n_cameras)  # not from where it should end
    x[n_cameras:] *= 1 + 1e-4 * rng.normal(size=len(x) - n_cameras)
    found = scipy.optimize.least_squares(errors, x, x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15)
    masts = np.array([p.translation() for p in poses(found.x)])
    return (
        float(found.cost),
        masts,
        start.final.pan_tilt_rad + found.x[6 * len(t.stops) : n_cameras].reshape(-1, 2),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brown", "cahvor", "cahvore"])
def test_the_optimum_is_that_of_an_independent_solver(name: str) -> None:
    traverse = near_part(driven(name))
    ours = solve(traverse, HARD)
    cost, masts_m, angles = by_scipy(traverse, ours)
    assert ours.cost_final > 10
    assert ours.cost_final == pytest.approx(cost, rel=1e-6)
    assert np.array([p.translation() for p in ours.final.world_T_mast]) == pytest.approx(masts_m, abs=1e-6)
    assert ours.final.pan_tilt_rad == pytest.approx(angles, abs=1e-6)


TIES = {"hard": HARD, "soft": SOFT, "free K": replace(SOFT, sharing=FREE)}


@pytest.mark.parametrize(
    ("name", "tie"),
    slow_but_for(
        [("brown", "free K"), ("cahvor", "soft"), ("cahvore", "soft"), ("brown", "hard")],
        product(["brown", "cahvor", "cahvore"], TIES),
    ),
)
def test_the_graph_for_gtsam_has_the_same_cost(name: str, tie: str) -> None:
    """At the start, where residuals are of tens of pixels: landmarks are where the problem has them."""
    traverse = near_part(driven(name))
    options = TIES[tie]
    graph, values = build_graph(traverse, options)
    problem = prepare(traverse, replace(options, landmarks="explicit", method="joint")).problem
    moved = problem.at(problem.values, problem.landmarks.moved_to(problem.points_m()))
    assert moved.cost() > 100
    assert graph.error(values) == pytest.approx(moved.cost(), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cahvor", "cahvore"])
def test_explicit_landmarks_end_at_the_same_optimum(name: str) -> None:
    traverse = near_part(driven(name))
    ours = solve(traverse, SOFT)
    explicit = solve(traverse, replace(SOFT, landmarks="explicit"))
    assert explicit.cost_final == pytest.approx(ours.cost_final, rel=1e-6)
    assert explicit.final.pan_tilt_rad == pytest.approx(ours.final.pan_tilt_rad, abs=1e-6)


@pytest.mark.parametrize("name", slow_but_for("cahvore", ["brown", "cahvor", "cahvore"]))
def test_at_the_optimum_the_cost_has_no_slope_by_any_variable(name: str) -> None:
    """Calibrations included, by differences of the true cost of noisy pixels with landmarks at their best."""
    traverse = driven(name, points=15).traverse
    options = SolveOptions(loss="none", relative_decrease=1e-14, sharing=FREE)
    prepared = prepare(traverse, options)
    fitted = fit(screen(prepared))
    problem = fitted.problem
    assert fitted.ended is not None
    covariance, link = fitted.ended.reduced().root.covariance(), problem.template.linkage
    weight = problem.accepted.astype(float)

    def cost(values: gtsam.Values) -> float:
        moved = problem.at(values, problem.landmarks)
        best = refine(moved.landmarks, moved.measurements, moved.views, weight, beyond_infinity=True)
        return moved.at(values, best).cost()

    held = problem.template.held_columns()
    for key, dim, g in zip(link.key, link.dim, link.group, strict=True):
        columns = link.columns_of(key)
        sigmas = np.sqrt(np.diag(covariance.block(int(g), int(g))[columns, columns]))
        for i in set(range(int(dim))) - set(held.get(key, [])):
            ends = []
            for sign in (1, -1):
                step = gtsam.VectorValues()
                step.insert(key, sign * 0.1 * sigmas[i] * np.eye(int(dim))[i])
                ends.append(cost(problem.values.retract(_whole(step, link))))
            # The slope by a sigma of the variable: 1 or more where the optimum is a sigma away.
            assert abs(ends[0] - ends[1]) / 0.2 < 5e-3


def _whole(step: gtsam.VectorValues, link: Linkage) -> gtsam.VectorValues:
    """A step of one variable as a step of all."""
    out = gtsam.VectorValues()
    for key, dim in zip(link.key, link.dim, strict=True):
        out.insert(key, step.at(key) if step.exists(key) else np.zeros(int(dim)))
    return out


def test_noise_is_that_of_raw_pixels() -> None:
    """Raw residuals are the differences of pixels of the image as it was taken."""
    simulation = driven("cahvor")
    solution = solve(simulation.traverse, HARD)
    t, obs = solution.traverse, solution.traverse.observations
    assert obs is not None
    row = np.searchsorted(solution.landmark_track, obs.track).clip(max=len(solution.landmark_track) - 1)
    near = solution.used & (np.linalg.norm(solution.final.landmarks_m[row], axis=1) < 1e4)
    image = obs.image[near]
    inside = np.einsum(
        "nji,nj->ni",
        solution.final.world_R_camera[image],
        solution.final.landmarks_m[row[near]] - solution.final.world_t_camera[image],
    )
    expected = np.empty((int(near.sum()), 2))
    for i, eye in enumerate(t.rig.eyes):
        of_eye = t.image_eye[image] == i
        expected[of_eye] = eye.camera.project(inside[of_eye])[0] - obs.uv_px[near][of_eye]
    assert solution.residual_final_px[near] == pytest.approx(expected, abs=1e-6)
