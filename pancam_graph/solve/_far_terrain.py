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
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.elimination import FreeDirectionError, Panels
from pancam_graph.landmarks import InverseRanges, Landmarks, at_inverse_ranges, inverse_ranges
from pancam_graph.solve._joint import all_columns, retracted
from pancam_graph.solve._problem import Problem, reach_m
from pancam_graph.solve._range_prior import RangePrior
from pancam_graph.solve._reduced import panels_of

__all__ = ["FarTerrain", "far_terrain"]

_LOG = logging.getLogger(__name__)
_BROAD = 0.02
"""Standard deviation of an inverse range over its value beyond which its distribution is broad."""
_SPURIOUS = 2e-5
"""Share of the information about a stop's position that noise of ranges may feign before it is looked at."""
_MORE = 0.05
"""Feigned information, summed over directions in units of the true one of each, from which on it counts."""
_FAINTEST = 1e-8
"""Share of a diagonal entry of the system that each direction counts as known to as excess is weighed."""
_LEAST = 10
"""Least landmarks with a broad range."""
_ROUNDS = 100
_SETTLED = 0.05
"""Step in sigmas that ends the rounds."""
_NEAR = 0.3
"""Step in sigmas below which the distribution of ranges is learnt anew, and may depend on direction."""
_LEARNT = 3
"""How often it is learnt anew at most: then, and where rounds have settled."""
_DOUBTFUL, _MOST_DOUBT = 0.2, 0.7
"""Shares of the information of a direction: the least that counts, and the most that is taken off."""
_MOST_GROUPS = 1
"""Groups of variables, at most, of which information is taken off."""
_FIRST_ROUNDS = 10
"""Rounds after which it may depend on direction however large the step is, and steps are short."""
_LONGER = 4.0
"""By how much a short step is longer than its direction's last one, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FarTerrain:
    """A problem solved with derivatives at expected ranges."""

    problem: Problem
    """At the solution, landmarks where they fit best."""
    expected: Landmarks
    """The landmarks at their expected inverse ranges: where covariances are linearised."""
    doubt: Mapping[int, FloatArray]
    """By group of variables, (n, n) information of the system that the ranges do not bear out."""
    converged: bool
    """Whether the rounds ended."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Expected:
    """Inverse ranges that are expected, beside those fitted."""

    ranges: InverseRanges
    """As fitted."""
    per_m: FloatArray
    """(landmarks,) expected; those fitted where the range is not broad"""
    follows: FloatArray
    """(landmarks,) variance of the fitted one times the derivative of the expected one by it; 0 likewise"""
    landmarks: Landmarks
    """At the expected ones."""


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
    system = panels_of(placed.at(placed.values, expected.landmarks))
    feigned = _feigned(placed, system)
    _LOG.info("far terrain: %d landmarks of broad range feign %.2g of information", broad.sum(), feigned)
    if feigned < _MORE:
        return None
    return _solved(placed, broad, prior, expected, system)


def _solved(
    problem: Problem, broad: BoolArray, prior: RangePrior, known: _Expected, system: Panels
) -> FarTerrain:
    """Rounds of: step to where the gradient vanishes, ranges fitted there, and expected ranges again.

    `system` is that at the ranges that are expected first.
    """
    link = problem.template.linkage
    held = all_columns(link, problem.template.held_by_group)
    root, short = system.copy().root(), _ShortSteps()
    learnt = 0
    for number in range(_ROUNDS):
        length = float(np.sqrt(2 * root.gain()))
        _LOG.debug("far terrain: round %d, step %.3g sigma", number, length)
        near = length < (_SETTLED if learnt else _NEAR) or (not learnt and number >= _FIRST_ROUNDS)
        if near and learnt < _LEARNT:
            # A distribution learnt far from the solution keeps traces of the bias there.
            prior, learnt = RangePrior(is_divided=True), learnt + 1
            known = _expected(problem, broad, prior)
            system = panels_of(problem.at(problem.values, known.landmarks))
            root, short = system.copy().root(), _ShortSteps()
            length = float(np.sqrt(2 * root.gain()))
        if length < _SETTLED:
            break
        step = root.step() if number < _FIRST_ROUNDS else short.next(system, panels_of(problem))
        step[held] = 0.0
        problem = problem.at(retracted(link, problem.values, step), problem.landmarks).placed()
        known = _expected(problem, broad, prior)
        system = panels_of(problem.at(problem.values, known.landmarks))
        root = system.copy().root()
    return FarTerrain(
        problem=problem,
        expected=known.landmarks,
        doubt=_doubt(problem, known),
        converged=length < _SETTLED,
    )


