"""A common error of all pans of a stop: what it does to a solution, and that the verdict says so."""

from dataclasses import replace

import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, simulate, solve
from pancam_graph.rigs import mer_navcam
from pancam_graph.solve import judge
from pancam_graph.solve._common_pan import common_pans
from pancam_graph.solve._telemetry_tests import telemetry_of
from support.solving import fitted

FEW = SimulationOptions(stops=2, pans=4, sweep_rad=2.0, points_per_image=15)
HELD = SolveOptions(rig="held")


def test_it_moves_pans_and_heading_as_predicted_and_leaves_cameras() -> None:
    t = simulate(mer_navcam(), FEW, seed=3).traverse
    fit = fitted(t, HELD)
    judged = judge(fit)
    assert judged.uncertainty.variables is not None
    _, last = common_pans(telemetry_of(fit.problem, judged.uncertainty.variables))
    frames = [replace(f, pan_rad=f.pan_rad + last.sigma_rad * (f.stop == t.stops[1].id)) for f in t.frames]
    other = judge(fitted(replace(t, frames=tuple(frames)), HELD)).state
    at_last = t.frame_stop == 1
    pan = float(np.mean((other.pan_tilt_rad - judged.state.pan_tilt_rad)[at_last, 0]))
    heading = float(judged.state.world_T_mast[1].localCoordinates(other.world_T_mast[1])[2])
    assert last.pan_rad == pytest.approx(pan, rel=0.02)
    assert last.heading_rad == pytest.approx(heading, rel=0.02)
    assert last.pan_rad > 0.9 * last.sigma_rad
    assert abs(last.pointing_rad) < 0.1 * last.pointing_sigma_rad
    (test,) = (test for test in judged.verdict.tests if test.name == "sigmas")
    assert "share would go unseen" in test.says


def test_a_single_pan_has_none() -> None:
    solution = solve(simulate(mer_navcam(), replace(FEW, pans=1, tilts_rad=(-0.2,)), seed=3).traverse, HELD)
    assert solution.verdict is not None
    assert not any("share would go unseen" in test.says for test in solution.verdict.tests)
