"""The factors of a problem, grouped by kind."""

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

    telemetry: tuple[gtsam.NonlinearFactor, ...]
    """Priors of masts and angles, and motions from stop to stop."""
    ties: tuple[gtsam.NonlinearFactor, ...] = ()
    """Factors that tie camera poses, or projection matrices, to the mast; loose priors of terrain points."""
    rig: tuple[gtsam.NonlinearFactor, ...] = ()
    """Priors of free entries of the rig."""
    given: tuple[GivenFactor, ...] = ()
    """The caller's factors, on the keys that the caller knows."""
    seated: tuple[gtsam.NonlinearFactor, ...] = ()
    """The caller's factors on the template's variables; without those whose variables are all held."""

    @property
    def priors(self) -> tuple[gtsam.NonlinearFactor, ...]:
        """Priors of telemetry and of the rig."""
        return (*self.telemetry, *self.rig)

    @property
    def all(self) -> tuple[gtsam.NonlinearFactor, ...]:
        """All factors, on the template's variables."""
        return (*self.telemetry, *self.ties, *self.rig, *self.seated)

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors as a graph."""
        return graph_of(self.all)

    def joined(self, linkage: Linkage) -> list[set[int]]:
        """Groups of variables that each given factor joins."""
        return [{int(linkage.group[linkage.row[key]]) for key in list(one.keys())} for one in self.seated]

    def error(self, values: gtsam.Values) -> float:
        """Cost at values of the template's variables: half the sum of squared whitened residuals."""
        return float(self.graph.error(values))

    def linearize(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """All factors, linearised at values of the template's variables."""
        return self.graph.linearize(values)


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """A GTSAM graph of some factors, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph
