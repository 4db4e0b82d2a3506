"""Elimination against dense linear algebra: order, square root, covariances; chains with calibrations."""

from itertools import combinations, combinations_with_replacement, pairwise

import gtsam
import numpy as np
import pytest

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.elimination import (
    FreeDirectionError,
    JointCovariance,
    LandmarkSystem,
    Linkage,
    Panels,
    PosePlace,
    Posture,
    Root,
    pattern,
    with_rows,
)
from pancam_graph.landmarks import CameraViews, LossName, loss_of
from support.elimination_reference import assert_systems_agree, dense_of, true_cost, whole
from support.landmark_scenes import measure, random_points, random_views, unit

Cliques = list[tuple[int, ...]]

GRAPHS: dict[str, tuple[list[int], Cliques]] = {
    "one": ([5], [(0,)]),
    "chain": ([6, 8, 3, 12, 1, 6], list(pairwise(range(6)))),
    "chain of threes": ([6, 4, 6, 4, 6, 4, 6], [(i, i + 1, i + 2) for i in range(5)]),
    "loop": ([4, 6, 2, 7, 5, 3], [*pairwise(range(6)), (0, 5)]),
    "star": ([6, 7, 8, 9, 2], [(i, 4) for i in range(4)]),
    "chain with what all share": ([6, 7, 8, 9, 3], [(0, 1, 4), (1, 2, 4), (2, 3, 4)]),
    "apart": ([3, 4, 5, 6], [(0, 1), (2, 3)]),
    "all": ([2, 3, 4, 5], [(0, 1, 2, 3)]),
    "one is alone": ([2, 3, 4], [(0, 2), (1,)]),
}


class Random:
    """A random system: the sum of one dense piece per clique."""

    def __init__(
        self, name: str, *, rows: int = 60, scaled: bool = False, seed: int = 0, last: int | None = None
    ) -> None:
        rng = np.random.default_rng(seed)
        dims, self.cliques = GRAPHS[name]
        self.dim: IntArray = np.array(dims, dtype=np.int64)
        self.begin = np.concatenate([[0], np.cumsum(self.dim)])
        self.panels = Panels(pattern(self.dim, self.cliques, last=last))
        n = int(self.begin[-1])
        scale = 10.0 ** rng.uniform(-4, 4, n) if scaled else np.ones(n)
        self.S, self.s = np.zeros((n, n)), np.zeros(n)
        for clique in self.cliques:
            groups = self.panels.sorted(clique)
            columns = np.concatenate([np.arange(self.begin[g], self.begin[g + 1]) for g in groups])
            J = rng.normal(size=(rows, len(columns))) * scale[columns]
            S, s = J.T @ J, J.T @ rng.normal(size=rows)
            self.S[np.ix_(columns, columns)] += S
            self.s[columns] += s
            # What is below the diagonal must not count.
            self.panels.add(groups, np.triu(S) + np.tril(rng.normal(size=S.shape), -1), s)

    def columns(self, g: int) -> slice:
        return slice(int(self.begin[g]), int(self.begin[g + 1]))

    def of(self, matrix: FloatArray, g: int, h: int) -> FloatArray:
        return matrix[self.columns(g), self.columns(h)]


