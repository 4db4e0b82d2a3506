"""The problem of an adjustment, and the interface of its solvers."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.elimination import LandmarkSystem, StretchedSystem
from pancam_graph.graph import Factors, FactorTemplate, HardTemplate, LetGo
from pancam_graph.landmarks import SQUARED, CameraViews, Landmarks, Loss, Measurements, refine, residuals
from pancam_graph.solve._optimise import Iteration, Outcome
from pancam_graph.solve._stopping import StopRule
from pancam_graph.solve._ties import Ties

__all__ = ["EliminatedLandmarks", "Problem", "Solver", "reach_m", "system_of"]

EliminatedLandmarks = LandmarkSystem | StretchedSystem
"""The landmarks of a problem, in memory or stretch by stretch."""

_FURTHEST_PARALLAX_SIGMAS = 0.01
"""World points are no farther than the distance where their parallax is this many sigmas of a pixel."""
_LEAST_BASELINE_M = 2e-3
"""Least baseline of two cameras in limits of distance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Variables, landmarks and observations of an adjustment at one iterate."""

    template: FactorTemplate
    factors: Factors
    """Priors, ties and the caller's factors, on the template's variables."""
    measurements: Measurements
    accepted: BoolArray
    """(n,) whether a measurement is no outlier; it takes part if its landmark has two or more such"""
    values: gtsam.Values
    """Values of the template's variables."""
    landmarks: Landmarks
    ties: Ties | None = None
    """Constraints on landmarks, by the template's sensors; None: there are none."""
    stretches: int = 1
    """In how many stretches the drive is eliminated; 1: in one, in memory."""

    @cached_property
    def views(self) -> CameraViews:
        """Cameras at the values."""
        return self.template.views(self.values)

    @cached_property
    def present(self) -> BoolArray:
        """(landmarks,) whether two or more observations are accepted."""
        m = self.measurements
        return np.asarray(np.bincount(m.landmark, self.accepted, minlength=m.n_landmarks) >= 2)

    @cached_property
    def kept(self) -> BoolArray:
        """(n,) whether a measurement takes part."""
        return np.asarray(self.accepted & self.present[self.measurements.landmark])

    @cached_property
    def tied(self) -> BoolArray:
        """(ties,) whether each takes part: its landmark does, and it was not let go."""
        if self.ties is None:
            return np.zeros(0, dtype=bool)
        gone = self.ties.of_constraint & self.template.let_go.constraints[self.ties.constraint]
        return np.asarray(self.present[self.ties.landmark] & ~gone)

    @cached_property
    def sensed(self) -> tuple[FloatArray, BoolArray]:
        """Of `residuals`, those of the ties that take part: (k, 2), (k,)."""
        if self.ties is None:
            return np.zeros((0, 2)), np.zeros(0, dtype=bool)
        which = np.flatnonzero(self.tied)
        alone = self.ties.rows(self.tied, np.arange(self.measurements.n_landmarks))
        alone = replace(alone, landmark=np.arange(len(which)))  # a landmark of its own for each
        landmarks = self.landmarks.of(self.ties.landmark[which])
        return residuals(landmarks, alone, self.views_of_all)

    @cached_property
    def views_of_all(self) -> CameraViews:
        """Cameras at the values, with the template's sensors behind them."""
        sensors = self.template.sensors
        if sensors is None:
            return self.views
        masts = np.array([pose.translation() for pose in self.template.masts(self.values)])
        return sensors.behind(self.views, self.values, masts)

    def points_m(self) -> FloatArray:
        """World points (landmarks, 3), metres, none farther than the limit where noise hides parallax."""
        length, w = self.landmarks.length, self.landmarks.vector[:, 3]
        # Most landmarks are nearer than the least of these limits.
        beyond = length * _FURTHEST_PARALLAX_SIGMAS > w * _LEAST_BASELINE_M * _resolution(self)
        furthest = np.full(len(w), np.inf)
        furthest[beyond] = reach_m(self, beyond) / _FURTHEST_PARALLAX_SIGMAS
        return self.landmarks.points_m(furthest)

    def cost(self, loss: Loss = SQUARED) -> float:
        """True cost: half the sum of squares of `factors`, and the loss of observations that take part.

        Ties count as observations do.
        """
        if loss is SQUARED:
            return self._squared
        return self._cost(loss)

    @cached_property
    def _squared(self) -> float:
        return self._cost(SQUARED)

    def _cost(self, loss: Loss) -> float:
        residual, _ = self.residuals
        observed = loss.cost(residual)[self.kept].sum() + loss.cost(self.sensed[0]).sum()
        return float(self.factors.error(self.values) + observed)

    @cached_property
    def residuals(self) -> tuple[FloatArray, BoolArray]:
        """Whitened residuals (n, 2), and whether the landmark is in front of its camera (n,)."""
        return residuals(self.landmarks, self.measurements, self.views)

    def placed(self, loss: Loss = SQUARED) -> "Problem":
        """The problem with landmarks optimised for the present cameras, beyond infinity if need be."""
        m, weight = self.measurements, self.accepted.astype(float)
        if self.ties is not None and self.tied.any():
            joined, place = self.ties.behind(m, self.tied, np.arange(m.n_landmarks))
            weights = np.ones(len(joined.row))
            weights[place] = weight
            m, weight = joined, weights
        best = refine(self.landmarks, m, self.views_of_all, weight, loss, beyond_infinity=True)
        return self.having(landmarks=best)

    def on(self, template: FactorTemplate) -> "Problem":
        """The same problem on another template, with the nearest cameras that its variables allow."""
        template = template.letting_go(self.template.let_go)
        if isinstance(template, HardTemplate):
            template = template.sensing(self.template.sensors)
        values = template.values(self.template.state(self.values, np.zeros((0, 3)), self.views))
        if template.sensors is not None:
            template.sensors.insert(values, self.values)
        factors = template.factors(self.factors.given, present=self.values)
        return replace(self, template=template, factors=factors, values=values)

    def untied(self) -> "Problem":
        """The same problem without ties."""
        if self.ties is None:
            return self
        assert isinstance(self.template, HardTemplate)  # no other has sensors
        return replace(self, ties=None, template=self.template.sensing(None))

    def letting_go(self, let_go: LetGo) -> "Problem":
        """The same problem with telemetry and constraints believed less."""
        template, factors = self.template.letting_go(let_go), self.factors
        factors = replace(
            factors,
            telemetry=tuple(template.telemetry_priors()),
            seated=template.seated(factors.given, self.values) if factors.given else (),
        )
        return replace(self, template=template, factors=factors)

    def at(self, values: gtsam.Values, landmarks: Landmarks, views: CameraViews | None = None) -> "Problem":
        """The same problem at other values and landmarks; `views` are the cameras at the values, if known."""
        if values is self.values:
            return self.having(landmarks=landmarks)
        other = replace(self, values=values, landmarks=landmarks)
        return other if views is None else other.seen_by(views)

    def seen_by(self, views: CameraViews) -> "Problem":
        """The same problem, of which the cameras at its values are known already."""
        other = replace(self)
        other.__dict__["views"] = views
        return other

    def having(
        self,
        *,
        landmarks: Landmarks | None = None,
        measurements: Measurements | None = None,
        accepted: BoolArray | None = None,
    ) -> "Problem":
        """The same problem with other landmarks or observations: its cameras are not computed again."""
        other = replace(
            self,
            landmarks=self.landmarks if landmarks is None else landmarks,
            measurements=self.measurements if measurements is None else measurements,
            accepted=self.accepted if accepted is None else accepted,
        )
        of_cameras = ("views", "views_of_all")
        other.__dict__.update({name: self.__dict__[name] for name in of_cameras if name in self.__dict__})
        return other


