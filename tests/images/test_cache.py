"""What the front end keeps: the same to the last bit with and without, and whatever becomes of the files."""

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest

from pancam_graph import Traverse
from pancam_graph.base import sources
from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import whole_folder
from pancam_graph.images import FrontEndOptions, cache_folder, find_observations, is_cache
from pancam_graph.images._cache import Cache, digest
from pancam_graph.images._cache_folder import begin_cache
from pancam_graph.images._placed import placed_key
from pancam_graph.images._steps import Steps, step_key
from pancam_graph.results import check_out
from support.image_scenes import QUICK, SIZE_PX, as_bytes, found_in, make_traverse
from support.parameters import slow_but_for
from support.pictures import read_picture


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Traverse:
    return make_traverse(tmp_path_factory.mktemp("images"), pans_deg=(-20.0, 0.0, 20.0), eyes=("left",))[0]


@pytest.fixture(scope="module")
def plain(scene: Traverse) -> bytes:
    return as_bytes(found_in(find_observations(scene, QUICK)))


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often each kind was made instead of taken from the cache."""
    counts: dict[str, int] = {}
    recall = Cache.recall

    def counting(self: Cache, kind: str, key: str, make: Callable[[], dict[str, np.ndarray]]) -> object:
        def counted() -> dict[str, np.ndarray]:
            counts[kind] = counts.get(kind, 0) + 1
            return make()

        return recall(self, kind, key, counted)

    monkeypatch.setattr(Cache, "recall", counting)
    return counts


def run(scene: Traverse, folder: Path, options: FrontEndOptions = QUICK) -> bytes:
    return as_bytes(found_in(find_observations(scene, options, cache=folder)))


def test_with_and_without_a_cache_the_same_bytes(
    scene: Traverse, plain: bytes, made: dict[str, int], tmp_path: Path
) -> None:
    assert run(scene, tmp_path) == plain
    assert made == {"mask": 3, "features": 3, "matches": 3, "tracks": 1, "refined": 2, "observed": 1}
    made.clear()
    assert run(scene, tmp_path) == plain
    assert made == {}


@pytest.mark.slow
def test_only_what_an_image_touches_is_made_anew(
    scene: Traverse, made: dict[str, int], tmp_path: Path
) -> None:
    assert scene.folder is not None
    run(scene, tmp_path)
    made.clear()
    path = scene.folder / str(scene.images[0].file)
    before = path.read_bytes()
    try:
        grey = read_picture(path)
        grey[100, 100] ^= 1
        cv2.imwrite(str(path), grey)
        changed = run(scene, tmp_path)
        assert (made["mask"], made["features"]) == (1, 1)
        assert made["matches"] == 2
        assert changed == as_bytes(found_in(find_observations(scene, QUICK)))
    finally:
        path.write_bytes(before)


def test_options_rig_pointing_and_masks_are_seen(scene: Traverse) -> None:
    def keys(traverse: Traverse, options: FrontEndOptions = QUICK) -> list[str]:
        steps = Steps(traverse, options, None, Cache(None))
        return [steps.feature_key(row) for row in range(len(traverse.images))]

    before = keys(scene)
    assert keys(scene) == before
    turned = replace(scene, frames=(replace(scene.frames[0], pan_rad=1e-9), *scene.frames[1:]))
    eyes = scene.rig.eyes
    moved = gtsam.Pose3(eyes[0].head_T_camera.rotation(), eyes[0].head_T_camera.translation() + 1e-9)
    rig = replace(scene.rig, eyes=(replace(eyes[0], head_T_camera=moved), eyes[1]))
    assert scene.folder is not None
    mask = np.full((SIZE_PX, SIZE_PX), 255, np.uint8)
    mask[7, 7] = 0
    cv2.imwrite(str(scene.folder / "mask.png"), mask)
    masked = replace(scene, images=(replace(scene.images[0], mask="mask.png"), *scene.images[1:]))
    for other, options, alike in (
        (scene, replace(QUICK, ratio=0.8), [False] * 3),
        (replace(scene, rig=rig), QUICK, [False] * 3),
        (turned, QUICK, [False, True, True]),
        (masked, QUICK, [False, True, True]),
    ):
        assert [a == b for a, b in zip(keys(other, options), before, strict=True)] == alike


@pytest.mark.slow
def test_the_same_pictures_in_other_rows(scene: Traverse, tmp_path: Path) -> None:
    """What is kept of a stop may stand in other rows of a drive that has grown before it."""
    before = found_in(find_observations(scene, QUICK, cache=tmp_path))
    frame = replace(scene.frames[0], id="another", pan_rad=np.pi)
    image = replace(scene.images[0], id="another", frame="another", file=None)
    grown = replace(scene, frames=(frame, *scene.frames), images=(image, *scene.images))
    after = found_in(find_observations(grown, QUICK, cache=tmp_path))
    np.testing.assert_array_equal(after.image, before.image + 1)
    np.testing.assert_array_equal(after.uv_px, before.uv_px)


def test_another_version_of_a_library_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    before = digest("features", 1.0)
    assert digest("features", 1.0) == before
    monkeypatch.setattr("pancam_graph.images._cache.libraries", lambda: {"gtsam": "another"})
    assert digest("features", 1.0) != before


WITHIN = ("mask", "features", "matches", "tracks", "refined", "observed")
KINDS = (*WITHIN, "rig", "terrain", "ties")


def key_of(kind: str) -> str:
    return step_key(kind) if kind in WITHIN else placed_key(kind)


@pytest.mark.parametrize(
    ("edited", "stale"),
    [
        ("factors.mast", {"rig", "terrain"}),
        ("landmarks.kernel._eliminate", {"rig", "terrain"}),
        ("images._features", {"features", "matches", "ties"}),
        ("images._sky", {"mask"}),
        ("images._tracks", {"tracks", "observed"}),
        ("images._patches", {"refined", "ties"}),
        ("rigs._rig", {"mask", "matches", "refined", "rig", "terrain", "ties"}),
        ("report._style", set()),
        ("results._residuals", set()),
        ("images._steps", set(KINDS)),
    ],
)
def test_an_edit_makes_those_steps_stale_that_run_through_it(
    monkeypatch: pytest.MonkeyPatch, edited: str, stale: set[str]
) -> None:
    """Of the steps' own sources; by their inputs, more steps follow from a stale one."""
    before = {kind: key_of(kind) for kind in KINDS}
    name = f"pancam_graph.{edited}"
    file, text = sources.source_of(name)
    assert text
    read = sources.source_of
    monkeypatch.setattr(
        sources, "source_of", lambda module: (file, f"{text}# edited\n") if module == name else read(module)
    )
    sources._digest.cache_clear()
    try:
        after = {kind: key_of(kind) for kind in KINDS}
    finally:
        sources._digest.cache_clear()
    assert {kind for kind in KINDS if before[kind] != after[kind]} == stale


