"""A drive eliminated in stretches is the drive eliminated at once: cost, values, sigmas and verdict."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pancam_graph import SimulationOptions, Solution, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.data import Constraint, StopHeading, StopPose
from pancam_graph.elimination import LandmarkSystem
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import Simulation
from pancam_graph.solve import prepare
from pancam_graph.solve._problem import system_of
from support.solving import fitted, solution_from
from support.tied_drives import landmark_ties

LONG = SimulationOptions(
    stops=8, pans=2, sweep_rad=1.2, points_per_image=12, spacing_m=4.0, link_stops=2, outliers=0.05
)
"""Tracks over three stops."""
AT_ONCE = SolveOptions()


@cache
def drive(**options: object) -> Simulation:
    return simulate(mer_navcam(), replace(LONG, **options), seed=5)  # type: ignore[arg-type]  # by name


def required_alike(
    traverse: Traverse,
    options: SolveOptions,
    stretches: int,
    solved: Callable[[Traverse, SolveOptions], Solution] = solve,
) -> tuple[Solution, Solution]:
    """Solve a drive at once and in stretches; both solutions, which must be the same but for rounding."""
    whole, cut = (solved(traverse, replace(options, stretches=n)) for n in (1, stretches))
    assert whole.converged
    assert cut.converged
    np.testing.assert_array_equal(cut.used, whole.used)
    assert cut.cost_final == pytest.approx(whole.cost_final, rel=1e-9)
    sigmas = [np.sqrt(np.einsum("nii->ni", s.stop_covariance)) for s in (whole, cut)]
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=1e-6)
    np.testing.assert_allclose(cut.angle_sigma_rad, whole.angle_sigma_rad, rtol=1e-6)
    apart = np.array(
        [a.localCoordinates(b) for a, b in zip(whole.final.world_T_mast, cut.final.world_T_mast, strict=True)]
    )
    free = sigmas[0] > 0
    assert np.abs(apart[free] / sigmas[0][free]).max() < 1e-3
    turned = np.abs(cut.final.pan_tilt_rad - whole.final.pan_tilt_rad)
    assert np.all(turned <= 1e-3 * whole.angle_sigma_rad)
    assert whole.verdict is not None
    assert cut.verdict is not None
    assert [(t.name, t.passed) for t in cut.verdict.tests] == [
        (t.name, t.passed) for t in whole.verdict.tests
    ]
    return whole, cut


@pytest.mark.parametrize(
    ("rig", "stretches"),
    [
        ("estimated", 4),
        pytest.param("estimated", 2, marks=pytest.mark.slow),
        pytest.param("held", 4, marks=pytest.mark.slow),
        pytest.param("held", 2, marks=pytest.mark.slow),
    ],
)
def test_stretches_end_where_the_whole_drive_does(rig: str, stretches: int) -> None:
    options = SolveOptions(rig=rig)  # type: ignore[arg-type]  # by name
    whole, cut = required_alike(drive().traverse, options, stretches)
    assert not whole.used.all()  # outliers were looked for
    for a, b in zip(whole.refined, cut.refined, strict=True):
        assert abs(a.change - b.change) < 1e-3 * a.sigma
        assert b.sigma == pytest.approx(a.sigma, rel=1e-6)


@pytest.mark.slow
def test_twelve_hundred_stops_in_four_stretches_end_where_they_do_at_once() -> None:
    traverse = drive(stops=1200, pans=1, outliers=0.0).traverse
    options = SolveOptions(rig="held", loss="none")
    required_alike(traverse, options, 4, lambda t, o: solution_from(fitted(t, o)))


def with_constraints(simulation: Simulation, constraints: tuple[Constraint, ...]) -> Traverse:
    return replace(simulation.traverse, constraints=constraints)


def test_constraints_within_and_across_stretches_count_as_at_once() -> None:
    made = drive(outliers=0.0)
    stops, true = made.traverse.stops, made.truth.world_T_mast
    # The pose joins the first stretch to the last one, as a closed loop does.
    ties = (
        StopPose(
            between=(stops[1].id, stops[-1].id), a_T_b=true[1].between(true[-1]), covariance=1e-6 * np.eye(6)
        ),
        StopHeading(stop=stops[4].id, heading_rad=float(true[4].rotation().yaw()), sigma_rad=1e-4),
    )
    required_alike(with_constraints(made, ties), AT_ONCE, 3)


@pytest.mark.slow
def test_ties_of_landmarks_count_as_at_once() -> None:
    made = drive(outliers=0.0)
    required_alike(with_constraints(made, landmark_ties(made, sigma=1e-2)[:6]), AT_ONCE, 3)


@pytest.mark.slow
def test_fields_and_covariances_of_points_are_as_at_once() -> None:
    options = SolveOptions(rig="estimated", field=True, loss="none", landmark_covariances=True)
    whole, cut = required_alike(drive(outliers=0.0).traverse, options, 3)
    assert whole.landmark_covariance_m2 is not None
    assert cut.landmark_covariance_m2 is not None
    np.testing.assert_allclose(cut.landmark_covariance_m2, whole.landmark_covariance_m2, rtol=1e-5)
    np.testing.assert_allclose(cut.final.landmarks_m, whole.final.landmarks_m, rtol=1e-6)


def test_a_stop_that_no_other_sees_is_as_at_once() -> None:
    t = drive(outliers=0.0).traverse
    observations = t.observations
    assert observations is not None
    # The fourth stop keeps odometry alone.
    seen = t.image_stop[observations.image] != 3
    required_alike(t.with_observations(observations.select(seen)), SolveOptions(loss="none", rig="held"), 4)


def test_a_block_knows_the_segments_of_its_own_units_alone() -> None:
    """Else memory would grow with the square of the drive."""
    problem = prepare(drive().traverse, SolveOptions(rig="held")).problem
    system, _ = system_of(problem)
    assert isinstance(system, LandmarkSystem)
    t, link = problem.template.traverse, problem.template.linkage
    unit_stop = np.zeros(len(link.segment_begin) - 1, dtype=np.int64)
    unit_stop[link.image_unit] = t.image_stop
    of_segment = np.repeat(unit_stop, np.diff(link.segment_begin))
    for block in system.blocks:
        assert set(of_segment[block.segment].tolist()) == set(block.groups)
    assert sum(len(block.segment) for block in system.blocks) < 0.8 * len(system.blocks) * len(of_segment)


def test_numbers_and_methods_that_have_no_stretches_are_refused() -> None:
    with pytest.raises(InputError, match="stretches: expected a whole number of 1 or more, found 0"):
        SolveOptions(stretches=0)
    with pytest.raises(InputError, match="stretches: expected 1 but with the model mast"):
        SolveOptions(stretches=2, landmarks="explicit")
    with pytest.raises(InputError, match=r"no more than there are stops \(8\), found 9"):
        solve(drive().traverse, SolveOptions(stretches=9))
