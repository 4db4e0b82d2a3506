"""How far a solution is from each of its constraints, in units of what their sigmas and all else allow.

A constraint's whitened residual r has the covariance Q = I - A C A' if everything is as stated: A is its
Jacobian, C the covariance of the solution. r'Q^-1 r is chi-square (Baarda 1968).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import (
    FrameDirection,
    FramePoint,
    LandmarkAzimuth,
    LandmarkElevation,
    LandmarkInfinity,
    StopHeading,
    StopPose,
    VerdictTest,
)
from pancam_graph.elimination import Covariance, RowSpread
from pancam_graph.graph import Kind, key_of
from pancam_graph.landmarks import CameraViews, Landmarks, Measurements, evaluate, residuals
from pancam_graph.solve._chances import CHANCE, rms_limit
from pancam_graph.solve._problem import Problem
from pancam_graph.solve._reduced import ReducedSystem

__all__ = ["ConstraintTest", "constraint_tests", "constraint_verdict"]

_BLIND = 1e-8
"""Share of a constraint's error that shows in its residual, below which all else says nothing of it."""
_NAMED = 6
"""Constraints that a sentence names."""
_SHIFT_M = 1e-4
"""Shift of a mast by which a sensor's derivative is a difference: far below ranges, above rounding."""


@dataclass(frozen=True, kw_only=True)
class ConstraintTest:
    """One constraint, and what the solution says of it."""

    row: int
    """Row of the traverse's constraint."""
    about: str
    """Its kind, and what it is about."""
    robust: bool
    let_go: bool
    """Whether it took no part: the residual is then that of a prediction."""
    sigmas: float
    """Size of the residual in the constraint's own sigmas: of several rows the RMS."""
    size: float
    """Length of the residual before whitening, in its unit."""
    unit: str
    """`m`, `degrees`, or empty where rows have several."""
    square: float
    """r'Q^-1 r over the directions that show."""
    freedom: int
    """Number of these."""

    @property
    def misfit(self) -> float:
        """Residual over what is allowed (RMS); 0 where all else says nothing of the constraint."""
        return float(np.sqrt(self.square / self.freedom)) if self.freedom else 0.0

    def limit(self, n: int) -> float:
        """What `misfit` of the worst of n such exceeds by chance."""
        return float(rms_limit(max(self.freedom, 1), CHANCE / n))

    @property
    def says(self) -> str:
        """In words."""
        by = f"{self.sigmas:.3g} sigma"
        if self.unit:
            by = f"{self.size:.3g} {self.unit}, {by}"
        return f"constraints[{self.row}] ({self.about}) is off by {by}"


def constraint_tests(
    problem: Problem, reduced: ReducedSystem | None, covariance: Covariance | None
) -> list[ConstraintTest]:
    """A test of every constraint, also of those let go; none where covariances are unknown."""
    if reduced is None or covariance is None:
        return []
    return [*_of_stops(problem, covariance), *_of_landmarks(problem, reduced, covariance)]


def _of_stops(problem: Problem, covariance: Covariance) -> Iterator[ConstraintTest]:
    values, link = problem.values, problem.template.linkage
    nothing = np.zeros_like(problem.template.let_go.constraints)
    template = problem.template.letting_go(replace(problem.template.let_go, constraints=nothing))
    for one in problem.factors.given:
        if one.constraint is None:
            continue
        if not _is_seen(problem, one.constraint):
            yield _test(problem, one.constraint, np.full(1, np.nan), np.full(1, np.nan), None)
            continue
        (factor,) = template.seated([one], values)
        linear = factor.linearize(values)
        jacobian, minus_residual = linear.jacobian()
        place = [(int(link.group[link.row[key]]), link.columns_of(key)) for key in list(linear.keys())]
        spread: FloatArray | None = None
        # Groups that nothing else joins have no covariance.
        if not problem.template.let_go.constraints[one.constraint] or len({g for g, _ in place}) == 1:
            joint = np.block([[covariance.block(g, h)[a, b] for h, b in place] for g, a in place])
            spread = jacobian @ joint @ jacobian.T
        noise = one.factor.noiseModel()  # type: ignore[attr-defined]  # every one has a model
        raw = noise.unwhiten(-minus_residual)
        yield _test(problem, one.constraint, -minus_residual, raw, spread)


def _is_seen(problem: Problem, constraint: int) -> bool:
    """Whether all terrain points that a factor joins take part."""
    traverse = problem.template.traverse
    tracks = {traverse.track_of(landmark) for landmark in traverse.constraints[constraint].landmarks}
    if problem.ties is None or not tracks:
        return True
    sensors = problem.template.sensors
    assert sensors is not None
    seen = sensors.track[sensors.point[problem.tied & ~problem.ties.of_constraint]]
    return tracks.issubset(seen.tolist())


