"""Rounds of iSAM2 until every variable is near its linearisation point, with the true cost after each."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.threads import each
from pancam_graph.graph import Kind, kind_of
from pancam_graph.smoother._batch import solved_anew
from pancam_graph.smoother._frame import orthonormal
from pancam_graph.smoother._map import Change, DriveMap
from pancam_graph.smoother._smoother_options import SmootherOptions
from pancam_graph.smoother._station import Postures, Station
from pancam_graph.smoother._tree import Tree, UnevenError

__all__ = ["Engine", "Rounds"]

_RISE = 1e-6
"""Relative rise of the cost beyond which a step has failed."""
_UNLIKE = 1.0
"""Difference of true and modelled cost beyond which a block is linearised again: about the cost of one more
observation."""
_PIXELS = 100.0
"""Pixels of a calibration entry that count as one unit of another entry of the rig."""
_LEFT = 0.3
"""Largest motion between moved and unmoved stops of a block, in units, that needs no new linearisation."""


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """Summary of some rounds."""

    rounds: int
    """Updates of iSAM2."""
    relinearised: int
    """Variables linearised again; one in two rounds counts twice."""
    blocks: int
    """Factors of landmark blocks added or replaced."""
    cost: float
    """Total cost after the last round."""
    fell_back: bool
    """Whether Levenberg-Marquardt solved the whole drive, since the rounds did not converge."""


class Engine:
    """iSAM2 over the variables of a drive, with one factor for each block of landmarks."""

    def __init__(self, drive: DriveMap, options: SmootherOptions) -> None:
        self._drive, self._options = drive, options
        self._tree, self._by_qr = Tree(), False
        self._priors = gtsam.NonlinearFactorGraph()
        """All factors except landmark blocks, for the cost."""
        self._bent: list[int] = []
        self._apart: dict[int, float] = {}
        self._unit = np.repeat([options.relinearise_rad, options.relinearise_m], 3)

    @property
    def estimate(self) -> gtsam.Values:
        """Estimates of all variables."""
        return self._tree.estimate

    @property
    def theta(self) -> gtsam.Values:
        """Linearisation points of all variables."""
        return self._tree.theta

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint marginal covariance of variables, in the order of their keys."""
        return self._tree.covariance(keys)

    def advance(
        self,
        change: Change,
        factors: Sequence[gtsam.NonlinearFactor] = (),
        station: Station | None = None,
        values: gtsam.Values | None = None,
    ) -> Rounds:
        """Add new factors and blocks, and iterate to convergence.

        `values` are initial values of the variables of a new station.
        """
        for factor in factors:
            self._priors.push_back(factor)
        new = values or gtsam.Values()
        if station is not None and station.mast is not None and new.exists(station.mast):
            there = new.atPose3(station.mast)
            theta = gtsam.Values(new)
            theta.update(station.mast, orthonormal(self._frame_at(there) * there))
            return self._settle(change, factors, new, theta, bends=False)
        return self._settle(change, factors, new, new, bends=False)

    def _frame_at(self, world_T_mast: gtsam.Pose3) -> gtsam.Pose3:
        """Motion from the estimate back to the linearisation point, of the stop nearest to a pose."""
        stations = [s for s in self._drive.stations if s.mast is not None and self.theta.exists(s.mast)]
        if not stations:
            return gtsam.Pose3()
        at = world_T_mast.translation()
        apart = [np.linalg.norm(s.world_T_mast(self.estimate).translation() - at) for s in stations]
        nearest = stations[int(np.argmin(apart))]
        return nearest.world_T_mast(self.theta) * nearest.world_T_mast(self.estimate).inverse()

    def bend(self, factor: gtsam.NonlinearFactor) -> Rounds:
        """Add a temporary factor and iterate to convergence; the next `advance` removes the factor."""
        none = gtsam.Values()
        return self._settle(Change(), [factor], none, none, bends=True)

    def _settle(
        self,
        change: Change,
        factors: Sequence[gtsam.NonlinearFactor],
        new: gtsam.Values,
        theta: gtsam.Values,
        *,
        bends: bool,
    ) -> Rounds:
        touched, removed = set(change.touched), [*change.slots, *self._bent]
        self._bent = []
        rounds, relinearised, handled, previous = 0, 0, 0, np.inf
        moving: set[int] = set()
        while True:
            affected = self._linearise(touched, new, theta, moving, removed)
            values = gtsam.Values(self._tree.estimate)
            values.insert(new)
            try:
                slots = self._update(factors, theta, removed, moving, affected)
            except UnevenError:
                self._by_qr = True
                slots = self._anew(values, factors if bends and rounds == 0 else ())
            if bends and rounds == 0:
                self._bent = slots
            rounds, relinearised, handled = rounds + 1, relinearised + len(moving), handled + len(affected)
            unlike, cost = self._evaluate(affected)
            moving = self._to_move(unlike)
            # The temporary factor of `bend` is not part of the cost, which may therefore rise.
            failed = rounds >= self._options.max_rounds or (cost > previous * (1 + _RISE) and not bends)
            if not moving or failed:
                break
            previous, touched, removed, factors, new, theta = (
                cost,
                set(),
                [],
                [],
                gtsam.Values(),
                gtsam.Values(),
            )
        fell_back = bool(moving) and not bends
        if fell_back:
            self.restart(solved_anew(self._drive, self._tree.estimate))
            cost = self.cost
        return Rounds(
            rounds=rounds, relinearised=relinearised, blocks=handled, cost=cost, fell_back=fell_back
        )

    def _linearise(
        self, touched: set[int], new: gtsam.Values, theta: gtsam.Values, moving: set[int], removed: list[int]
    ) -> set[int]:
        """Linearise, at the next point, blocks that are touched or have a moving variable; their names."""
        blocks, values = self._drive.blocks, gtsam.Values(self._tree.estimate)
        values.insert(new)
        estimate = Postures(values)
        affected = touched | {b for b, block in blocks.items() if not moving.isdisjoint(block.keys)}
        at = Postures(self._tree.next_theta(theta, moving))
        for b in sorted(affected):
            removed += [blocks[b].slot] * (blocks[b].slot >= 0)
            for postures in (at,) if b in touched else (estimate, at):
                postures.of_all(blocks[b].patch.stations)

        def linearise(b: int) -> None:
            if b not in touched:
                blocks[b].settle(estimate)
            blocks[b].linearise(at, values, self._unit, by_rows=self._by_qr)

        each(linearise, sorted(affected))
        return affected

    def _to_move(self, unlike: set[int]) -> set[int]:
        """Keys to linearise again: those of blocks that moved too far or are `unlike` their linear model.

        Blocks that share stops with these are added where their other stops would stay too far behind.
        """
        o, moved, blocks = self._options, self._tree.moved, self._drive.blocks
        entries = self._drive.sharing.calibration.entries("calibration")
        in_pixels = np.array([entry.endswith("_px") for entry in entries])
        limit = {
            Kind.ANGLES: o.relinearise_rad,
            Kind.CALIBRATION: np.where(in_pixels, _PIXELS, 1.0) * o.relinearise_rig,
        }
        far = {
            key
            for key, delta in moved.items()
            if (kind := kind_of(key)) is not Kind.MAST
            and np.any(np.abs(delta) > limit.get(kind, o.relinearise_rig))
        }
        # A caller's factor may depend on absolute poses; a block depends on relative poses alone.
        named = {key for factor in self._drive.seated for key in factor.keys()}  # noqa: SIM118  a gtsam factor
        masts = (key for key in named if kind_of(key) is Kind.MAST and key in moved)
        far |= {key for key in masts if np.any(np.abs(moved[key]) > self._unit)}
        pending = {
            b
            for b, block in blocks.items()
            if b in unlike or self._apart[b] > 1 or not far.isdisjoint(block.keys)
        }
        moving = far & named
        while pending:
            moving |= {key for b in pending for key in blocks[b].keys}
            pending = {
                b
                for b, block in blocks.items()
                if not moving.isdisjoint(block.keys)
                and not moving.issuperset(block.keys)
                and block.left_apart(self._tree.theta, self._tree.estimate, moving) > _LEFT
            }
        return moving

    def restart(self, values: gtsam.Values) -> None:
        """Build a new tree of all factors, linearised at `values`, for which landmarks are placed already.

        By QR where Cholesky fails, now and in updates to come.
        """
        try:
            self._anew(values)
        except UnevenError:
            self._by_qr = True
            self._anew(values)

    def _anew(self, values: gtsam.Values, bending: Sequence[gtsam.NonlinearFactor] = ()) -> list[int]:
        """Build a new tree at `values`; slots of the temporary factors `bending`."""
        self._tree, self._bent, theta = Tree(by_qr=self._by_qr), [], Postures(values)
        blocks = list(self._drive.blocks.values())
        for block in blocks:
            theta.of_all(block.patch.stations)
        each(lambda block: block.linearise(theta, values, self._unit, by_rows=self._by_qr), blocks)
        factors = [*self._drive.factors(firm=False), *self._drive.seated]
        self._priors = gtsam.NonlinearFactorGraph()
        for factor in factors:
            self._priors.push_back(factor)
        slots = self._update([*bending, *factors], values, [], set(), set(self._drive.blocks))
        self._evaluate(set(self._drive.blocks))
        return slots[: len(bending)]

    def _update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        removed: Sequence[int],
        moving: set[int],
        affected: set[int],
    ) -> list[int]:
        """Update iSAM2 once, with new factors of the `affected` blocks; return the slots of `factors`."""
        blocks = [self._drive.blocks[b] for b in sorted(affected)]
        pairs = [(block, made) for block in blocks if (made := block.factor) is not None]
        slots = self._tree.update([*factors, *(made for _, made in pairs)], values, removed, moving)
        for (block, _), slot in zip(pairs, slots[len(factors) :], strict=True):
            block.slot = slot
        return slots[: len(factors)]

    def _evaluate(self, affected: set[int]) -> tuple[set[int], float]:
        """Names of blocks whose true cost differs much from their linear model, and the total cost."""
        estimate, unlike, blocks = Postures(self._tree.estimate), set(), self._drive.blocks
        for b in affected:
            estimate.of_all(blocks[b].patch.stations)
        each(lambda b: blocks[b].follow(estimate), sorted(affected))
        for b, block in blocks.items():
            if b in affected:
                if abs(block.cost - block.modelled_cost(estimate.values)) > _UNLIKE:
                    unlike.add(b)
            else:
                block.cost = block.modelled_cost(estimate.values)
            self._apart[b] = block.apart(estimate.values)
        return unlike, self.cost

    @property
    def cost(self) -> float:
        """Total cost; each landmark block as evaluated last."""
        blocks = sum(block.cost for block in self._drive.blocks.values())
        return float(self._priors.error(self._tree.estimate)) + blocks
