"""Stretches of a drive meet in joints, and in what all stops share, alone."""

import numpy as np
import pytest

from pancam_graph.elimination import Dissection, Linkage, pattern
from pancam_graph.landmarks import Measurements

N_STOPS = 12


def drive_of(tracks: list[list[int]]) -> tuple[Linkage, Measurements]:
    """One image a stop, moved by the stop's pose and by what all stops share; the images that see a track."""
    image = np.concatenate(tracks).astype(np.int64)
    n = len(image)
    link = Linkage(
        key=tuple(range(N_STOPS + 1)),
        dim=np.array([6] * N_STOPS + [3]),
        group=np.arange(N_STOPS + 1),
        image_unit=np.arange(N_STOPS),
        segment_begin=2 * np.arange(N_STOPS + 1),
        segment_variable=np.ravel([[s, N_STOPS] for s in range(N_STOPS)]),
        segment_column=np.zeros(2 * N_STOPS, dtype=np.int64),
        segment_width=np.tile([6, 3], N_STOPS),
        segment_plain=np.tile([True, False], N_STOPS),
    )
    return link, Measurements(
        row=np.arange(n),
        image=image,
        landmark=np.repeat(np.arange(len(tracks)), [len(t) for t in tracks]),
        uv_px=np.zeros((n, 2)),
        whitening=np.tile(np.eye(2), (n, 1, 1)),
    )


def chain(rng: np.random.Generator, reach: int) -> list[list[int]]:
    first = rng.integers(0, N_STOPS - 1, 60)
    return [sorted({int(f), *rng.integers(f, min(f + reach + 1, N_STOPS), 3).tolist()}) for f in first]


@pytest.mark.parametrize("n", [1, 2, 3, 5, 12])
@pytest.mark.parametrize("closes", [False, True])
@pytest.mark.parametrize("reach", [1, 2, 4])
def test_nothing_joins_two_interiors(reach: int, closes: bool, n: int) -> None:
    tracks = chain(np.random.default_rng(reach), reach)
    if closes:  # the last stop sees the first, as a closed loop does
        tracks.append([0, 1, N_STOPS - 1])
    cliques = [(2, 9), (5, N_STOPS)]
    link, m = drive_of(tracks)
    cut = Dissection.of(link, m, cliques, n=n, n_stops=N_STOPS)
    assert cut.stage[N_STOPS] == n + 1  # shared
    of = [{int(s) for s in cut.stage[list(groups)] if s < n} for groups in (*tracks, *cliques)]
    for interiors, stretch in zip(of, [*cut.landmark, None, None], strict=True):
        assert len(interiors) <= 1
        assert stretch is None or interiors <= {int(stretch)}
    if n == 1:
        assert np.all(cut.stage[:N_STOPS] == 0)
    # Stretches follow each other, and joints are as few as a chain allows.
    inner = cut.stage[:N_STOPS][cut.stage[:N_STOPS] < n]
    assert np.all(np.diff(inner) >= 0)
    if not closes:
        assert np.count_nonzero(cut.stage == n) <= reach * (n - 1) + 1


def test_interiors_are_eliminated_first_and_leave_other_interiors_alone() -> None:
    tracks = chain(np.random.default_rng(7), 2)
    link, m = drive_of(tracks)
    cut = Dissection.of(link, m, [], n=3, n_stops=N_STOPS)
    reach = [(*track, N_STOPS) for track in tracks]
    st = pattern(link.group_dim, reach, stage=cut.stage)
    stages = cut.stage[list(st.order)]
    assert np.all(np.diff(stages) >= 0)
    for g, after in enumerate(st.after):
        if cut.stage[g] < cut.n:
            assert {int(s) for s in cut.stage[list(after)]} <= {int(cut.stage[g]), cut.n, cut.n + 1}
