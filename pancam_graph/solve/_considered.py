"""Uncertainties of a solution whose rig was held, with the rig's own uncertainty in them.

Consider covariance (Bierman, Factorization methods for discrete sequential estimation, 1977, chapter 8): with
x estimated (the flex of frames with their pans and tilts) and the rig's numbers r held at their values, whose
covariance is P, an error of r moves the optimum by G = -H_xx^-1 H_xr. So x has the covariance
H_xx^-1 + G P G', and with r the joint one that is the inverse of

    [ H_xx    H_xr                        ]
    [ H_rx    P^-1 + H_rx H_xx^-1 H_xr    ]

Its square root serves all that the one of an estimated rig serves: stops, angles, points, pairs of stops.
"""

from dataclasses import replace

import numpy as np
import scipy

from pancam_graph.data import FIXED, State, sharing_within
from pancam_graph.graph import HardTemplate
from pancam_graph.landmarks import Landmarks
from pancam_graph.solve._covariance import Uncertainty, uncertainty
from pancam_graph.solve._fit import Fitted
from pancam_graph.solve._prepare import template_for
from pancam_graph.solve._problem import Problem, system_of
from pancam_graph.solve._reduced import ReducedSystem, landmark_panels

__all__ = ["considered", "with_rig"]


def considered(
    fitted: Fitted, problem: Problem, state: State, held: Uncertainty, *, landmarks: Landmarks | None
) -> Uncertainty:
    """The uncertainties `held` of a problem with its rig held, enlarged by what the rig says of itself.

    `problem` and `landmarks` are as `uncertainty` takes them. The same object where the rig is exact. Raises
    SolveError where a direction is undetermined.
    """
    system = with_rig(fitted, problem)
    if system is None:
        return held
    wide, reduced = system
    wide_state = replace(state, rig=wide.template.correction(wide.values))
    more = uncertainty(wide, wide_state, reduced, landmarks=landmarks, unseen=False)
    return replace(more, undetermined=held.undetermined, rig_sigmas=held.rig_sigmas)


def with_rig(fitted: Fitted, problem: Problem) -> tuple[Problem, ReducedSystem] | None:
    """A problem with its rig held, with the rig's numbers as variables, and its consider covariance's system.

    `problem` is as `regular_problem` gives it. None where the rig is exact.
    """
    prepared = fitted.screened.prepared
    sharing = sharing_within(prepared.traverse.rig.uncertainty, prepared.options.model)
    if not replace(sharing, flex=FIXED).any_free:
        return None
    if isinstance(problem.template, HardTemplate):
        wide = problem.on(HardTemplate(prepared.traverse, sharing))
    else:  # its tie is its flex
        wide = problem.on(template_for(prepared.traverse, prepared.options, replace(sharing, flex=FIXED)))
    system, rows = system_of(wide)
    panels = landmark_panels(wide, system, without=fitted.doubt)
    rig, link = len(prepared.traverse.stops), wide.template.linkage
    spread = panels.copy().root().covariance().block(rig, rig)
    variables = wide.template.rig_variables
    prior = np.zeros((len(spread), len(spread)))
    for v in variables.of_stop(None):
        columns = link.columns_of(v.key)
        prior[columns, columns] = np.diag(v.sigma**-2.0)
    if variables.keys:  # which may hang together
        order = np.concatenate([np.arange(c.start, c.stop) for c in map(link.columns_of, variables.keys)])
        prior[np.ix_(order, order)] = variables.prior_information()
    own = panels.panel[rig][:, : len(spread)]
    upper = np.triu(own)
    # What is left of the rig's own block once all else is eliminated is the inverse of its covariance.
    told = upper + np.triu(upper, 1).T - scipy.linalg.inv(spread)
    own[:] = (told + told.T) / 2 + prior
    return wide, ReducedSystem.by_root(system, rows, panels.root())
