"""What a solver of either kind is given and returns."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph._optimise import Iteration, Outcome, StopRule
from pancam_graph.elimination import LandmarkSystem
from pancam_graph.errors import SolveError
from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.graph import FactorTemplate
from pancam_graph.landmarks import CameraViews, Landmarks, Measurements, refine, residuals
from pancam_graph.losses import SQUARED, Loss

__all__ = ["Problem", "Solver", "reach_m", "system_of", "typical_sigma_px"]

_FURTHEST_PARALLAX_SIGMAS = 0.01
"""Points are placed no further out than where their parallax is this many sigmas of a pixel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Cameras, landmarks and observations at one moment of a solve."""

    template: FactorTemplate
    factors: gtsam.NonlinearFactorGraph
    """The template's: priors and ties."""
    measurements: Measurements
    accepted: BoolArray
    """(n,) measurements that take part, but for those of landmarks with fewer than two of them"""
    values: gtsam.Values
    """The template's variables."""
    landmarks: Landmarks

    @property
    def views(self) -> CameraViews:
        """Cameras at the values."""
        return self.template.views(self.values)

    @property
    def present(self) -> BoolArray:
        """(landmarks,) which have two accepted observations or more."""
        m = self.measurements
        return np.asarray(np.bincount(m.landmark, self.accepted, minlength=m.n_landmarks) >= 2)

    @property
    def kept(self) -> BoolArray:
        """(n,) measurements that take part."""
        return np.asarray(self.accepted & self.present[self.measurements.landmark])

    def points_m(self) -> FloatArray:
        """World points (landmarks, 3), none further than where parallax tells nothing."""
        return self.landmarks.points_m(reach_m(self) / _FURTHEST_PARALLAX_SIGMAS)

    def cost(self, loss: Loss = SQUARED) -> float:
        """True cost: half the squares of priors and ties, and the loss of what takes part."""
        residual, _ = self.residuals()
        return float(self.factors.error(self.values) + loss.cost(residual)[self.kept].sum())

    def residuals(self) -> tuple[FloatArray, BoolArray]:
        """Whitened residuals (n, 2), and whether the landmark is in front of its camera (n,)."""
        return residuals(self.landmarks, self.measurements, self.views)

    def placed(self, loss: Loss = SQUARED) -> "Problem":
        """Landmarks where they fit best with the cameras as they are, be it beyond infinity."""
        weight = self.accepted.astype(float)
        best = refine(self.landmarks, self.measurements, self.views, weight, loss, beyond_infinity=True)
        return replace(self, landmarks=best)

    def on(self, template: FactorTemplate) -> "Problem":
        """The same with other variables, cameras as near to where they are as these allow."""
        values = template.values(self.template.state(self.values, np.zeros((0, 3))))
        return replace(self, template=template, factors=template.factors(), values=values)

    def at(self, values: gtsam.Values, landmarks: Landmarks) -> "Problem":
        """The same elsewhere."""
        return replace(self, values=values, landmarks=landmarks)


def reach_m(problem: Problem) -> FloatArray:
    """Distance (landmarks,) where the parallax over a landmark's cameras is one sigma of a pixel."""
    m, views = problem.measurements, problem.views
    arm = np.linalg.norm(views.world_t_camera[m.image] - problem.landmarks.origin_m[m.landmark], axis=1)
    baseline = 2 * np.maximum.reduceat(arm, m.starts).clip(1e-3)
    focal = float(np.median(views.calibration[:, 0, 0]))
    return np.asarray(baseline * focal / typical_sigma_px(m))


def typical_sigma_px(measurements: Measurements) -> float:
    """Median standard deviation of a measurement's coordinate."""
    w = measurements.whitening
    return float(np.median(1 / np.sqrt(np.abs(w[:, 0, 0] * w[:, 1, 1] - w[:, 0, 1] * w[:, 1, 0]))))


class Solver(ABC):
    """A way to treat landmarks."""

    def __init__(self, on_iteration: Callable[[Iteration], None] | None) -> None:
        self.on_iteration = on_iteration

    @abstractmethod
    def approach(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> Problem:
        """The problem about where a robust loss is least, however far that is."""

    @abstractmethod
    def adjust(self, problem: Problem, rule: StopRule) -> tuple[Problem, Outcome]:
        """The problem at the least-squares optimum near by."""

    def system(self, problem: Problem) -> tuple[LandmarkSystem, IntArray]:
        """The landmark system of what takes part, and its rows among the landmarks."""
        return system_of(problem)


def system_of(
    problem: Problem, loss: Loss = SQUARED, cliques: Iterable[Iterable[int]] = ()
) -> tuple[LandmarkSystem, IntArray]:
    """The landmark system of what takes part, and its rows among the landmarks.

    `cliques` are more groups of variables between which its square root is to have room. Raises SolveError
    where nothing is left.
    """
    m = problem.measurements
    take = problem.kept
    if not take.any():
        raise SolveError("observations: expected tracks that agree in two or more images, found none")
    rows = np.flatnonzero(np.bincount(m.landmark, take, minlength=m.n_landmarks))
    if not take.all():
        m = m.part(np.flatnonzero(take))
    landmarks = Landmarks(vector=problem.landmarks.vector[rows], origin_m=problem.landmarks.origin_m[rows])
    template = problem.template
    cliques = [*template.cliques, *cliques]
    return LandmarkSystem(template.linkage, m, landmarks, loss, cliques=cliques), rows
