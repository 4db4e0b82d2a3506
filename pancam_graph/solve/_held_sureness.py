"""How far a rig that is held can be trusted: whether images confirm it, and what depends on it.

A rig that states an uncertainty P and is held counts as exact (H0). Had its numbers errors drawn from P
(H1), the images would say so with the odds of the two marginal likelihoods. With C the covariance of the
rig's numbers once images and P are together, and g the gradient of the cost by them, all else marginalised,

    log p(images | H0) - log p(images | H1)  =  1/2 log det(P C^-1) - 1/2 g' C g

(Kass and Raftery, Bayes factors, 1995, in the linearised system). Under H1 the solution has the variance of a
solve that estimates the rig, or more.
"""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import relative_pose_covariance
from pancam_graph.graph import HardTemplate, RigVariable, RigVariables
from pancam_graph.solve._covariance import Uncertainty, covariance_of
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._reduced import ReducedSystem
from pancam_graph.solve._rig_told import RigTold, reduced_to_rig

__all__ = ["HeldRig", "held_rig"]

_CONFIRMED = float(np.log(1e6))
"""Logarithm of the odds from which a part of the images is enough."""


@dataclass(frozen=True, kw_only=True)
class HeldRig:
    """What images say of a held rig that states an uncertainty."""

    log_odds: float
    """Logarithm of the odds that the rig is exact against that it is off as it says, from images alone."""
    growth: float
    """Largest ratio of a relative pan's, tilt's or stop's sigma with the rig estimated to its own; 1 where
    images confirm the rig."""
    what: str
    """Which one that is, in words."""

    @property
    def expected_growth(self) -> float:
        """Root of the mean square of `growth` over both cases, which are as likely before."""
        chance = 1 / (1 + np.exp(min(self.log_odds, 700.0)))
        return float(np.sqrt(1 + chance * (self.growth**2 - 1)))


def held_rig(problem: Problem, held: Uncertainty, told: RigTold | None) -> HeldRig | None:
    """What images say of a problem's held rig; `held` are the problem's uncertainties.

    `told` is `rig_told` of the problem. None for models but the rigid mast, for a rig that is exact or of
    which anything is free, and where the system is not determined.
    """
    if told is None or not told.stated.any_free:
        return None
    try:
        odds = _log_odds_of_part(told, RigVariables(told.rig.traverse, told.stated))
        if odds > _CONFIRMED:
            return HeldRig(log_odds=odds, growth=1.0, what="")
        wide = problem.on(HardTemplate(problem.template.traverse, told.stated))
        reduced = reduced_to_rig(wide)
        growth, what = _growth(problem, held, wide, reduced)
        return HeldRig(log_odds=_log_odds_of_whole(wide, reduced), growth=growth, what=what)
    except SolveError:
        return None


def _log_odds_of_part(told: RigTold, stated: RigVariables) -> float:
    """Of what a part of the images tells, with the priors of the rig's own uncertainty."""
    columns = np.array([told.column[v.quantity, v.eye, e] for v in _numbers(stated) for e in v.entries])
    return _log_odds(told.without_priors(columns) + _prior(stated), told.gradient[columns], stated)


def _log_odds_of_whole(wide: Problem, reduced: ReducedSystem) -> float:
    """Of a problem whose rig is free with its own uncertainty, at the values of the rig as told."""
    rig, link = wide.template.rig_variables, wide.template.linkage
    information, gradient = reduced.root.last_information()
    of_variables = (link.columns_of(v.key) for v in _numbers(rig))
    columns = np.concatenate([np.arange(c.start, c.stop) for c in of_variables])
    return _log_odds(information[np.ix_(columns, columns)], gradient[columns], rig)


def _log_odds(information: FloatArray, gradient: FloatArray, rig: RigVariables) -> float:
    """The formula above, of the information C^-1 (n, n) and the gradient (n,) in the order of `_numbers`."""
    sigma = np.concatenate([v.sigma for v in _numbers(rig)])
    unit = np.outer(sigma, sigma)
    try:
        root = np.linalg.cholesky(unit * information)
    except np.linalg.LinAlgError as error:
        raise SolveError("nothing holds a number of the rig") from error
    gained = 2 * np.log(np.diag(root)).sum() - np.linalg.slogdet(unit * _prior(rig))[1]
    pull = np.linalg.solve(root, sigma * gradient)
    return float(0.5 * gained - 0.5 * pull @ pull)


def _numbers(rig: RigVariables) -> list[RigVariable]:
    """What stops share: first the numbers of `RigVariables.prior_information`, then all others."""
    shared = rig.of_stop(None)
    return [*rig.numbers, *(v for v in shared if v.key not in rig.keys)]


def _prior(rig: RigVariables) -> FloatArray:
    """Information (n, n) of the priors of `_numbers`."""
    out = np.diag(np.concatenate([v.sigma for v in _numbers(rig)]) ** -2.0)
    if rig.keys:
        n = sum(len(v.entries) for v in rig.numbers)
        out[:n, :n] = rig.prior_information()
    return out


def _growth(problem: Problem, held: Uncertainty, wide: Problem, reduced: ReducedSystem) -> tuple[float, str]:
    """The largest ratio of sigmas with the rig free to those with it held.

    Of differences of frames next to each other at a stop, and of successive stops.
    """
    t, state = problem.template.traverse, problem.template.state(problem.values, np.zeros((0, 3)))
    assert held.variables is not None
    first = np.flatnonzero(np.diff(t.frame_stop) == 0)
    pairs = np.column_stack([first, first + 1])
    found = [(1.0, "")]
    both = (
        template.relative_angle_sigma_rad(covariance, state, pairs)
        for template, covariance in (
            (problem.template, held.variables),
            (wide.template, covariance_of(wide.template, reduced)),
        )
    )
    own, more = both
    for k, angle in enumerate(("pan", "tilt")):
        known = own[:, k] > 0
        if known.any():
            ratio = np.where(known, more[:, k] / np.where(known, own[:, k], 1.0), 0.0)
            i = int(np.argmax(ratio))
            names = (t.frames[pairs[i, j]].id for j in (0, 1))
            found.append((float(ratio[i]), f"{angle} from {' to '.join(names)}"))
    masts = wide.template.mast_covariance(reduced.root)
    for i in range(len(t.stops) - 1):
        a, b = state.world_T_mast[i : i + 2]
        pair = [joint.of(i, i + 1) for joint in (held.masts, masts) if joint is not None]
        apart, wider = (np.diag(relative_pose_covariance(a, b, joint)) for joint in pair)
        ratio = np.sqrt(np.where(apart > 0, wider / np.where(apart > 0, apart, 1.0), 1.0))
        found.append((float(ratio.max()), f"the pose of {t.stops[i + 1].id} from {t.stops[i].id}"))
    return max(found)
