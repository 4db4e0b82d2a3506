"""Errors of telemetry that grow along a drive: a wrong scale, a wrong direction, or errors that add up.

Single legs may each be within their sigmas where all are off in the same way. Let a = A v be the change of
all whitened residuals r of telemetry and of constraints on stops (Jacobian A) where stops move along v. An
error along v is tested by |a'r| / sqrt(a'a - b'Cb), with b = A'a and C the covariance of the solution: Rao's
score test (1948) of its size. The size is estimated as a'r / (a'a - b'Cb), and half of the test's square is
what the cost would fall by if the size were free.
"""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import Root
from pancam_graph.graph import Kind, key_of
from pancam_graph.solve._problem import Problem

__all__ = ["GrowingErrors", "growing_errors"]


@dataclass(frozen=True, kw_only=True, eq=False)
class GrowingErrors:
    """What a solution says of a scale, of a turn, and of drifts along the world's x, y, z, in this order."""

    pull: FloatArray
    """(5,) a'r"""
    shown: FloatArray
    """(5, 5) covariance of `pull` if all errors are as stated."""
    told: FloatArray
    """(5,) what `shown` would have on its diagonal if images told all, a'a."""
    least: float
    """Share of an error that shows, below which images say nothing of it."""

    @property
    def scale(self) -> tuple[float, float] | None:
        """By which share lengths came out longer than stated, and the size of its test.

        A standard normal number if all is as stated. None where images say nothing of it.
        """
        return self._single(0)

    @property
    def turn(self) -> tuple[float, float] | None:
        """By how much the drive came out turned, radians anticlockwise from above; else as `scale`."""
        return self._single(1)

    def _single(self, k: int) -> tuple[float, float] | None:
        pull, shown = float(self.pull[k]), float(self.shown[k, k])
        if shown <= self.least * self.told[k]:
            return None
        return pull / shown, abs(pull) / float(np.sqrt(shown))

    @property
    def drift(self) -> tuple[FloatArray, float, int] | None:
        """By how much stops drift per metre driven (3,), along the world's axes, and the test of all three.

        The test is chi-square of so many degrees of freedom, the last number. None where images say nothing.
        """
        unit = np.sqrt(self.told[2:])
        if not unit.all():
            return None
        values, vectors = np.linalg.eigh(self.shown[2:, 2:] / np.outer(unit, unit))
        shows = values > self.least
        if not shows.any():
            return None
        along = vectors[:, shows].T @ (self.pull[2:] / unit)
        size = vectors[:, shows] @ (along / values[shows]) / unit
        return size, float(np.sum(along**2 / values[shows])), int(shows.sum())

    @property
    def square_of_images(self) -> float:
        """Square of the larger test of the errors that images have too: a scale (baseline), a turn (pans)."""
        return max(0.0 if found is None else found[1] ** 2 for found in (self.scale, self.turn))


def growing_errors(problem: Problem, root: Root, least: float) -> GrowingErrors | None:
    """Those of a problem at its optimum; `root` is that of its system, `least` as in `GrowingErrors`.

    Stops are scaled from, and turned about, the mean of those whose place telemetry holds, or of all where it
    holds none; a drift grows from the first stop on, in the order of the stops. None where all places are
    held.
    """
    template, values = problem.template, problem.values
    stops, link = template.traverse.stops, template.linkage
    free = np.array([stop.sigma_translation_m > 0 for stop in stops], dtype=bool)
    if not free.any():
        return None
    masts = template.masts(values)
    place = np.array([pose.translation() for pose in masts])
    from_centre = place - place[free if free.all() else ~free].mean(axis=0)
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    aside = np.cross([0.0, 0.0, 1.0], from_centre)
    drifts = driven[:, None, None] * np.eye(3)
    moves = np.concatenate([from_centre[:, :, None], aside[:, :, None], drifts], axis=2)
    # By the key of a mast, how its tangent moves (6, 5).
    along = {
        key_of(Kind.MAST, s): np.vstack([np.zeros((3, 5)), masts[s].rotation().matrix().T @ moves[s]])
        for s in np.flatnonzero(free).tolist()
    }
    begin = np.concatenate([[0], np.cumsum(root.structure.dim)])
    nothing = np.zeros((1, 5))
    pull, inner, columns = np.zeros(5), np.zeros((5, 5)), np.zeros((int(begin[-1]), 5))
    for factor in (*problem.factors.telemetry, *problem.factors.seated):
        keys = list(factor.keys())
        if along.keys().isdisjoint(keys):
            continue
        of_group = [link.columns_of(key) for key in keys]
        A, minus_residual = factor.linearize(values).jacobian()
        by_key = np.split(A, np.cumsum([c.stop - c.start for c in of_group])[:-1], axis=1)
        a = sum((by @ along[key] for key, by in zip(keys, by_key, strict=True) if key in along), nothing)
        pull -= minus_residual @ a
        inner += a.T @ a
        for key, c, by in zip(keys, of_group, by_key, strict=True):
            first = int(begin[link.group[link.row[key]]])
            columns[first + c.start : first + c.stop] += by.T @ a
    half = root.forward(columns)
    return GrowingErrors(pull=pull, shown=inner - half.T @ half, told=np.diag(inner).copy(), least=least)
