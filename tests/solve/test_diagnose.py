"""Warnings about what the observations leave unconnected."""

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest
import scipy

from pancam_graph.data import Frame, Image, Observations, Stop, Traverse
from pancam_graph.landmarks import kernel
from pancam_graph.rigs import mer_navcam
from pancam_graph.solve._diagnose import components, connection_warnings


def traverse(tracks: Sequence[Sequence[str]], *, stops: int = 1, frames: int = 4) -> Traverse:
    """`frames` frames a stop, named a, b, c, ... throughout, both eyes; tracks list images such as 'aL'."""
    names = "abcdefghijklmnopqrstuvwxyz"[: stops * frames]
    images = tuple(
        Image(id=f + short, frame=f, camera=camera)
        for f in names
        for short, camera in (("L", "left"), ("R", "right"))
    )
    row = {image.id: i for i, image in enumerate(images)}
    image = np.array([row[i] for t in tracks for i in t])
    n = len(image)
    return Traverse(
        name="test",
        rig=mer_navcam(),
        stops=tuple(
            Stop(id=f"stop{s}", world_T_mast=gtsam.Pose3(), sigma_rotation_rad=0.01, sigma_translation_m=0.1)
            for s in range(stops)
        ),
        frames=tuple(
            Frame(
                id=f,
                stop=f"stop{i // frames}",
                pan_rad=0.1 * i,
                tilt_rad=0.0,
                sigma_pan_rad=0.001,
                sigma_tilt_rad=0.001,
            )
            for i, f in enumerate(names)
        ),
        images=images,
        observations=Observations(
            image=image,
            track=np.repeat(10 * np.arange(len(tracks)), [len(t) for t in tracks]),
            uv_px=np.zeros((n, 2)),
            sigma_px=np.ones(n),
        ),
    )


def warnings(t: Traverse, used: Sequence[bool] | None = None) -> list[str]:
    assert t.observations is not None
    rows = np.flatnonzero(np.ones(len(t.observations), bool) if used is None else np.array(used))
    return connection_warnings(t, t.observations.image[rows], t.observations.track[rows])


CHAIN = [["aL", "bL"], ["bR", "cL"], ["cR", "dR"], ["aR", "dL"]]


def test_nothing_is_said_of_frames_that_hang_together() -> None:
    """Through tracks and through the eyes of a frame, in any order."""
    assert warnings(traverse(CHAIN)) == []


def test_two_groups_of_frames_are_named() -> None:
    found = warnings(traverse([["aL", "aR", "bL"], ["bR", "bL"], ["cL", "dL", "dR"], ["cR", "dR"]]))
    assert found == [
        "2 groups of frames share no track: (1) a, b; (2) c, d; "
        "between them only telemetry joins the panorama"
    ]


def test_only_used_observations_connect() -> None:
    """Of the track that joins b and c one observation was rejected."""
    t = traverse([*CHAIN[:3], ["aR", "bR", "dL"]])
    assert warnings(t) == []
    used = [True, True, True, False, True, True, True, True, False]
    assert [w for w in warnings(t, used) if "groups" in w] == [
        "2 groups of frames share no track: (1) a, b; (2) c, d; "
        "between them only telemetry joins the panorama"
    ]


def test_images_without_a_used_observation_are_named_and_form_no_group() -> None:
    t = traverse([*CHAIN[:2], ["aR", "cR"]])
    assert warnings(t) == [
        "2 images without a used observation: dL, dR; only telemetry tells where they point"
    ]
    one = warnings(traverse([*CHAIN[:3], ["aR", "cR"]]))
    assert one == ["1 image without a used observation: dL; only telemetry tells where they point"]


def test_a_stop_alone_is_named() -> None:
    """Stops 0 and 2 share a track; stop 1 sees only its own."""
    inside = [["aL", "bL"], ["aR", "bR"], ["cL", "dL"], ["cR", "dR"], ["eL", "fL"], ["eR", "fR"]]
    t = traverse([*inside, ["bL", "eL"]], stops=3, frames=2)
    found = warnings(t)
    assert found[0].startswith("2 groups of frames share no track: (1) a, b, e, f; (2) c, d;")
    assert found[1:] == ["1 stop that no track connects to another: stop1; their place is what odometry says"]