def _of_landmarks(
    problem: Problem, reduced: ReducedSystem, covariance: Covariance
) -> Iterator[ConstraintTest]:
    ties, template = problem.ties, problem.template
    if ties is None:
        return
    assert template.sensors is not None
    present = problem.present[ties.landmark]
    which = np.flatnonzero(present)
    alone = replace(ties.rows(present, np.arange(len(problem.present))), landmark=np.arange(len(which)))
    landmarks, views = problem.landmarks.of(ties.landmark[which]), problem.views_of_all
    residual, b, _ = evaluate(landmarks, alone, views)
    by_place = _by_place(landmarks, alone, views)
    spreads = RowSpread(reduced.system, covariance)
    number = np.searchsorted(reduced.rows, ties.landmark[which])
    for constraint in dict.fromkeys(ties.constraint[ties.of_constraint].tolist()):
        rows = np.flatnonzero(ties.constraint[which] == constraint)
        if not len(rows):
            yield _test(problem, constraint, np.full(1, np.nan), np.full(1, np.nan), None)
            continue
        weight = np.einsum("ijj->ij", alone.whitening[rows]).ravel()
        told = weight > 0
        r, B = residual[rows].ravel()[told], b[rows].reshape(-1, 3)[told]
        stop = int(template.sensors.stop[which[rows[0]]])
        moves: list[tuple[int, FloatArray]] = []
        if stop >= 0 and (key := key_of(Kind.MAST, stop)) in template.linkage.row:
            rotation = template.masts(problem.values)[stop].rotation().matrix()
            by_mast = by_place[rows].reshape(-1, 3)[told] @ rotation
            moves = [(key, np.hstack([np.zeros_like(by_mast), by_mast]))]
        spread: FloatArray | None = None
        # Without the constraint nothing may join the landmark and the stop.
        if not (template.let_go.constraints[constraint] and moves):
            spread = spreads.of(int(number[rows[0]]), B, moves)
        yield _test(problem, constraint, r, r / weight[told], spread)


def _by_place(landmarks: Landmarks, alone: Measurements, views: CameraViews) -> FloatArray:
    """Derivatives (k, 2, 3) of residuals by the sensors' places."""
    out = []
    for axis in np.eye(3):
        ends = [
            residuals(landmarks, alone, replace(views, world_t_camera=views.world_t_camera + shift * axis))[0]
            for shift in (_SHIFT_M, -_SHIFT_M)
        ]
        out.append((ends[0] - ends[1]) / (2 * _SHIFT_M))
    return np.stack(out, axis=2)


def _test(
    problem: Problem, row: int, residual: FloatArray, raw: FloatArray, spread: FloatArray | None
) -> ConstraintTest:
    """The test of a residual (k,), whitened and raw, whose prediction has this covariance (k, k)."""
    one, gone = problem.template.traverse.constraints[row], bool(problem.template.let_go.constraints[row])
    square, freedom = 0.0, 0
    if spread is not None:
        known = np.eye(len(residual)) + (spread if gone else -spread)
        values, vectors = np.linalg.eigh((known + known.T) / 2)
        shows = values > _BLIND
        freedom = int(shows.sum())
        square = float(np.sum((vectors[:, shows].T @ residual) ** 2 / values[shows]))
    size, unit = float(np.linalg.norm(raw)), "m"
    if isinstance(one, StopPose | LandmarkInfinity | FramePoint):
        unit = ""
    elif isinstance(one, LandmarkAzimuth | LandmarkElevation | StopHeading | FrameDirection):
        size, unit = float(np.degrees(size)), "degrees"
    return ConstraintTest(
        row=row,
        about=one.about,
        robust=one.robust,
        let_go=gone,
        sigmas=float(np.sqrt(np.mean(residual**2))),
        size=size,
        unit=unit,
        square=square,
        freedom=freedom,
    )


def constraint_verdict(tests: Sequence[ConstraintTest]) -> Iterator[VerdictTest]:
    """What constraints say of a solution; nothing where there are none."""
    if not tests:
        return
    unused = [one for one in tests if not np.isfinite(one.sigmas)]
    if unused:
        names = "; ".join(f"constraints[{one.row}] ({one.about})" for one in unused[:_NAMED])
        yield VerdictTest.of(
            "constraints unused",
            float(len(unused)),
            0.0,
            "",
            f"{len(unused)} constraints are on points none of whose observations agree: {names}",
        )
    kept = [one for one in tests if not one.let_go and np.isfinite(one.sigmas)]
    if kept:
        worst = max(kept, key=lambda one: one.misfit / one.limit(len(kept)))
        says = (
            f"largest residual of {len(kept)} constraints: {worst.says}, {worst.misfit:.3g} times what all "
        )
        yield VerdictTest.of(
            "constraints",
            worst.misfit,
            worst.limit(len(kept)),
            f"{says}sigmas allow",
            f"{says}sigmas allow: it, another constraint, or telemetry is wrong; correct it, or say that it "
            'may be wrong ("robust": true)',
        )
    gone = [one for one in tests if one.let_go]
    if gone:
        says = "; ".join(one.says for one in gone[:_NAMED])
        firm = sum(not one.robust for one in gone)
        make = VerdictTest.of if firm else VerdictTest.note
        advice = ': they are not said to be doubtful ("robust": true); correct them or leave them out'
        says = f"{len(gone)} constraint{'s' if len(gone) > 1 else ''} let go: {says}"
        yield make("constraints let go", float(len(gone)), 0.0, "", says + (advice if firm else ""))