def test_an_edit_of_a_lens_makes_anew_what_images_through_it_show(
    scene: Traverse, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = Steps(scene, QUICK, None, Cache(None)).picture_keys
    lens = type(scene.rig.eyes[0].camera).__module__
    file, text = sources.source_of(lens)
    read = sources.source_of
    monkeypatch.setattr(
        sources, "source_of", lambda module: (file, f"{text}# edited\n") if module == lens else read(module)
    )
    sources._digest.cache_clear()
    try:
        after = Steps(scene, QUICK, None, Cache(None)).picture_keys
    finally:
        sources._digest.cache_clear()
    assert not set(before) & set(after)


def test_a_digest_sees_every_bit_and_every_boundary() -> None:
    values: list[object] = [
        None, 0, 0.0, False, "", "0", b"", [], [[]], [0], [0, 0], [[0], 0], {"a": 1}, {"a": 1.0}, ["ab", "c"],
        ["a", "bc"], np.zeros(2), np.zeros((1, 2)), np.zeros(2, np.float32), np.array([0.0, -0.0]), 1.0,
        np.nextafter(1.0, 2.0), gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.array([1e-300, 0, 0])),
        QUICK, replace(QUICK, ratio=0.8),
    ]  # fmt: skip
    assert len({digest(v) for v in values}) == len(values)
    with pytest.raises(TypeError, match="no digest of object"):
        digest(object())


