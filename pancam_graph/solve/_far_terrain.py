"""Far terrain: estimates and covariances that noise in fitted ranges does not bias.

The range of a far landmark is fitted to noise. In the normal equations the fitted range multiplies the motion
of a stop, so noise in it counts as parallax: it tells a stop's height from the tilts of its frames where
nothing does (incidental parameters: Neyman and Scott 1948). Here derivatives are taken at the *expected*
inverse range, given the fitted one and the ranges of all other landmarks; residuals are those of the fitted
range. A residual, from which the range is projected out, does not depend on the noise of the fitted range. So
the gradient is zero on average at the truth, whatever distribution the ranges are taken from (conditional
score: Stefanski and Carroll 1987), and its variance is the system at the expected ranges.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.elimination import FreeDirectionError
from pancam_graph.landmarks import InverseRanges, Landmarks, at_inverse_ranges, inverse_ranges
from pancam_graph.solve._joint import all_columns, retracted
from pancam_graph.solve._problem import Problem, reach_m
from pancam_graph.solve._range_prior import RangePrior
from pancam_graph.solve._reduced import ReducedSystem, held_columns, panels_of

__all__ = ["FarTerrain", "far_terrain"]

_LOG = logging.getLogger(__name__)
_BROAD = 0.02
"""Standard deviation of an inverse range over its value beyond which its distribution is broad."""
_SPURIOUS = 2e-5
"""Share of the information about a stop's position that noise of ranges may feign before it is looked at."""
_MORE = 0.05
"""Feigned information, summed over directions in units of the true one of each, from which on it counts."""
_LEAST = 10
"""Least landmarks with a broad range."""
_ROUNDS = 60
_SETTLED = 0.05
"""Step in sigmas that ends the rounds."""
_NEAR = 0.3
"""Step in sigmas below which the distribution of ranges may depend on direction."""
_FIRST_ROUNDS = 10
"""Rounds after which it may depend on direction however large the step is, and after which a step that is no
shorter than the one before is taken by half, lest two states alternate."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FarTerrain:
    """A problem solved with derivatives at expected ranges."""

    problem: Problem
    """At the solution, landmarks where they fit best."""
    expected: Landmarks
    """The landmarks at their expected inverse ranges: where covariances are linearised."""
    converged: bool
    """Whether the rounds ended."""


def far_terrain(problem: Problem) -> FarTerrain | None:
    """The solution of a problem at its least-squares optimum that noise in ranges does not bias.

    None where that noise has next to no part in the system: the optimum then is the solution.
    """
    if not _may_matter(problem):
        return None
    placed = problem.placed()
    broad = _broad(placed, _ranges(placed))
    if int(broad.sum()) < _LEAST:
        return None
    prior = RangePrior()
    expected = _expected(placed, broad, prior)
    reduced = ReducedSystem.of(placed.at(placed.values, expected))
    feigned = _feigned(placed, reduced)
    _LOG.info("far terrain: %d landmarks of broad range feign %.2g of information", broad.sum(), feigned)
    if feigned < _MORE:
        return None
    return _solved(placed, broad, prior, reduced, expected)


def _solved(
    problem: Problem, broad: BoolArray, prior: RangePrior, reduced: ReducedSystem, expected: Landmarks
) -> FarTerrain:
    """Rounds of: step to where the gradient vanishes, ranges fitted there, and expected ranges again."""
    link = problem.template.linkage
    held = all_columns(link, held_columns(problem.template))
    before = np.inf
    for number in range(_ROUNDS):
        length = float(np.sqrt(2 * reduced.root.gain()))
        _LOG.debug("far terrain: round %d, step %.3g sigma", number, length)
        if not prior.is_divided and (length < _NEAR or number >= _FIRST_ROUNDS):
            # Not before: at the biased optimum, ranges follow the directions that the bias gives them.
            prior.is_divided = True
        elif length < _SETTLED:
            return FarTerrain(problem=problem, expected=expected, converged=True)
        alternates = number >= _FIRST_ROUNDS and length > 0.9 * before
        step = reduced.root.step() * (0.5 if alternates else 1.0)
        step[held], before = 0.0, length
        problem = problem.at(retracted(link, problem.values, step), problem.landmarks).placed()
        expected = _expected(problem, broad, prior)
        reduced = ReducedSystem.of(problem.at(problem.values, expected))
    return FarTerrain(problem=problem, expected=expected, converged=False)


def _may_matter(problem: Problem) -> bool:
    """Whether noise of ranges may feign a share of the information about some stop's position.

    A cheap test on all landmarks: 1 over the squared distance where parallax is one sigma, against the
    squared inverse range, summed over the observations of each stop.
    """
    m, kept = problem.measurements, problem.kept
    stop = problem.template.traverse.image_stop[m.image[kept]]
    landmark = m.landmark[kept]
    per_m = problem.landmarks.vector[:, 3] / problem.landmarks.length.clip(1e-300)
    noise = np.bincount(stop, (1 / reach_m(problem) ** 2)[landmark])
    signal = np.bincount(stop, (per_m**2)[landmark])
    return bool(np.any(noise > _SPURIOUS * signal))


def _ranges(problem: Problem) -> InverseRanges:
    return inverse_ranges(problem.landmarks, problem.measurements, problem.views, problem.accepted)


def _broad(problem: Problem, ranges: InverseRanges) -> BoolArray:
    """(landmarks,) whether a landmark takes part and its range is badly known."""
    return np.asarray(problem.present & (ranges.variance > (_BROAD * ranges.per_m) ** 2))


def _expected(problem: Problem, broad: BoolArray, prior: RangePrior) -> Landmarks:
    """Landmarks at their expected inverse ranges; those whose range is not broad stay as they are."""
    ranges = _ranges(problem)
    rows: IntArray = np.flatnonzero(broad)
    direction: FloatArray = problem.landmarks.vector[rows, :3] / problem.landmarks.length[rows, None]
    per_m = prior.expected(ranges.per_m[rows], ranges.variance[rows], direction)
    at = Landmarks(vector=problem.landmarks.vector[rows], origin_m=problem.landmarks.origin_m[rows])
    of_rows = InverseRanges(
        per_m=ranges.per_m[rows], variance=ranges.variance[rows], shift=ranges.shift[rows]
    )
    vector = problem.landmarks.vector.copy()
    vector[rows] = at_inverse_ranges(at, of_rows, per_m).vector
    return replace(problem.landmarks, vector=vector)


def _feigned(problem: Problem, reduced: ReducedSystem) -> float:
    """Information that fitted ranges add to that of the system at expected ones, in units of the latter.

    It is summed over all directions: the trace of the excess times the covariance. 0 where nothing holds a
    direction.
    """
    try:
        covariance = reduced.root.covariance()
    except FreeDirectionError:
        return 0.0
    return panels_of(problem).trace_with(covariance) - float(np.sum(problem.template.linkage.dim))
