"""Shares of the observations in use: of all, and of the image, frame and stop that has the smallest."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import VerdictTest
from pancam_graph.solve._chances import CHANCE
from pancam_graph.solve._problem import Problem

__all__ = ["in_use_by", "let_go_links", "links_of", "shares_in_use"]

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


def shares_in_use(problem: Problem) -> Iterator[VerdictTest]:
    """Tests of how much is in use of what was measured, and of what joins frames and stops."""
    t = problem.template.traverse
    image, kept = problem.measurements.image, problem.kept
    share = float(np.mean(kept)) if len(kept) else 0.0
    yield VerdictTest.of(
        "observations",
        1 - share,
        _LEFT_OUT,
        f"{share:.0%} of {len(kept)} observations are in use",
        f"only {share:.0%} of {len(kept)} observations are in use, too few to tell right ones from wrong "
        "ones; check matches and rig",
    )
    images = ("image", np.arange(len(t.images)), [i.id for i in t.images])
    frames = ("frame", t.image_frame, [f.id for f in t.frames])
    stops = ("stop", t.image_stop, [s.id for s in t.stops])
    for name, owner, ids in (images, frames, stops):
        test = _Fairness(
            name=f"{name} share", owner=name, what="observations", least=_OBSERVATIONS, fair=_FAIR, ids=ids
        )
        yield test.of(owner[image], kept)
    for name, owner, ids in (frames, stops):
        what = f"points shared with another {name}"
        test = _Fairness(name=f"{name} links", owner=name, what=what, least=_LINKS, fair=_FAIR_LINKS, ids=ids)
        yield test.of(*links_of(problem, owner))


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
    yield test.of(*links_of(problem, t.image_frame), among=frames)


def links_of(problem: Problem, owner: IntArray) -> tuple[IntArray, BoolArray]:
    """Each owner of each landmark that two owners or more see (n,), and whether it still joins them (n,).

    `owner` (images,) is the frame or the stop of each image.
    """
    m = problem.measurements
    n_owners = int(owner.max()) + 1
    pair, of = np.unique(m.landmark * n_owners + owner[m.image], return_inverse=True)
    landmark, seen_by = pair // n_owners, pair % n_owners
    in_use = np.bincount(of, problem.kept, minlength=len(pair)) > 0
    joins = np.bincount(landmark, minlength=m.n_landmarks) >= 2
    joined = np.bincount(landmark, in_use, minlength=m.n_landmarks) >= 2
    rows = joins[landmark]
    return seen_by[rows], (in_use & joined[landmark])[rows]


def in_use_by(
    owner: IntArray, kept: BoolArray, n_owners: int
) -> tuple[IntArray, FloatArray, float, FloatArray]:
    """How many each owner has (owners,), how many of them are in use (owners,), and the share of all.

    The last value (owners,) is the chance of no more, if its own were as good as all others: few are in use
    by chance too, where few are owned. `owner` (n,) is of each thing, and `kept` (n,) whether it is in use.
    """
    usual = float(np.mean(kept)) if len(kept) else 1.0
    n = np.bincount(owner, minlength=n_owners)
    used = np.asarray(np.bincount(owner, kept, minlength=n_owners), dtype=float)
    return n, used, usual, np.asarray(scipy.special.bdtr(used, n, usual), dtype=float)


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

    def of(self, owner: IntArray, kept: BoolArray, among: IntArray | None = None) -> VerdictTest:
        """The test, given the owner of each thing (n,) and whether it is in use (n,).

        Only owners `among` some are tested; default: all.
        """
        is_tested = np.ones(len(self.ids), dtype=bool)
        if among is not None:
            is_tested = np.isin(np.arange(len(self.ids)), among)
        n, used, usual, chance = in_use_by(owner, kept, len(self.ids))
        share, limit = used / n.clip(1), 1 - self.fair * usual
        is_sure = chance < CHANCE / len(self.ids)
        suspect = is_tested & (n >= self.least) & is_sure & (share < self.fair * usual)
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