class _ShortSteps:
    """Steps that do not overshoot where few landmarks of no known range tell of a direction.

    The slope of the gradient there is A(g)'N A(q^), which may exceed A(g)'N A(g) many times. It never exceeds
    the mean of the systems at both ranges, which takes its place. In other directions the slope may be a
    hundredth of that mean: what a step leaves of itself tells how much longer the next one may be (Barzilai
    and Borwein 1988, in the metric of the mean).
    """

    def __init__(self) -> None:
        self._last: FloatArray | None = None
        self._longer = 1.0

    def next(self, system: Panels, fitted: Panels) -> FloatArray:
        """The step (columns,) from where the systems at expected and at fitted ranges are these."""
        mean = system.copy()
        for panel, other in zip(mean.panel, fitted.panel, strict=True):
            panel[:, :-1] = 0.5 * (panel[:, :-1] + other[:, :-1])
        step = mean.copy().root().step()
        if self._last is not None and self._last.any():
            metric = mean.times(self._last[:, None])[:, 0]
            gone = 1 - float(step @ metric) / float(self._last @ metric)
            most = _LONGER * self._longer
            self._longer = min(max(self._longer / gone, 1.0), most) if gone > 0 else most
        self._last = step
        return self._longer * step


def _may_matter(problem: Problem) -> bool:
    """Whether noise of ranges may feign a share of the information about some stop's position.

    A cheap test on all landmarks: 1 over the squared distance where parallax is one sigma, against the
    squared inverse range, summed over the observations of each stop.
    """
    m = problem.measurements
    kept = slice(None) if problem.kept.all() else np.flatnonzero(problem.kept)
    stop = problem.template.traverse.image_stop[m.image[kept]]
    landmark = m.landmark[kept]
    per_m = problem.landmarks.vector[:, 3] / problem.landmarks.length.clip(1e-300)
    noise = np.bincount(stop, (1 / reach_m(problem) ** 2)[landmark])
    signal = np.bincount(stop, (per_m**2)[landmark])
    return bool(np.any(noise > _SPURIOUS * signal))


def _ranges(problem: Problem) -> InverseRanges:
    return inverse_ranges(problem.landmarks, problem.measurements, problem.views, problem.accepted)


def _broad(problem: Problem, ranges: InverseRanges) -> BoolArray:
    """(landmarks,) whether a landmark takes part and its range is badly known; a tied one's is not."""
    free = problem.present.copy()
    if problem.ties is not None:
        free[problem.ties.landmark[problem.tied]] = False
    return np.asarray(free & (ranges.variance > (_BROAD * ranges.per_m) ** 2))


def _expected(problem: Problem, broad: BoolArray, prior: RangePrior) -> _Expected:
    """Expected inverse ranges of the landmarks whose range is broad; the others stay as they are."""
    ranges, rows = _ranges(problem), np.flatnonzero(broad)
    direction = problem.landmarks.vector[rows, :3] / problem.landmarks.length[rows, None]
    per_m, follows = ranges.per_m.copy(), np.zeros(len(broad))
    per_m[rows], follows[rows] = prior.expected(ranges.per_m[rows], ranges.variance[rows], direction)
    return _Expected(
        ranges=ranges, per_m=per_m, follows=follows, landmarks=_at(problem, ranges, per_m).landmarks
    )


def _at(problem: Problem, ranges: InverseRanges, per_m: FloatArray) -> Problem:
    """A problem with landmarks at other inverse ranges; those at the fitted ones stay bit for bit."""
    moved = at_inverse_ranges(problem.landmarks, ranges, per_m).vector
    stays = (per_m == ranges.per_m)[:, None]
    vector = np.where(stays, problem.landmarks.vector, moved)
    return problem.at(problem.values, replace(problem.landmarks, vector=vector))


