"""Shares of the observations in use: of all, and of the image, frame and stop that has the smallest.

A link, a point that an owner (a frame, a stop) shares with others, is lost to outliers more often the fewer
observations the point has: of two, either one is enough. Owners differ in that, so that each is compared with
what points of as many observations keep elsewhere. The links of one owner are different points, and lost
independently where outliers are: their number in use is binomial, or varies less (Hoeffding 1956).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import VerdictTest
from pancam_graph.landmarks import Measurements, kernel
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
_MOST = 4
"""Observations of a point from which on more make no difference to its links."""
_HALVINGS = 40
"""Of the interval in which the share of wrong observations is sought."""
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

    def chance(self, of: IntArray, expected: FloatArray | None = None) -> FloatArray:
        """Chance (n,) of no more in use, if things of owners `of` (n,) were as good as all others.

        `expected` are the shares (n,) that would be in use then; default: the usual one. A few are out of use
        by chance too, where few are owned.
        """
        if not len(of):
            return np.zeros(0)  # SciPy's part for it takes longer to import than a small solve takes
        share = self.usual if expected is None else expected
        return np.asarray(scipy.special.bdtr(self.used[of].astype(float), self.n[of], share), dtype=float)


def _expected_links(m: Measurements, kept: BoolArray, owner: IntArray, of: IntArray) -> FloatArray:
    """Share (n,) of the links of owners `of` (n,) that would be in use if they were as good as all others.

    A point with a observations by the owner and b by others is in use with the chance (1 - q^a)(1 - q^b),
    where each observation is wrong with the chance q; q is such that as many links in all would be in use as
    are. `owner` is that of each measurement.
    """
    # A row for each owner of each landmark.
    n_owners = 1 + int(owner.max())
    place, row = np.unique(m.landmark * n_owners + owner, return_inverse=True)
    landmark, by = np.divmod(place, n_owners)
    own, own_used = np.bincount(row), np.bincount(row, kept)
    other, other_used = (np.bincount(landmark, x)[landmark] - x for x in (own, own_used))
    is_link = other > 0
    own, other, by = own[is_link].clip(max=_MOST), other[is_link].clip(max=_MOST), by[is_link]
    usual = float(np.mean((own_used[is_link] > 0) & (other_used[is_link] > 0)))
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        q = 0.5 * (low + high)
        in_use = (1 - q**own) * (1 - q**other)
        low, high = (q, high) if float(in_use.mean()) > usual else (low, q)
    return np.array([float(in_use[by == one].mean()) for one in of])


def shares_in_use(problem: Problem, by_chance: BoolArray) -> Iterator[VerdictTest]:
    """Tests of how much is in use of what was measured, and of what joins frames and stops.

    Observations `by_chance` (observations,) fit but were left out all the same, so that they say nothing
    against the image, frame or stop that has them: these are compared without them.
    """
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
    if by_chance.any():
        problem = _without(problem, by_chance)
        images = InUse.observations(problem)
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
        m = problem.measurements
        expected = partial(_expected_links, m, problem.kept, owner[m.image])
        yield test.of(InUse.links(problem, owner, len(ids)), expected=expected)
    yield _frames_apart(problem)


def _without(problem: Problem, by_chance: BoolArray) -> Problem:
    """The problem without those of some observations (observations,) that are not in use."""
    m = problem.measurements
    rows = np.flatnonzero(problem.kept | ~by_chance[m.row])
    return problem.having(measurements=m.part(rows), accepted=problem.accepted[rows])


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

    def of(
        self,
        things: InUse,
        among: IntArray | None = None,
        expected: Callable[[IntArray], FloatArray] | None = None,
    ) -> VerdictTest:
        """The test of what owners have; only of owners `among` some, default: all.

        `expected` takes owners (n,) to the shares (n,) that they would have in use if they were as good as
        all others; default: the usual one.
        """
        is_tested = np.ones(len(self.ids), dtype=bool)
        if among is not None:
            is_tested = np.isin(np.arange(len(self.ids)), among)
        n, used, usual = things.n, things.used, things.usual
        fair = np.full(len(n), self.fair * usual)
        share = used / n.clip(1)
        suspect = is_tested & (n >= self.least) & (share < fair)
        few = np.flatnonzero(suspect)
        if len(few):
            shares = None if expected is None else expected(few)
            if shares is not None:
                fair[few] = self.fair * shares
            suspect[few] = (share[few] < fair[few]) & (things.chance(few, shares) < CHANCE / len(self.ids))
        tested = np.flatnonzero(suspect if suspect.any() else is_tested & (n >= self.least))
        if not len(tested):
            good = f"too few {self.what} to test a {self.owner} alone"
            return VerdictTest.of(self.name, None, 1 - self.fair * usual, good, "")
        worst = int(tested[np.argmin(share[tested])])
        limit = 1 - float(fair[worst])
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