@pytest.mark.parametrize("name", ["chain of threes", "chain with what all share"])
def test_a_system_on_disk_has_the_same_bits(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pancam_graph.elimination._panels._AT_ONCE", 50)  # it leaves memory on the way
    memory = Random(name).panels
    disk = Panels(memory.structure, on_disk=True)
    disk.numbers[:] = memory.numbers
    roots = [panels.copy().root() for panels in (memory, disk)]
    assert roots[1].scratch is not None
    assert np.array_equal(disk.numbers, memory.numbers)  # a copy was used up
    assert np.array_equal(roots[0].step(), roots[1].step())
    one, other = (root.inverse_columns(2, slice(0, 2)) for root in roots)
    assert np.array_equal(one, other)
    a, b = (root.covariance() for root in roots)
    for g, after in enumerate(memory.structure.after):
        for h in after:
            assert np.array_equal(a.block(g, h), b.block(g, h))


def stacked(root: Root) -> tuple[FloatArray, FloatArray]:
    """All rows R over all columns, by group, and e."""
    st = root.structure
    begin = np.concatenate([[0], np.cumsum(st.dim)])
    R, e = [], []
    for g in st.order:
        rows = np.zeros((len(root.rows[g]), int(begin[-1])))
        for h, first, last in zip(st.after[g], st.begin[g][:-1], st.begin[g][1:], strict=True):
            rows[:, begin[h] : begin[h + 1]] = root.rows[g][:, first:last]
        R.append(rows)
        e.append(root.rows[g][:, -1])
    return np.vstack(R), np.concatenate(e)


@pytest.mark.parametrize("name", GRAPHS)
def test_order_of_elimination_reaches_all_that_cliques_join(name: str) -> None:
    dims, cliques = GRAPHS[name]
    st = pattern(np.array(dims), cliques)
    assert sorted(st.order) == list(range(len(dims)))
    position = {g: i for i, g in enumerate(st.order)}
    for g in range(len(dims)):
        assert st.after[g][0] == g
        places = [position[h] for h in st.after[g]]
        assert places == sorted(places)
        assert st.begin[g].tolist() == [0, *np.cumsum([dims[h] for h in st.after[g]])]
    for clique in cliques:
        for g, h in combinations(clique, 2):
            first, second = sorted((g, h), key=position.__getitem__)
            assert second in st.after[first]


@pytest.mark.parametrize(
    ("name", "most"), [("chain", 3), ("chain of threes", 3), ("loop", 3), ("star", 2), ("apart", 2)]
)
def test_order_of_elimination_fills_little(name: str, most: int) -> None:
    dims, cliques = GRAPHS[name]
    assert max(len(a) for a in pattern(np.array(dims), cliques).after) == most


def test_work_on_a_long_road_grows_with_its_length() -> None:
    for n in (50, 100):
        st = pattern(np.full(n, 20), [(i, i + 1, i + 2) for i in range(n - 2)])
        assert sum(len(a) for a in st.after) <= 3 * n


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("name", GRAPHS)
def test_square_root_of_a_system(name: str, scaled: bool) -> None:
    system = Random(name, scaled=scaled)
    S, s = whole(system.panels)
    assert pytest.approx(system.S, rel=1e-12, abs=0) == S
    assert pytest.approx(system.s, rel=1e-12, abs=0) == s
    R, e = stacked(system.panels.root())
    size = np.sqrt(np.diag(system.S))
    assert R.shape == system.S.shape
    assert R.T @ R / np.outer(size, size) == pytest.approx(system.S / np.outer(size, size), abs=1e-12)
    assert R.T @ e / size == pytest.approx(system.s / size, abs=1e-10)


@pytest.mark.parametrize("name", ["chain", "chain of threes", "loop", "star", "all"])
def test_square_root_where_directions_are_free(name: str) -> None:
    """Pieces of few rows: fewer equations than unknowns, in places more in others."""
    for rows in (0, 1, 2, 5):
        system = Random(name, rows=rows)
        R, e = stacked(system.panels.root())
        assert R.T @ R == pytest.approx(system.S, abs=1e-11 * (1 + np.abs(system.S).max()))
        assert R.T @ e == pytest.approx(system.s, abs=1e-9)


@pytest.mark.parametrize("name", ["one", "chain", "chain of threes", "loop", "star", "all"])
def test_rows_that_are_stacked_keep_what_a_sum_of_squares_would_lose(name: str) -> None:
    """Differences alone enter, and a prior 1e-8 times as sure on the first column of every group."""
    dims, cliques = GRAPHS[name]
    dim: IntArray = np.array(dims, dtype=np.int64)
    begin = np.concatenate([[0], np.cumsum(dim)])
    rng = np.random.default_rng(3)
    rows = [rng.normal(size=(60, int(begin[-1]))) for _ in cliques]
    for clique, J in zip(cliques, rows, strict=True):
        outside = np.ones(int(begin[-1]), dtype=bool)
        for g in clique:
            outside[begin[g] : begin[g + 1]] = False
        J[:, outside] = 0.0
        mean = J.sum(axis=1, keepdims=True) / (~outside).sum()
        J[:] = np.where(outside, 0.0, J - mean)  # blind to a common shift
    panels = Panels(pattern(dim, cliques))
    for clique, J in zip(cliques, rows, strict=True):
        groups = panels.sorted(clique)
        columns = np.concatenate([np.arange(begin[g], begin[g + 1]) for g in groups])
        panels.add(groups, J[:, columns].T @ J[:, columns], np.zeros(len(columns)))
    weak = 1e-8
    more = [([g], [slice(0, 1)], np.array([[weak, 0.0]])) for g in range(len(dim))]
    covariance = with_rows(panels.root(), more).covariance()
    # All columns shift alike by 1 / (weak sqrt(groups)), beside what the differences leave open.
    for g in range(len(dim)):
        np.testing.assert_allclose(covariance.block(g, g), 1 / (weak**2 * len(dim)), rtol=1e-4)


@pytest.mark.parametrize("name", ["chain", "all"])
def test_rounding_errors_are_no_rows(name: str) -> None:
    for rows in (1, 2):
        system = Random(name, rows=rows)
        R, _ = stacked(system.panels.root())
        assert len(R) == np.linalg.matrix_rank(system.S)


def test_square_root_of_a_system_that_only_differences_enter() -> None:
    """As images alone leave the place of the world: one direction per component is free."""
    rng = np.random.default_rng(1)
    n, d = 6, 4
    cliques = [*pairwise(range(n)), (0, n - 1)]
    panels = Panels(pattern(np.full(n, d), cliques))
    S, s = np.zeros((n * d, n * d)), np.zeros(n * d)
    for clique in cliques:
        g, h = panels.sorted(clique)
        difference = rng.normal(size=(9, d))
        J = np.zeros((9, n * d))
        J[:, g * d : (g + 1) * d], J[:, h * d : (h + 1) * d] = difference, -difference
        own = np.r_[g * d : (g + 1) * d, h * d : (h + 1) * d]
        r = rng.normal(size=9)
        S, s = S + J.T @ J, s + J.T @ r
        panels.add((g, h), (J.T @ J)[np.ix_(own, own)], (J.T @ r)[own])
    root = panels.root()
    R, e = stacked(root)
    assert R.shape == ((n - 1) * d, n * d)
    assert R.T @ R == pytest.approx(S, abs=1e-12)
    assert R.T @ e == pytest.approx(s, abs=1e-10)
    with pytest.raises(SolveError, match="nothing holds a direction"):
        root.covariance()


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("name", GRAPHS)
def test_covariance_blocks_are_those_of_the_inverse(name: str, scaled: bool) -> None:
    system = Random(name, scaled=scaled)
    size = np.sqrt(np.diag(system.S))
    inverse = np.linalg.inv(system.S / np.outer(size, size)) / np.outer(size, size)
    covariance = system.panels.root().covariance()
    pairs = {(g, g) for g in range(len(system.dim))}
    for clique in system.cliques:
        pairs |= {p for g, h in combinations(clique, 2) for p in ((g, h), (h, g))}
    for g, h in pairs:
        weight = np.outer(size[system.columns(g)], size[system.columns(h)])
        found, expected = covariance.block(g, h) * weight, system.of(inverse, g, h) * weight
        assert found == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("name", GRAPHS)
def test_trace_with_a_covariance_of_another_system(name: str) -> None:
    system, other = Random(name), Random(name, seed=1)
    covariance = other.panels.root().covariance()
    expected = np.trace(system.S @ np.linalg.inv(other.S))
    assert system.panels.trace_with(covariance) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("name", GRAPHS)
def test_product_with_a_matrix(name: str) -> None:
    system = Random(name)
    x = np.random.default_rng(4).standard_normal((len(system.S), 3))
    assert system.panels.times(x) == pytest.approx(system.S @ x, rel=1e-10, abs=1e-10)


def test_no_covariance_of_what_no_clique_joins() -> None:
    with pytest.raises(KeyError):
        Random("apart").panels.root().covariance().block(0, 3)


@pytest.mark.parametrize("name", ["chain", "loop", "star", "chain with what all share"])
def test_held_columns_are_independent_of_all_others_and_sure_when_released(name: str) -> None:
    system = Random(name)
    held = {0: np.array([1, 3]), 2: np.array([0]), 3: np.arange(system.dim[3])}
    fixed = np.concatenate([system.begin[g] + columns for g, columns in held.items()])
    free = np.setdiff1d(np.arange(len(system.S)), fixed)
    expected = np.zeros_like(system.S)
    expected[np.ix_(free, free)] = np.linalg.inv(system.S[np.ix_(free, free)])
    system.panels.hold(held)
    covariance = system.panels.root().covariance()
    covariance.release(held)
    for g in range(len(system.dim)):
        assert covariance.block(g, g) == pytest.approx(system.of(expected, g, g), abs=1e-12)
    for clique in system.cliques:
        g, h = clique[:2]
        assert covariance.block(g, h) == pytest.approx(system.of(expected, g, h), abs=1e-12)


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("name", GRAPHS)
def test_back_substitution_solves_the_system(name: str, scaled: bool) -> None:
    system = Random(name, scaled=scaled)
    size = np.sqrt(np.diag(system.S))
    expected = -np.linalg.solve(system.S / np.outer(size, size), system.s / size)
    step = system.panels.root().step()
    assert step * size == pytest.approx(expected, rel=1e-8, abs=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["one", "chain", "chain with what all share", "all"])
def test_back_substitution_solves_what_leaves_directions_free(name: str) -> None:
    system = Random(name, rows=3)
    step = system.panels.root().step()
    assert system.S @ step == pytest.approx(-system.s, abs=1e-8 * np.abs(system.s).max())


def test_held_columns_do_not_move_at_all() -> None:
    system = Random("chain with what all share")
    held = {0: np.array([1, 3]), 4: np.arange(3)}
    fixed = np.concatenate([system.begin[g] + columns for g, columns in held.items()])
    free = np.setdiff1d(np.arange(len(system.S)), fixed)
    system.panels.hold(held)
    step = system.panels.root().step()
    assert not step[fixed].any()
    assert step[free] == pytest.approx(-np.linalg.solve(system.S[np.ix_(free, free)], system.s[free]))


@pytest.mark.parametrize("name", GRAPHS)
def test_damping_adds_a_share_of_the_diagonal(name: str) -> None:
    system = Random(name)
    assert np.array_equal(system.panels.diagonal(), np.diag(whole(system.panels)[0]))
    assert np.array_equal(system.panels.right(), whole(system.panels)[1])
    system.panels.damp(0.5)
    expected = system.S + 0.5 * np.diag(np.diag(system.S))
    assert whole(system.panels)[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("swapped", [False, True])
def test_a_system_of_blocks_is_the_same_as_a_dense_piece(swapped: bool) -> None:
    system = Random("chain with what all share")
    panels = Panels(system.panels.structure)
    pieces = [(g, rows) for g, n in enumerate(system.dim.tolist()) for rows in (slice(0, 1), slice(1, n))]
    for (g, rows), (h, columns) in combinations_with_replacement(pieces, 2):
        first, second = (
            np.arange(system.begin[g], system.begin[g + 1]),
            np.arange(system.begin[h], system.begin[h + 1]),
        )
        block = system.S[np.ix_(first[rows], second[columns])]
        if not block.any():
            continue
        if swapped:
            panels.add_block(h, columns, g, rows, block.T)
        else:
            panels.add_block(g, rows, h, columns, block)
    for g, rows in pieces:
        panels.add_right(g, rows, system.s[system.begin[g] : system.begin[g + 1]][rows])
    assert whole(panels)[0] == pytest.approx(system.S, rel=1e-12)
    assert whole(panels)[1] == pytest.approx(system.s, rel=1e-12)
    blank = panels.blank()
    assert [panel.shape for panel in blank.panel] == [panel.shape for panel in panels.panel]
    assert not any(panel.any() for panel in blank.panel)
    assert whole(panels)[0] == pytest.approx(system.S, rel=1e-12)


def test_a_system_that_is_not_finite_is_refused() -> None:
    system = Random("chain")
    system.panels.panel[2][0, 0] = np.nan
    with pytest.raises(SolveError, match="not finite"):
        system.panels.root()


# --- chains with calibrations ---

KEYS = {"X": 6, "K": 5}


class Rigged:
    """Free cameras with the five numbers of K free: one for all, or one for each image."""

    def __init__(self, *, shared: bool, seed: int = 0, noise: bool = True) -> None:
        rng = np.random.default_rng(seed)
        self.n = n = 5
        self.views = random_views(rng, n)
        points = random_points(rng, 12)
        images = [np.sort(rng.choice(n, int(rng.integers(2, n + 1)), replace=False)) for _ in points]
        images[0] = np.array([3, 4])
        self.m = measure(self.views, points, images, noise=rng if noise else None)
        turn = rng.normal(0, 0.3, (len(self.m.image), 2, 2)) + np.eye(2)
        self.m = type(self.m)(**{**vars(self.m), "whitening": turn @ self.m.whitening})
        self.landmarks = unit(points, rng.normal(0, 1, (len(points), 3)))
        # Three images in one group, two in another; what all share in a last one.
        groups = [0, 0, 0, 1, 1]
        keys: list[int] = []
        dim: list[int] = []
        group: list[int] = []
        variable: list[list[int]] = []
        for g in (0, 1):
            for i in np.flatnonzero(np.array(groups) == g):
                variable.append([len(keys)])
                keys.append(gtsam.symbol("X", int(i)))
                dim.append(6)
                if not shared:
                    variable[-1].append(len(keys))
                    keys.append(gtsam.symbol("K", int(i)))
                    dim.append(5)
                group += [g] * (1 if shared else 2)
        if shared:
            variable = [[*v, len(keys)] for v in variable]
            keys.append(gtsam.symbol("K", 0))
            dim.append(5)
            group.append(2)
        self.linkage = Linkage(
            key=tuple(keys),
            dim=np.array(dim),
            group=np.array(group),
            image_unit=np.arange(n),
            segment_begin=np.arange(0, 2 * n + 1, 2),
            segment_variable=np.array(variable).ravel(),
            segment_column=np.zeros(2 * n, dtype=np.int64),
            segment_width=np.tile([6, 5], n),
            segment_plain=np.tile([True, False], n),
        )
        self.begin = np.concatenate([[0], np.cumsum(dim)])

    def posture(self, views: CameraViews | None = None) -> Posture:
        here = views or self.views
        chain = np.zeros((2 * self.n, 11, 6))
        chain[::2, :6] = np.eye(6)
        chain[1::2, 6:, :5] = np.eye(5)
        return Posture(views=here, unit_R=here.world_R_camera, unit_t=here.world_t_camera, chain=chain)

    def after(self, step: FloatArray) -> CameraViews:
        R, t, K = (
            x.copy() for x in (self.views.world_R_camera, self.views.world_t_camera, self.views.calibration)
        )
        for i in range(self.n):
            pose, calibration = self.linkage.segment_variable[2 * i : 2 * i + 2]
            moved = gtsam.Pose3(gtsam.Rot3(R[i]), t[i]).retract(step[self.begin[pose] : self.begin[pose] + 6])
            R[i], t[i] = moved.rotation().matrix(), moved.translation()
            fx, fy, skew, cx, cy = step[self.begin[calibration] : self.begin[calibration] + 5]
            K[i] += [[fx, skew, cx], [0, fy, cy], [0, 0, 0]]
        return CameraViews(world_R_camera=R, world_t_camera=t, calibration=K)

    def random_step(self, rng: np.random.Generator, size: float) -> FloatArray:
        """Calibrations a thousand times as far as poses."""
        wide = np.concatenate([np.full(d, 1.0 if d == 6 else 1e3) for d in self.linkage.dim])
        return np.asarray(size * wide * rng.standard_normal(len(wide)))


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_free_calibrations_eliminate_as_dense_ones(shared: bool, far: bool, loss: LossName) -> None:
    rigged, chosen = Rigged(shared=shared), loss_of(loss)
    if far:
        rigged.views = rigged.after(rigged.random_step(np.random.default_rng(1), 0.02))
    system = LandmarkSystem(rigged.linkage, rigged.m, rigged.landmarks, chosen)
    S, s = whole(system.linearise(rigged.posture()))
    n = int(rigged.begin[-1])
    expected = dense_of(rigged.after, n, rigged.m, rigged.landmarks, chosen)
    assert_systems_agree(S, s, expected)
    cost = true_cost(rigged.landmarks, rigged.m, rigged.views, chosen)
    assert system.block_costs().sum() == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("loss", ["none", "cauchy"])
@pytest.mark.parametrize("shared", [False, True])
def test_what_landmarks_took_from_a_group_can_be_put_back(shared: bool, loss: LossName) -> None:
    """Then it is the group's own system, landmarks and all others held; what else was added stays."""
    rigged, chosen = Rigged(shared=shared), loss_of(loss)
    system = LandmarkSystem(rigged.linkage, rigged.m, rigged.landmarks, chosen)
    panels = system.linearise(rigged.posture())
    dense = dense_of(rigged.after, int(rigged.begin[-1]), rigged.m, rigged.landmarks, chosen)
    for g in range(rigged.linkage.n_groups):
        columns = slice(*rigged.linkage.group_column[g : g + 2])
        A, n = dense.A[:, columns], columns.stop - columns.start
        size = np.linalg.norm(A, axis=0)
        panels.add([g], np.diag(size**2), 2 * size)
        S, s = system.put_back(panels, g)
        assert S / np.outer(size, size) == pytest.approx(A.T @ A / np.outer(size, size) + np.eye(n), abs=1e-8)
        assert s / size == pytest.approx(A.T @ dense.r / size + 2, abs=1e-8 * float(np.linalg.norm(dense.r)))


def test_a_system_that_rests_says_the_same_when_it_is_asked() -> None:
    rigged = Rigged(shared=True)
    system = LandmarkSystem(rigged.linkage, rigged.m, rigged.landmarks)
    panels = system.linearise(rigged.posture())
    exact, put_back = system.landmark_covariance_m2(None), system.put_back(panels, 0)
    system.rest()
    assert system.reduced.arms.size == 0
    assert np.array_equal(system.landmark_covariance_m2(None), exact)
    system.rest()
    assert all(map(np.array_equal, system.put_back(panels, 0), put_back))
    system.rest()
    assert np.array_equal(whole(system.linearise(rigged.posture()))[0], whole(panels)[0])


@pytest.mark.parametrize("loss", ["none", "huber"])
def test_the_cost_elsewhere_with_landmarks_held(loss: LossName) -> None:
    rigged, chosen = Rigged(shared=True), loss_of(loss)
    system = LandmarkSystem(rigged.linkage, rigged.m, rigged.landmarks, chosen)
    views = rigged.after(rigged.random_step(np.random.default_rng(2), 1e-2))
    expected = true_cost(rigged.landmarks, rigged.m, views, chosen)
    assert system.cost_at(rigged.posture(views)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("shared", [False, True])
def test_landmarks_follow_a_step_of_free_calibrations(shared: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pancam_graph.elimination._strays._STRAY", np.inf)  # nothing is refined after it
    rigged, loss = Rigged(shared=shared), loss_of("huber")
    n = int(rigged.begin[-1])
    expected = dense_of(rigged.after, n, rigged.m, rigged.landmarks, loss)
    system = LandmarkSystem(rigged.linkage, rigged.m, rigged.landmarks, loss)
    system.linearise(rigged.posture())
    step = rigged.random_step(np.random.default_rng(2), 1e-4)
    views = rigged.after(step)
    costs = system.try_step(rigged.posture(views), step)
    followed = expected.followed(step)
    assert costs.sum() == pytest.approx(true_cost(followed, rigged.m, views, loss), rel=1e-8)
    assert np.array_equal(system.landmarks().vector, rigged.landmarks.vector)
    system.adopt()
    assert system.landmarks().vector == pytest.approx(followed.vector, abs=1e-9)
    assert np.array_equal(system.landmarks().origin_m, rigged.landmarks.origin_m)


def test_landmarks_come_back_in_the_order_they_were_given_in() -> None:
    """Blocks are by the first group that sees a landmark: not the order of the measurements."""
    rigged = Rigged(shared=True)
    system = LandmarkSystem(rigged.linkage, rigged.m, rigged.landmarks)
    assert not np.array_equal(system.landmark_row, np.arange(len(system.landmark_row)))
    assert np.array_equal(system.landmarks().vector, rigged.landmarks.vector)


@pytest.mark.parametrize("name", GRAPHS)
def test_columns_of_the_inverse_are_those_of_a_dense_one(name: str) -> None:
    """Of groups that no clique joins too."""
    random = Random(name, scaled=True)
    inverse = np.linalg.inv(random.S)
    root = random.panels.root()
    size = np.sqrt(np.diag(inverse))
    for g, dim in enumerate(random.dim.tolist()):
        columns = slice(dim // 2, dim)
        found = root.inverse_columns(g, columns)
        expected = inverse[:, random.begin[g] + columns.start : random.begin[g] + columns.stop]
        scale = np.outer(size, size[random.begin[g] + columns.start : random.begin[g] + columns.stop])
        assert np.abs((found - expected) / scale).max() < 1e-9


@pytest.mark.parametrize("name", GRAPHS)
def test_the_information_of_the_last_group_is_that_of_a_dense_inverse(name: str) -> None:
    """Information and gradient, whichever group is to be eliminated last."""
    for last in range(len(Random(name, scaled=True).dim)):
        random = Random(name, scaled=True, last=last)
        inverse = np.asarray(np.linalg.inv(random.S), dtype=float)
        step, size = -inverse @ random.s, np.sqrt(np.diag(inverse))[random.columns(last)]
        assert random.panels.structure.order[-1] == last
        information, gradient = random.panels.root().last_information()
        covariance = np.linalg.inv(information)
        expected = random.of(inverse, last, last)
        assert np.abs((covariance - expected) / np.outer(size, size)).max() < 1e-9
        assert np.abs((-covariance @ gradient - step[random.columns(last)]) / size).max() < 1e-9


def test_forward_substitution_gives_the_variance_of_any_sum() -> None:
    """Of many sums at once, of which some begin at late groups."""
    random = Random("chain", scaled=True)
    rng = np.random.default_rng(3)
    sums = rng.normal(size=(len(random.S), 4)) * (
        np.arange(len(random.S))[:, None] >= [0, 7, 20, len(random.S)]
    )
    sums /= np.sqrt(np.diag(np.linalg.inv(random.S)))[:, None]
    half = random.panels.root().forward(sums)
    np.testing.assert_allclose(half.T @ half, sums.T @ np.linalg.solve(random.S, sums), rtol=1e-7, atol=1e-9)


def test_columns_of_the_inverse_need_all_directions() -> None:
    panels = Panels(pattern(np.array([3, 3]), [(0, 1)]))
    panels.add([0], np.diag([1.0, 1.0, 0.0]), np.zeros(3))
    panels.add([1], np.eye(3), np.zeros(3))
    with pytest.raises(FreeDirectionError):
        panels.root().inverse_columns(1, slice(0, 3))


def test_joint_covariance_of_poses_is_that_of_a_dense_inverse() -> None:
    """Of poses that no clique joins, one of them partly held, one held altogether."""
    random = Random("chain")  # group 0 has 6 columns, group 3 has 12
    held = np.array([3, 5])
    panels = random.panels.copy()
    panels.hold({3: 6 + held})
    joint = JointCovariance(
        root=panels.root(),
        places=(
            PosePlace(group=0, columns=slice(0, 6), held=np.zeros(0, dtype=np.int64)),
            PosePlace(group=3, columns=slice(6, 12), held=held),
            None,
        ),
    )
    free = np.setdiff1d(np.arange(len(random.S)), random.begin[3] + 6 + held)
    inverse = np.zeros_like(random.S)
    inverse[np.ix_(free, free)] = np.linalg.inv(random.S[np.ix_(free, free)])
    rows = np.concatenate([np.arange(6), random.begin[3] + np.arange(6, 12)])
    assert joint.of(0, 1) == pytest.approx(inverse[np.ix_(rows, rows)], abs=1e-12 * np.abs(inverse).max())
    assert joint.of(1, 0)[6:, 6:] == pytest.approx(joint.of(0, 1)[:6, :6])
    with_held = joint.of(2, 0)
    assert not with_held[:6].any()
    assert not with_held[:, :6].any()
    assert with_held[6:, 6:] == pytest.approx(joint.of(0, 1)[:6, :6])
