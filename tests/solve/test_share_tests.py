"""Shares in use: what chance alone takes from a frame is not held against it."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, simulate, solve
from pancam_graph.landmarks import Measurements, kernel
from pancam_graph.rigs import TEMPLATES
from pancam_graph.solve._share_tests import InUse, _expected_links, _Fairness
from support.solving import fitted

FRAMES, OUTLIERS = 8, 0.25


def sights(rng: np.random.Generator, n_points: int) -> Measurements:
    """One eye: points of the first four frames are seen by two of these, of the others by all four."""
    first = rng.integers(4, size=n_points)
    second = (first + rng.integers(1, 4, size=n_points)) % 4
    frames = [np.sort([first[j], second[j]]) if j % 2 else np.arange(4, 8) for j in range(n_points)]
    landmark = np.repeat(np.arange(n_points), [len(one) for one in frames])
    n = len(landmark)
    return Measurements(
        row=np.arange(n),
        image=np.concatenate(frames),
        landmark=landmark,
        uv_px=np.zeros((n, 2)),
        whitening=np.broadcast_to(np.eye(2), (n, 2, 2)).copy(),
    )


def links(m: Measurements, kept: np.ndarray) -> InUse:
    n, used = np.zeros(FRAMES, dtype=np.int64), np.zeros(FRAMES, dtype=np.int64)
    kernel.count_links(m.begin, m.image, kept, n, used)
    return InUse(n=n, used=used)


def test_a_frame_is_expected_to_keep_what_points_of_as_many_sights_keep() -> None:
    rng = np.random.default_rng(1)
    m = sights(rng, 4000)
    kept = rng.random(len(m.landmark)) >= OUTLIERS
    right = 1 - OUTLIERS
    expected = _expected_links(m, kept, m.image, np.array([0, 5]))
    assert expected == pytest.approx([right**2, right * (1 - OUTLIERS**3)], abs=0.02)


def test_no_more_right_frames_fail_than_chance_allows_and_a_wrong_one_does() -> None:
    """Of 40 panoramas. By the usual share alone, right frames that see points in twos fail."""
    rng = np.random.default_rng(2)
    test = _Fairness(
        name="frame links",
        owner="frame",
        what="points",
        least=4,
        fair=1.0,
        ids=[str(i) for i in range(FRAMES)],
    )

    def passes(m: Measurements, kept: np.ndarray) -> bool:
        return test.of(links(m, kept), expected=partial(_expected_links, m, kept, m.image)).passed

    failed, failed_alike, caught = 0, 0, 0
    for i in range(40):
        m = sights(rng, 240)
        kept = rng.random(len(m.landmark)) >= OUTLIERS
        failed += not passes(m, kept)
        failed_alike += not test.of(links(m, kept)).passed
        if i % 4 == 0:
            caught += not passes(m, kept & ~((m.image == 2) & (rng.random(len(kept)) < 0.9)))
    assert failed == 0
    assert failed_alike > 0
    assert caught == 10


@pytest.mark.slow
def test_points_that_chance_alone_explains_are_not_held_against_a_frame() -> None:
    """One eye, most points seen twice: near ones are left out as soon as there are outliers."""
    rig = TEMPLATES["mer-navcam"]()
    options = SimulationOptions(stops=3, pans=4, points_per_image=40, outliers=0.03, sweep_rad=None)
    traverse = simulate(replace(rig, eyes=rig.eyes[:1]), options, seed=50040).traverse
    solving = SolveOptions(rig="held", rescale_noise=True)
    assert fitted(traverse, solving).screened.by_chance.sum() > 50
    solution = solve(traverse, solving)
    assert solution.passed
    assert solution.verdict is not None
    (test,) = (test for test in solution.verdict.tests if test.name == "frame links")
    assert test.value is not None
    assert test.value < 0.6 * test.limit
