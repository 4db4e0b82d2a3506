"""Shares of the observations in use: of all, and of the image, frame and stop that has the smallest."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import VerdictTest
from pancam_graph.landmarks import kernel
from pancam_graph.solve._chances import CHANCE
from pancam_graph.solve._problem import Problem

__all__ = ["InUse", "let_go_links", "shares_in_use"]

_LEFT_OUT = 0.9
"""Largest share of the observations that may be left out as outliers."""
_FAIR = 0.25
"""Part of the usual share of observations below which an image, a frame or a stop is suspect ..."""
_FAIR_LINKS = 0.6
"""... and of points that join it to others: a pose that is wrong keeps some of these, as two rays meet
wherever they lie in one plane."""
_FAIR_LET_GO = 0.95
"""The same of a frame whose telemetry was let go: its pointing is then right, or something else is wrong."""
_OBSERVATIONS = 12
"""Images, frames and stops with fewer observations are not tested alone ..."""
_LINKS = 4
"""... nor are frames and stops that share fewer points with others."""
_APART = 0.1
"""Largest share of sights by two eyes that may be lost by both, beyond what eyes lose one by one: half of the
points that join frames to others would be a quarter of it."""
_SIGHTS = 50
"""Sights by two eyes below which that is not tested."""


@dataclass(frozen=True, kw_only=True, eq=False)
class InUse:
    """How much of what each image, frame or stop (the *owners*) has is in use."""

    n: IntArray
    """(owners,) how many things each has"""
    used: IntArray
    """(owners,) how many of them are in use"""

    @staticmethod
    def observations(problem: Problem) -> "InUse":
        """Observations of each image."""
        image, n = problem.measurements.image, len(problem.template.traverse.images)
        used = np.bincount(image[problem.kept], minlength=n)
        return InUse(n=np.bincount(image, minlength=n), used=used)

    @staticmethod
    def links(problem: Problem, owner: IntArray, n_owners: int) -> "InUse":
        """Landmarks that each owner shares with another; in use are those that still join it to another.

        `owner` (images,) is the frame or the stop of each image.
        """
        m = problem.measurements
        n, used = np.zeros(n_owners, dtype=np.int64), np.zeros(n_owners, dtype=np.int64)
        kernel.count_links(m.begin, owner[m.image], problem.kept, n, used)
        return InUse(n=n, used=used)

    def by(self, owner: IntArray, n_owners: int) -> "InUse":
        """The same of owners of these owners: `owner` (owners,) is that of each."""
        n, used = (np.bincount(owner, of, minlength=n_owners) for of in (self.n, self.used))
        return InUse(n=n.astype(np.int64), used=used.astype(np.int64))

    @property
    def usual(self) -> float:
        """Share in use of all things; 1 where there are none."""
        n = int(self.n.sum())
        return float(self.used.sum() / n) if n else 1.0

    def chance(self, of: IntArray) -> FloatArray:
        """Chance (n,) of no more in use, if things of owners `of` (n,) were as good as all others.

        A few are out of use by chance too, where few are owned.
        """
        if not len(of):
            return np.zeros(0)  # SciPy's part for it takes longer to import than a small solve takes
        return np.asarray(
            scipy.special.bdtr(self.used[of].astype(float), self.n[of], self.usual), dtype=float
        )


def shares_in_use(problem: Problem) -> Iterator[VerdictTest]:
    """Tests of how much is in use of what was measured, and of what joins frames and stops."""
    t = problem.template.traverse
    images = InUse.observations(problem)
    n = int(images.n.sum())
    share = images.usual if n else 0.0
    yield VerdictTest.of(
        "observations",
        1 - share,
        _LEFT_OUT,
        f"{share:.0%} of {n} observations are in use",
        f"only {share:.0%} of {n} observations are in use, too few to tell right ones from wrong "
        "ones; check matches and rig",
    )
    owners = (
        ("image", np.arange(len(t.images)), [i.id for i in t.images]),
        ("frame", t.image_frame, [f.id for f in t.frames]),
        ("stop", t.image_stop, [s.id for s in t.stops]),
    )
    for name, owner, ids in owners:
        test = _Fairness(
            name=f"{name} share", owner=name, what="observations", least=_OBSERVATIONS, fair=_FAIR, ids=ids
        )
        yield test.of(images.by(owner, len(ids)))
    for name, owner, ids in owners[1:]:
        what = f"points shared with another {name}"
        test = _Fairness(name=f"{name} links", owner=name, what=what, least=_LINKS, fair=_FAIR_LINKS, ids=ids)
        yield test.of(InUse.links(problem, owner, len(ids)))
    yield _frames_apart(problem)


def _frames_apart(problem: Problem) -> VerdictTest:
    """That two eyes of a frame are not left out together more often than each alone.

    Outliers hit the eyes of a frame one by one, and a point that two eyes see is then lost by both at the
    product of their shares. Frames that point elsewhere than told keep what their own eyes see, and points
    lose all their sights in other frames.
    """
    m, frame = problem.measurements, problem.template.traverse.image_frame
    pairs, n_frames = np.zeros(3, dtype=np.int64), len(problem.template.traverse.frames)
    kernel.count_pairs(m.begin, frame[m.image], problem.kept, n_frames, pairs)
    name, what = "frames apart", "points shared by frames"
    total = int(pairs.sum())
    if total < _SIGHTS:
        return VerdictTest.of(name, None, _APART, f"too few {what} to compare the eyes of a frame", "")
    lost = float(pairs[0] / total)
    value = lost - (1 - float((pairs[1] + 2 * pairs[2]) / total) / 2) ** 2
    says = f"of {what}, {lost:.0%} are lost by both eyes of a frame, {value:+.0%} more than by chance"
    return VerdictTest.of(
        name,
        value,
        _APART,
        says,
        f"{says}: frames do not point where they are told to, or matches between frames are wrong; check pan "
        "and tilt (their sense, order and unit), or widen their sigmas",
    )


def let_go_links(problem: Problem) -> Iterator[VerdictTest]:
    """That a frame whose pan or tilt was let go has found its links again; none where no frame's was.

    If it has not, it is not its telemetry that is wrong, or not only.
    """
    t, frames = problem.template.traverse, np.flatnonzero(problem.template.let_go.angles_rad.any(axis=1))
    if not len(frames):
        return
    test = _Fairness(
        name="links let go",
        owner="frame",
        what="points shared with another frame",
        least=_LINKS,
        fair=_FAIR_LET_GO,
        ids=[f.id for f in t.frames],
    )
    yield test.of(InUse.links(problem, t.image_frame, len(t.frames)), among=frames)


@dataclass(frozen=True, kw_only=True)
class _Fairness:
    """A test that no owner has much less in use than all others together."""

    name: str
    owner: str
    """What owns: image, frame or stop."""
    what: str
    """What is owned, in words."""
    least: int
    """Owners of fewer are not tested alone."""
    fair: float
    """Part of the usual share in use that each must have."""
    ids: Sequence[str]

    def of(self, things: InUse, among: IntArray | None = None) -> VerdictTest:
        """The test of what owners have; only of owners `among` some, default: all."""
        is_tested = np.ones(len(self.ids), dtype=bool)
        if among is not None:
            is_tested = np.isin(np.arange(len(self.ids)), among)
        n, used, usual = things.n, things.used, things.usual
        share, limit = used / n.clip(1), 1 - self.fair * usual
        suspect = is_tested & (n >= self.least) & (share < self.fair * usual)
        few = np.flatnonzero(suspect)
        suspect[few] = things.chance(few) < CHANCE / len(self.ids)
        tested = np.flatnonzero(suspect if suspect.any() else is_tested & (n >= self.least))
        if not len(tested):
            good = f"too few {self.what} to test a {self.owner} alone"
            return VerdictTest.of(self.name, None, limit, good, "")
        worst = int(tested[np.argmin(share[tested])])
        counts = f"{int(used[worst])} of {int(n[worst])}"
        says = f"of {self.owner} {self.ids[worst]} {counts} {self.what} are in use"
        value = 1 - float(share[worst])
        return VerdictTest.of(
            self.name,
            value if suspect.any() else min(value, limit),
            limit,
            says,
            f"{says}, of all {usual:.0%}: its pointing, its file or its matches are probably wrong; "
            "leave it out, or widen the sigmas of its telemetry",
        )
