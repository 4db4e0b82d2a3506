"""Rounds of iSAM2 until nothing is far from where it was linearised, and the true cost of each."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.smoother._batch import solved_anew
from pancam_graph.smoother._map import Change, DriveMap
from pancam_graph.smoother._options import SmootherOptions
from pancam_graph.smoother._station import Postures
from pancam_graph.smoother._tree import Tree

__all__ = ["Engine", "Rounds"]

_RISE = 1e-6
"""A step that raises the cost by more than this share is a bad one."""
_UNLIKE = 1e-5
"""Blocks whose true cost differs from that of their linear model by this share of all are linearised anew."""


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """What it took."""

    rounds: int
    relinearised: int
    blocks: int
    cost: float
    fell_back: bool


class Engine:
    """iSAM2 over the variables of a drive, with one factor for each block of landmarks."""

    def __init__(self, drive: DriveMap, options: SmootherOptions) -> None:
        self._drive, self._options = drive, options
        self._tree = Tree(options)
        self._priors = gtsam.NonlinearFactorGraph()
        """All factors but those of landmarks, for the cost."""
        self._bent: list[int] = []

    @property
    def estimate(self) -> gtsam.Values:
        """All variables where they are now."""
        return self._tree.estimate

    @property
    def theta(self) -> gtsam.Values:
        """All variables where they were linearised."""
        return self._tree.theta

    def covariance(self, keys: Sequence[int]) -> np.ndarray:  # type: ignore[type-arg]
        """Joint covariance of variables."""
        return self._tree.covariance(keys)

    def advance(
        self,
        change: Change,
        factors: Sequence[gtsam.NonlinearFactor] = (),
        values: gtsam.Values | None = None,
    ) -> Rounds:
        """Add what is new and go on until it is settled."""
        for factor in factors:
            self._priors.push_back(factor)
        return self._settle(change, factors, values or gtsam.Values(), bends=False)

    def bend(self, factor: gtsam.NonlinearFactor) -> Rounds:
        """Bring the drive to where one more factor wants it, which the next advance takes out again."""
        return self._settle(Change(), [factor], gtsam.Values(), bends=True)

    def _settle(
        self, change: Change, factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, *, bends: bool
    ) -> Rounds:
        blocks = self._drive.blocks
        touched, removed = set(change.touched), [*change.slots, *self._bent]
        self._bent = []
        rounds, relinearised, handled, previous = 0, 0, 0, np.inf
        moving = self._tree.over()
        while True:
            affected = self._linearise(touched, values, moving, removed)
            slots = self._update(factors, values, removed, moving, affected)
            if bends and rounds == 0:
                self._bent = slots
            rounds, relinearised, handled = rounds + 1, relinearised + len(moving), handled + len(affected)
            unlike, cost = self._evaluate(affected)
            moving = self._tree.over() | unlike
            # What bends the drive is no part of the cost, which may rise.
            failed = rounds >= self._options.max_rounds or (cost > previous * (1 + _RISE) and not bends)
            if not moving or failed:
                break
            previous, touched, removed, factors, values = cost, set(), [], [], gtsam.Values()
        fell_back = bool(moving) and not bends
        if fell_back:
            self.restart(solved_anew(self._drive, self._tree.estimate))
            _, cost = self._evaluate(set(blocks))
        return Rounds(
            rounds=rounds, relinearised=relinearised, blocks=handled, cost=cost, fell_back=fell_back
        )

    def _linearise(
        self, touched: set[int], values: gtsam.Values, moving: set[int], removed: list[int]
    ) -> set[int]:
        """Blocks that are touched, or of variables that move, at the next point of linearisation."""
        blocks, estimate = self._drive.blocks, Postures(self._tree.estimate)
        affected = touched | {b for b, block in blocks.items() if not moving.isdisjoint(block.keys)}
        theta = Postures(self._tree.next_theta(values, moving))
        for b in sorted(affected):
            block = blocks[b]
            if b not in touched:
                block.settle(estimate)
            if block.slot >= 0:
                removed.append(block.slot)
            block.linearise(theta)
        return affected

    def restart(self, values: gtsam.Values) -> None:
        """A new tree of all factors, linearised at these values, where landmarks are already."""
        self._tree, self._bent, theta = Tree(self._options), [], Postures(values)
        for block in self._drive.blocks.values():
            block.linearise(theta)
        factors = self._drive.factors(firm=False)
        self._priors = gtsam.NonlinearFactorGraph()
        for factor in factors:
            self._priors.push_back(factor)
        self._update(factors, values, [], set(), set(self._drive.blocks))

    def _update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        removed: Sequence[int],
        moving: set[int],
        affected: set[int],
    ) -> list[int]:
        """One update of iSAM2, with the factors of these blocks anew; the slots of the other factors."""
        blocks = [block for b in sorted(affected) if (block := self._drive.blocks[b]).factor is not None]
        slots = self._tree.update([*factors, *(b.factor for b in blocks)], values, removed, moving)
        for block, slot in zip(blocks, slots[len(factors) :], strict=True):
            block.slot = slot
        return slots[: len(factors)]

    def _evaluate(self, affected: set[int]) -> tuple[set[int], float]:
        """Variables of blocks that are less linear than they were taken for, and the cost of everything."""
        estimate, far = Postures(self._tree.estimate), {}
        for b, block in self._drive.blocks.items():
            delta = self._tree.delta(block.keys)
            if b in affected:
                block.follow(estimate)
                far[b] = abs(block.cost - block.modelled_cost(estimate.values))
            elif not np.array_equal(delta, block.delta):
                block.cost = block.modelled_cost(estimate.values)
            block.delta = delta
        cost = self.cost
        unlike = {b for b, miss in far.items() if miss > _UNLIKE * cost}
        return {key for b in unlike for key in self._drive.blocks[b].keys}, cost

    @property
    def cost(self) -> float:
        """Of everything, where blocks were evaluated last."""
        blocks = sum(block.cost for block in self._drive.blocks.values())
        return float(self._priors.error(self._tree.estimate)) + blocks