@pytest.mark.parametrize("damage", slow_but_for("flip", ["truncate", "flip", "empty", "other", "swap"]))
def test_damaged_files_are_logged_and_made_anew(
    scene: Traverse, plain: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    run(scene, tmp_path)
    files = sorted(tmp_path.glob("features-*.npz"))
    data = files[0].read_bytes()
    middle = len(data) // 2
    files[0].write_bytes(
        {
            "truncate": data[:middle],
            "flip": data[:middle] + bytes([data[middle] ^ 64]) + data[middle + 1 :],
            "empty": b"",
            "other": b"\x93NUMPY" + data,
            "swap": files[1].read_bytes(),
        }[damage]
    )
    with caplog.at_level(logging.WARNING):
        assert run(scene, tmp_path) == plain
    assert [files[0].name in r.getMessage() and "made anew" in r.getMessage() for r in caplog.records] == [
        True
    ]
    assert files[0].read_bytes() == data


@pytest.mark.slow
def test_what_is_not_needed_any_more_is_deleted_and_nothing_else(scene: Traverse, tmp_path: Path) -> None:
    run(scene, tmp_path)
    before = {p.name for p in tmp_path.iterdir()}
    (tmp_path / "notes.txt").write_text("mine")
    run(scene, tmp_path, replace(QUICK, ratio=0.8))
    after = {p.name for p in tmp_path.iterdir()}
    assert before & after == {"cache.json"}
    assert len(after) == pytest.approx(len(before) + 1, abs=2)
    assert "notes.txt" in after


def test_a_place_that_cannot_be_written_costs_nothing_but_the_cache(
    scene: Traverse, plain: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    with caplog.at_level(logging.WARNING):
        assert run(scene, tmp_path / "file" / "cache") == plain
    assert "not kept" in caplog.text


def test_an_interrupted_run_goes_on_where_it_was(
    scene: Traverse, plain: bytes, made: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of several threads others may be done with their pairs by then.
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "1")

    def interrupt(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("matches", 1):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_observations(scene, QUICK, cache=tmp_path, progress=interrupt)
    assert made == {"mask": 3, "features": 3, "matches": 1}
    made.clear()
    assert run(scene, tmp_path) == plain
    assert made == {"matches": 2, "tracks": 1, "refined": 2, "observed": 1}


def test_a_folder_with_nothing_but_a_cache_may_become_results(tmp_path: Path) -> None:
    begin_cache(cache_folder(tmp_path / "out"))
    assert is_cache(tmp_path / "out" / "cache")
    check_out(tmp_path / "out")
    (tmp_path / "mine" / "cache").mkdir(parents=True)
    (tmp_path / "mine" / "cache" / "diary.txt").write_text("dear diary")
    with pytest.raises(InputError, match=r"mine: expected .* found other things in it: cache"):
        check_out(tmp_path / "mine")


@pytest.mark.parametrize("fails", [False, True])
def test_the_cache_moves_into_new_results_or_stays_with_the_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    out = tmp_path / "out"
    begin_cache(cache_folder(out))
    (out / "old.txt").write_text("old")
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if fails and target == out and self.name.endswith(".partial"):
            raise OSError("no")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    try:
        with whole_folder(out, keep="cache") as folder:
            (folder / "new.txt").write_text("new")
    except OSError:
        assert fails
    assert sorted(p.name for p in out.iterdir()) == ["cache", "old.txt" if fails else "new.txt"]
    assert is_cache(cache_folder(out))
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_entries_of_a_right_key_and_other_content_and_pipes_are_made_anew(tmp_path: Path) -> None:
    made = {"a": np.arange(3.0)}
    key = "k" * 64
    Cache(tmp_path).recall("kind", key, lambda: made)
    (path,) = tmp_path.glob("kind-*.npz")
    with np.load(path) as archive:
        arrays = dict(archive)
    for other in (
        {"a": np.zeros(3)},
        {"a": made["a"].astype(">f8")},
        {"a": made["a"][:2]},
        {"b": made["a"]},
        {},
    ):
        np.savez(path, key=arrays["key"], **other)
        kept = Cache(tmp_path).recall("kind", key, lambda: made)
        assert kept.keys() == made.keys()
        np.testing.assert_array_equal(kept["a"], made["a"])
    path.unlink()
    os.mkfifo(path)
    np.testing.assert_array_equal(Cache(tmp_path).recall("kind", key, lambda: made)["a"], made["a"])
    assert path.is_file()


def test_a_folder_in_place_of_an_entry_is_worked_around(tmp_path: Path) -> None:
    key = "k" * 64
    (tmp_path / f"kind-{key[:40]}.npz").mkdir()
    (tmp_path / "kind-other.npz").mkdir()
    cache = Cache(tmp_path)
    assert list(cache.recall("kind", key, lambda: {"a": np.zeros(1)})) == ["a"]
    cache.forget_others()
