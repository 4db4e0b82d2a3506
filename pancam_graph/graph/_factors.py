"""The factors of a problem, kept apart by what they are."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import gtsam

from pancam_graph.elimination import Linkage
from pancam_graph.graph._given import GivenFactor

__all__ = ["FactorList", "Factors", "graph_of"]

FactorList = list[gtsam.NonlinearFactor]


@dataclass(frozen=True, kw_only=True, eq=False)
class Factors:
    """All factors of a problem but those of landmarks, on the variables of one template."""

    priors: tuple[gtsam.NonlinearFactor, ...]
    """What telemetry, odometry and the rig's own priors say."""
    ties: tuple[gtsam.NonlinearFactor, ...] = ()
    """What joins camera poses, or projection matrices, to the mast."""
    given: tuple[GivenFactor, ...] = ()
    """Factors of the caller's, on the keys that the caller knows."""
    seated: tuple[gtsam.NonlinearFactor, ...] = ()
    """The same on the template's own variables; fewer where all variables of one are held."""

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All of them: priors, ties, given factors."""
        return graph_of((*self.priors, *self.ties, *self.seated))

    def joined(self, linkage: Linkage) -> list[set[int]]:
        """Groups of variables that each given factor joins."""
        return [{int(linkage.group[linkage.row[key]]) for key in list(one.keys())} for one in self.seated]

    def error(self, values: gtsam.Values) -> float:
        """Cost at values of the template's variables: half the sum of squared whitened residuals."""
        return float(self.graph.error(values))

    def linearize(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """All of them, linearised at values of the template's variables."""
        return self.graph.linearize(values)


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """A GTSAM graph of some factors, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph
