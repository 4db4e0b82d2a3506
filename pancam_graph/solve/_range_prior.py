"""Distribution of inverse ranges, learnt from landmarks whose own ranges are noisy.

Nonparametric maximum likelihood (Kiefer and Wolfowitz 1956) by expectation-maximisation on a grid that
begins at infinity: the inverse range of each landmark is its true one, drawn from the distribution, plus
Gaussian noise of known variance. Terrain changes with direction, so cells of neighbouring directions have
distributions of their own about that of all; prediction of landmarks left out decides how fine the cells are.
"""

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["RangePrior"]

_STEP = 0.02
"""Spacing of the grid: a share of the inverse range, far from infinity."""
_MOST_NODES = 400
_CAUTION = 2.0
"""Standard deviations by which the spread of ranges is taken smaller than estimated: noise that counts as
spread tells height and tilt apart, spread that counts as noise costs a little information."""
_PULL = 10.0
"""Landmarks of the common distribution that each cell counts in addition to its own."""
_LEAST = 30
"""Least landmarks of a cell."""
_DEPTHS = 6
"""Halvings of the cells that are tried, 0 among them."""
_GAIN = 10.0
"""By how much a finer division must raise the logarithm of the likelihood of landmarks left out."""
_ROUNDS, _MORE_ROUNDS = 400, 100
"""Rounds of expectation-maximisation from scratch, and from where the last call ended."""
_FEW_ROUNDS = 60
"""Rounds for each trial of a division."""
_RELAXED = 1.8
"""Exponent of the update of expectation-maximisation, which converges for any below 2."""
_MOST_RAISED = 1e100
"""Largest factor of an update before that exponent, lest the shares overflow."""


class RangePrior:
    """The distribution as it stands; each call learns it again, from near its last state."""

    def __init__(self, *, is_divided: bool = False) -> None:
        """`is_divided`: directions are divided into cells, which the first call chooses."""
        self._is_divided = is_divided
        self._cell: IntArray | None = None
        self._nodes = np.zeros(0)
        self._common = np.zeros(0)
        self._of_cell: dict[int, FloatArray] = {}

    def expected(
        self, per_m: FloatArray, variance: FloatArray, direction: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Expected true inverse ranges (n,), each given its noisy one (n,), of these variances (n,).

        `direction` (n, 3) are unit vectors. Every call is for the same n landmarks. Never below 0. The second
        value (n,) is the product of each variance with the derivative of what is expected by what is noisy.
        """
        rounds = _MORE_ROUNDS
        if len(self._nodes) == 0:
            self._nodes, rounds = _grid(per_m, variance), _ROUNDS
            self._common = np.full(len(self._nodes), 1 / len(self._nodes))
        nodes, out, follows = self._nodes, np.empty(len(per_m)), np.empty(len(per_m))
        whole = _likelihood(per_m, variance * _wider(len(per_m)), nodes)
        self._common = _learnt(whole, self._common, rounds)
        if self._is_divided and self._cell is None:
            self._cell, rounds = self._divided(per_m, variance, direction), _ROUNDS
        cell = np.zeros(len(per_m), dtype=np.int64) if self._cell is None else self._cell
        n_cells = int(cell.max()) + 1
        for c in range(n_cells):
            rows = np.flatnonzero(cell == c)
            likelihood, share = whole, self._common
            if n_cells > 1:
                likelihood = _likelihood(per_m[rows], variance[rows] * _wider(len(rows)), nodes)
                share = self._of_cell.get(c, self._common)
                share = _learnt(likelihood, share, rounds, self._common)
                self._of_cell[c] = share
            total = likelihood @ share
            out[rows] = (likelihood @ (share * nodes)) / total
            # The derivative is the variance that is left over that of the noise (Tweedie's formula).
            left = (likelihood @ (share * nodes**2)) / total - out[rows] ** 2
            follows[rows] = left.clip(0.0) / _wider(len(rows))
        return out, follows

    def _divided(self, per_m: FloatArray, variance: FloatArray, direction: FloatArray) -> IntArray:
        """Cells (n,) of the division that best predicts each half of the landmarks from the other."""
        n, nodes = len(per_m), self._nodes
        first = np.random.default_rng(0).permutation(n) % 2 == 0
        likelihood = _likelihood(per_m, variance, nodes)
        common = [_learnt(likelihood[half], self._common, _FEW_ROUNDS) for half in (first, ~first)]
        best, cell = -np.inf, np.zeros(n, dtype=np.int64)
        for depth in range(_DEPTHS):
            if depth and n < _LEAST << depth:
                break
            tried, gained = _halved(direction, depth), 0.0
            for half, other, base in ((first, ~first, common[0]), (~first, first, common[1])):
                for c in range(1 << depth):
                    of_cell, left_out = half & (tried == c), other & (tried == c)
                    share = _learnt(likelihood[of_cell], base, _FEW_ROUNDS, base) if depth else base
                    gained += float(np.log(likelihood[left_out] @ share).sum())
            if gained > best + (_GAIN if depth else 0.0):
                best, cell = gained, tried
        return cell


def _wider(n: int) -> float:
    """Factor on variances of noise by which the spread that n landmarks show is taken smaller."""
    return 1.0 + _CAUTION * float(np.sqrt(2 / n))


def _grid(per_m: FloatArray, variance: FloatArray) -> FloatArray:
    """Nodes from infinity to the nearest landmark, dense near infinity on the scale of the noise."""
    unit = float(np.median(np.sqrt(variance))) / 4
    top = float(np.arcsinh(max(float(per_m.max()), unit) / unit))
    n = int(np.clip(top / _STEP, 30, _MOST_NODES))
    return np.asarray(unit * np.sinh(np.linspace(0, top, n)))


def _likelihood(per_m: FloatArray, variance: FloatArray, nodes: FloatArray) -> FloatArray:
    """Likelihood (n, nodes) of each node as the true inverse range, 1 at the likeliest."""
    exponent = -0.5 * (per_m[:, None] - nodes) ** 2 / variance[:, None]
    return np.asarray(np.exp(exponent - exponent.max(axis=1, keepdims=True)))


def _learnt(
    likelihood: FloatArray, share: FloatArray, rounds: int, common: FloatArray | None = None
) -> FloatArray:
    """Shares (nodes,) of the nodes after rounds of expectation-maximisation; `common` pulls, if given."""
    n = len(likelihood)
    for _ in range(rounds):
        counts = share * (likelihood.T @ (1 / (likelihood @ share).clip(1e-300)))
        wanted = counts / n if common is None else (counts + _PULL * common) / (n + _PULL)
        share = share * (wanted / share.clip(1e-300)).clip(max=_MOST_RAISED) ** _RELAXED
        share = (share / share.sum()).clip(1e-300)
    return share


def _halved(direction: FloatArray, depth: int) -> IntArray:
    """Cells (n,) after halving all `depth` times, each across its longest side at its median."""
    cell = np.zeros(len(direction), dtype=np.int64)
    for _ in range(depth):
        finer = 2 * cell
        for c in range(int(cell.max()) + 1):
            rows = np.flatnonzero(cell == c)
            side = direction[rows, int(np.argmax(np.ptp(direction[rows], axis=0)))]
            finer[rows[np.argsort(side, kind="stable")[len(rows) // 2 :]]] += 1
        cell = finer
    return cell