def test_a_single_stop_needs_no_connection() -> None:
    assert not any("stop" in w for w in warnings(traverse([["aL", "bL"], ["cL", "dL"]])))


@pytest.mark.parametrize("n", [6, 7, 9])
def test_long_lists_are_cut_short_and_counted(n: int) -> None:
    t = traverse([["aL", "aR"]], frames=n + 1)
    (found,) = warnings(t)
    assert found.startswith(
        f"{2 * n} images without a used observation: bL, bR, cL, cR, dL, dR and {2 * n - 6} more"
    )
    groups = warnings(traverse([[f"{f}L", f"{f}R"] for f in "abcdefghi"[:n]], frames=n))
    assert groups[0].startswith(f"{n} groups of frames share no track: (1) a; (2) b;")
    assert (f"; and {n - 6} more;" in groups[0]) == (n > 6)


def test_components_number_images_that_share_landmarks() -> None:
    image, landmark = np.array([0, 2, 2, 4, 1]), np.array([0, 0, 1, 1, 2])
    n, group = components(5, image, landmark)
    assert n == 3
    assert group[0] == group[2] == group[4]
    assert len({group[0], group[1], group[3]}) == 3
    empty = np.zeros(0, dtype=np.int64)
    assert components(3, empty, empty)[0] == 3


def test_links_are_counted_once_for_each_landmark_and_owner() -> None:
    """Against sets, for random observations of which some are out of use."""
    rng = np.random.default_rng(4)
    landmark = np.sort(rng.integers(0, 60, 200))
    landmark = np.unique(landmark, return_inverse=True)[1]
    owner, kept = rng.integers(0, 7, 200), rng.random(200) < 0.6
    begin = np.searchsorted(landmark, np.arange(landmark[-1] + 2))
    n, used = np.zeros(7, dtype=np.int64), np.zeros(7, dtype=np.int64)
    kernel.count_links(begin, owner, kept, n, used)
    expected_n, expected_used = np.zeros(7, dtype=np.int64), np.zeros(7, dtype=np.int64)
    for j in range(landmark[-1] + 1):
        seen, in_use = set(owner[landmark == j]), set(owner[(landmark == j) & kept])
        if len(seen) >= 2:
            expected_n[list(seen)] += 1
            expected_used[list(in_use)] += len(in_use) >= 2
    assert np.array_equal(n, expected_n)
    assert np.array_equal(used, expected_used)
    assert 0 < used.sum() < n.sum()


def test_pairs_are_counted_by_how_many_of_the_two_are_in_use() -> None:
    """Against sets, for random observations of which some are out of use."""
    rng = np.random.default_rng(6)
    landmark = np.unique(np.sort(rng.integers(0, 80, 260)), return_inverse=True)[1]
    owner, kept = rng.integers(0, 4, 260), rng.random(260) < 0.4
    begin = np.searchsorted(landmark, np.arange(landmark[-1] + 2))
    pairs, expected = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    kernel.count_pairs(begin, owner, kept, 4, pairs)
    for j in range(landmark[-1] + 1):
        of_landmark = landmark == j
        if len(set(owner[of_landmark])) < 2 or not kept[of_landmark].any():
            continue
        for one in set(owner[of_landmark]):
            of_both = of_landmark & (owner == one)
            if of_both.sum() == 2:
                expected[kept[of_both].sum()] += 1
    assert np.array_equal(pairs, expected)
    assert (pairs > 0).all()


def test_components_are_those_of_the_graph() -> None:
    rng = np.random.default_rng(5)
    for n_members, n_landmarks, n in ((40, 60, 70), (10, 3, 5), (25, 200, 260)):
        member, landmark = rng.integers(0, n_members, n), rng.integers(0, n_landmarks, n)
        ones = np.ones(n)
        graph = scipy.sparse.coo_array(
            (ones, (member, n_members + landmark)), shape=(n_members + n_landmarks,) * 2
        )
        _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
        expected, group = label[:n_members], components(n_members, member, landmark)[1]
        assert np.array_equal(group[:, None] == group, expected[:, None] == expected)