def reach_m(problem: Problem, of: BoolArray | None = None) -> FloatArray:
    """Distance where the parallax over a landmark's cameras is one sigma of a pixel.

    `of` (landmarks,) is the mask of the landmarks wanted; default: all.
    """
    m, views = problem.measurements, problem.views
    rows = slice(None) if of is None else np.flatnonzero(of[m.landmark])
    landmark = m.landmark[rows]
    if len(landmark) == 0:
        return np.zeros(0)
    arm = views.world_t_camera.take(m.image[rows], axis=0)  # several times as fast as an index
    arm -= problem.landmarks.origin_m.take(landmark, axis=0)
    starts = m.starts if of is None else np.flatnonzero(np.diff(landmark, prepend=-1))
    longest = np.sqrt(np.maximum.reduceat(np.einsum("ij,ij->i", arm, arm), starts))
    baseline = (2 * longest).clip(_LEAST_BASELINE_M)
    return np.asarray(baseline * _resolution(problem))


def _resolution(problem: Problem) -> float:
    """Focal length over the typical sigma of a pixel: one over the angle, radians, of that sigma."""
    return problem.views.typical_focal_px / problem.measurements.typical_sigma_px


class Solver(ABC):
    """A method that minimises the cost of a problem."""

    def __init__(self, on_iteration: Callable[[Iteration], None] | None) -> None:
        self.on_iteration = on_iteration

    def require(self, template: FactorTemplate) -> None:  # noqa: B027  most ways have nothing to ask for
        """Raise InputError where a template does not suit this solver."""

    @abstractmethod
    def approach(self, problem: Problem, rule: StopRule, loss: Loss, stage: str) -> Problem:
        """The problem near the minimum of a robust loss, from poor initial values."""

    @abstractmethod
    def adjust(self, problem: Problem, rule: StopRule) -> tuple[Problem, Outcome]:
        """The problem at the least-squares optimum near its values."""


def system_of(
    problem: Problem,
    loss: Loss = SQUARED,
    cliques: Iterable[Iterable[int]] = (),
    *,
    last: int | None = None,
) -> tuple[EliminatedLandmarks, IntArray]:
    """The landmark system of the observations that take part, and the rows of its landmarks among all.

    `cliques` are further sets of groups between which its square root shall have blocks; `last` is a group
    that is eliminated last. Raises SolveError where no observation takes part.
    """
    m = problem.measurements
    take = problem.kept
    if not take.any():
        raise SolveError("observations: expected tracks that agree in two or more images, found none")
    rows = np.flatnonzero(np.bincount(m.landmark, take, minlength=m.n_landmarks))
    if not take.all():
        m = m.part(np.flatnonzero(take))
    if problem.ties is not None and problem.tied.any():
        number = np.full(problem.measurements.n_landmarks, -1)
        number[rows] = np.arange(len(rows))
        m, _ = problem.ties.behind(m, problem.tied, number)
    landmarks = Landmarks(vector=problem.landmarks.vector[rows], origin_m=problem.landmarks.origin_m[rows])
    template = problem.template
    cliques = [*template.cliques, *problem.factors.joined(template.linkage), *cliques]
    refined = template.refines_landmarks
    if problem.stretches > 1:
        stretched = StretchedSystem(
            template.linkage,
            m,
            landmarks,
            loss,
            stretches=problem.stretches,
            n_stops=len(template.traverse.stops),
            cliques=cliques,
            last=last,
            refined=refined,
        )
        return stretched, rows
    system = LandmarkSystem(template.linkage, m, landmarks, loss, cliques=cliques, last=last, refined=refined)
    return system, rows
