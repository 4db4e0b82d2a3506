"""What memory holds of a drive: pictures, masks and arrays of steps are bounded, however long it is."""

import logging
import pickle
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

from pancam_graph import Frame, Image, Stop, Traverse
from pancam_graph.base.errors import ImageError
from pancam_graph.images import (
    FrontEndOptions,
    _cache,
    _read,
    _splines,
    _steps,
    find_masks,
    find_observations,
)
from pancam_graph.images._cache import Cache
from pancam_graph.images._held import Held
from pancam_graph.images._steps import Steps
from support.image_scenes import QUICK, SIZE_PX, as_bytes, found_in, make_traverse, small_rig

PICTURE_BYTES = SIZE_PX**2


class Alive:
    """Counts arrays that are alive at once."""

    def __init__(self) -> None:
        self.now = 0
        self.most = 0
        self.made = 0
        self._lock = threading.RLock()  # an array may end while another one is counted

    def counted(self, function: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
        def call(*arguments: Any) -> np.ndarray:
            array = function(*arguments)
            with self._lock:
                self.made += 1
                self.now += 1
                self.most = max(self.most, self.now)
            weakref.finalize(array, self._gone)
            return array

        return call

    def _gone(self) -> None:
        with self._lock:
            self.now -= 1


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> Alive:
    alive = Alive()
    monkeypatch.setattr(_read.PictureFiles, "_read", alive.counted(_read.PictureFiles._read))
    return alive


def drive_of_noise(folder: Path, stops: int) -> Traverse:
    """One picture of noise a stop, all of one pointing."""
    places = tuple(
        Stop(
            id=f"s{k}",
            world_T_mast=gtsam.Pose3(gtsam.Rot3(), np.array([2.0 * k, 0, 0])),
            sigma_rotation_rad=2e-3,
            sigma_translation_m=0.02,
        )
        for k in range(stops)
    )
    frames = tuple(
        Frame(id=f"f{k}", stop=f"s{k}", pan_rad=0.0, tilt_rad=-0.3, sigma_pan_rad=2e-3, sigma_tilt_rad=2e-3)
        for k in range(stops)
    )
    images = tuple(Image(id=f"i{k}", frame=f"f{k}", camera="left", file=f"{k}.png") for k in range(stops))
    rng = np.random.default_rng(stops)
    for image in images:
        samples = cv2.GaussianBlur(rng.integers(0, 256, (SIZE_PX, SIZE_PX)).astype(np.uint8), (0, 0), 1.5)
        assert cv2.imwrite(str(folder / str(image.file)), samples)
    return Traverse(name="noise", rig=small_rig(), stops=places, frames=frames, images=images, folder=folder)


def test_pictures_that_are_alive_at_once_are_bounded(
    tmp_path: Path, pictures: Alive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "2")
    traverse, by_hand = drive_of_noise(tmp_path, 14), FrontEndOptions(masks="user")
    free = find_masks(traverse, by_hand)
    assert (pictures.made, pictures.most) == (14, 14)  # nothing is read twice where memory has room
    monkeypatch.setattr(_read, "_HELD_BYTES", 3 * PICTURE_BYTES)
    pictures.made = pictures.most = 0
    del free
    masks = find_masks(traverse, by_hand)
    assert pictures.made == 14
    assert pictures.most <= 3 + 2  # those held, and one a thread
    assert [mask is not None for mask in masks] == [True] * 14


@pytest.mark.slow
def test_a_drive_through_little_memory_gives_the_same_bytes(
    tmp_path: Path, pictures: Alive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PANCAM_GRAPH_THREADS", "2")
    stops = tuple(gtsam.Pose3(gtsam.Rot3(), np.array([0.3 * k - 0.6, 0.2 * k, 0.0])) for k in range(5))
    traverse, _ = make_traverse(tmp_path, pans_deg=(-20.0, 0.0), stops=stops)
    free = find_observations(traverse, QUICK)
    assert (pictures.made, pictures.most) == (20, 20)
    assert free.matching is not None
    assert sum(pair.kept > 0 for pair in free.matching.stops) >= 4
    pictures.made = pictures.most = 0
    monkeypatch.setattr(_read, "_HELD_BYTES", 4 * PICTURE_BYTES)
    monkeypatch.setattr(_steps, "_HELD_MASK_BYTES", 4 * PICTURE_BYTES)
    monkeypatch.setattr(_splines, "_BYTES_PER_THREAD", 8 * PICTURE_BYTES)
    monkeypatch.setattr(_cache, "_HELD_BYTES", 100_000)
    little = find_observations(traverse, QUICK)
    assert as_bytes(found_in(little)) == as_bytes(found_in(free))
    assert (little.matching, little.warnings) == (free.matching, free.warnings)
    assert pictures.made > 20
    assert pictures.most <= 4 + 2 * 2  # those held, and of each thread an image and one to compare it with


def test_values_are_made_once_and_dropped_when_others_need_their_place() -> None:
    made, dropped = list[int](), list[int]()

    def value_of(key: int) -> bytes:
        made.append(key)
        return bytes(10)

    held = Held[int, bytes](25, len, lambda key, _: dropped.append(key))
    for key in (1, 2, 1, 3, 1, 2):
        assert held.get(key, lambda key=key: value_of(key)) == bytes(10)  # type: ignore[misc]  # bound at once
    assert (made, dropped) == ([1, 2, 3, 2], [2, 3])
    assert held.get(4, lambda: bytes(1000)) == bytes(1000)
    held.get(4, lambda: pytest.fail("one value is held, however large it is"))
    assert dropped == [2, 3, 1, 2]
    with pytest.raises(ZeroDivisionError):
        held.get(5, lambda: bytes(1 // 0))
    assert held.get(5, lambda: b"now") == b"now"


def test_one_thread_makes_what_several_ask_for() -> None:
    held, made, begin = Held[str, bytes](100, len), list[int](), threading.Barrier(4)

    def make() -> bytes:
        made.append(1)
        return b"value"

    def ask() -> None:
        begin.wait()
        assert held.get("key", make) == b"value"

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1


@pytest.mark.parametrize("full", [False, True])
def test_what_memory_has_no_room_for_is_not_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, full: bool
) -> None:
    def mkdtemp(prefix: str) -> str:
        if full:
            raise OSError("No space left on device")
        (tmp_path / prefix).mkdir()
        return str(tmp_path / prefix)

    monkeypatch.setattr(_cache, "mkdtemp", mkdtemp)
    made = list[int]()

    def recall(cache: Cache, k: int) -> np.ndarray:
        def make() -> dict[str, np.ndarray]:
            made.append(k)
            return {"a": np.full(10, k)}

        return cache.recall("kind", f"{k}" * 64, make)["a"]

    def use() -> None:
        cache = Cache(None, most_bytes=100)
        for k in (*range(5), *range(5)):
            np.testing.assert_array_equal(recall(cache, k), np.full(10, k))
        assert len(list(tmp_path.rglob("kind-*"))) == (0 if full else 5)

    with caplog.at_level(logging.WARNING):
        use()
    assert made == [0, 1, 2, 3, 4]
    assert ("No space left" in caplog.text) is full
    assert list(tmp_path.iterdir()) == []  # the temporary folder went with the cache


def test_a_picture_that_changes_meanwhile_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_read, "_HELD_BYTES", 1)
    traverse = drive_of_noise(tmp_path, 2)
    files = _read.PictureFiles(traverse, _read.read_pictures(traverse))
    assert files.samples(0).shape == (SIZE_PX, SIZE_PX)
    files.samples(1)
    cv2.imwrite(str(tmp_path / "0.png"), np.full((SIZE_PX, SIZE_PX), 9, np.uint8))
    with pytest.raises(ImageError, match=r"0\.png: expected the picture that was there .* changed meanwhile"):
        files.samples(0)


def test_another_process_goes_on_with_the_plan_of_a_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = Steps(drive_of_noise(tmp_path, 2), FrontEndOptions(masks="user"), None, Cache(tmp_path / "cache"))
    steps.plan()
    monkeypatch.setattr(_steps, "read_pictures", lambda *_: pytest.fail("it is in the plan"))
    monkeypatch.setattr(_steps, "overlapping_pairs", lambda *_, **__: pytest.fail("it is in the plan"))
    other = pickle.loads(pickle.dumps(steps))
    other.plan()
    assert [other.feature_key(row) for row in range(2)] == [steps.feature_key(row) for row in range(2)]
    for name, column in vars(other.features(0)).items():
        np.testing.assert_array_equal(column, getattr(steps.features(0), name))