def _doubt(problem: Problem, expected: _Expected) -> dict[int, FloatArray]:
    """Information K of the gradient beyond its slope J, by group, where it is a good part of the whole.

    K = sum A(g)'N A(g) is the variance of the gradient, J = sum A(g)'N A(q) its slope, which the fitted
    ranges tell without bias: A(g)'N A(q^) less v dg/dq^ times the product of the slopes of A (Stein 1981).
    Both are quadratic in ranges, so systems at three ranges give J. Along an eigenvector where K - J is a
    share d of the information with priors, the variance is 1 / (1 - d)^2 of what K says.
    """
    q, g = expected.ranges.per_m, expected.per_m
    middle, apart = 0.5 * (g + q), np.sqrt(0.25 * (g - q) ** 2 + expected.follows)
    at = [panels_of(_at(problem, expected.ranges, x)) for x in (g, middle, middle + apart, middle - apart)]
    excess = at[0].copy()
    for which, factor in ((1, -2.0), (2, 0.5), (3, 0.5)):
        for panel, other in zip(excess.panel, at[which].panel, strict=True):
            np.add(panel, factor * other, out=panel)
    out: dict[int, FloatArray] = {}
    # One group after the other, the most doubtful first: what several share is not taken off twice.
    for _ in range(_MOST_GROUPS):
        group, less, settled = _most_doubtful(problem, at[0], excess)
        if len(less) == 0:
            break
        at[0].panel[group][:, : len(less)] -= less
        try:
            at[0].copy().root().covariance()
        except FreeDirectionError:  # in rounding, what is left would hold nothing
            break
        excess.panel[group][:, : len(less)] -= settled
        out[group] = out.get(group, 0.0) + less
    return out


def _most_doubtful(problem: Problem, system: Panels, excess: Panels) -> tuple[int, FloatArray, FloatArray]:
    """The group with the largest share of excess information in its own, what to take off, and its excess.

    What to take off is empty where no share counts.
    """
    link, root = problem.template.linkage, system.copy().root()
    most, group, less, settled = _DOUBTFUL, 0, np.zeros((0, 0)), np.zeros((0, 0))
    for g in np.flatnonzero(link.group_dim).tolist():
        n, first = int(link.group_dim[g]), int(link.group_column[g])
        try:
            columns = root.inverse_columns(g, slice(0, n))
        except FreeDirectionError:
            return 0, np.zeros((0, 0)), np.zeros((0, 0))
        covariance = columns[first : first + n]
        # The whole system as it follows the group, and its excess information there.
        moves: FloatArray = np.asarray(np.linalg.solve(covariance, columns.T).T)
        share, direction = _shares(moves.T @ excess.times(moves), covariance)
        if share[-1] > most:
            doubtful = share > _DOUBTFUL
            information = np.linalg.solve(covariance, direction[:, doubtful])
            taken = 1 - (1 - share[doubtful].clip(max=_MOST_DOUBT)) ** 2
            most, group = float(share[-1]), g
            less = (taken * information) @ information.T
            settled = (share[doubtful] * information) @ information.T
    return group, less, settled


def _shares(information: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shares (n,) of information in the inverse of a covariance, and their directions (n, n) of one sigma."""
    scale = np.sqrt(np.diag(covariance).clip(1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    unit = scale[:, None] * vectors * np.sqrt(values.clip(0.0))
    share, turn = np.linalg.eigh(unit.T @ (information + information.T) @ unit / 2)
    return share, unit @ turn


def _feigned(problem: Problem, expected: Panels) -> float:
    """Information that fitted ranges add to that of the system `expected`, in units of the latter.

    It is summed over all directions: the trace of the excess times the covariance. Each direction counts as
    known to a share of its diagonal at least, since rounding errors of both systems are no excess.
    """
    fitted, excess, system = panels_of(problem), expected.copy(), expected.copy()
    for panel, more in zip(excess.panel, fitted.panel, strict=True):
        np.subtract(more, panel, out=panel)
    system.damp(_FAINTEST)
    try:
        return excess.trace_with(system.root().covariance())
    except FreeDirectionError:  # where even so nothing holds a direction
        return 0.0
