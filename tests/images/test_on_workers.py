"""Pictures on workers: the same bytes as alone, and everything that workers can do is done by them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pancam_graph import Traverse
from pancam_graph.base.errors import ClusterError, InputError
from pancam_graph.images import find_observations
from pancam_graph.images._cache import Cache
from support.image_scenes import QUICK, as_bytes, found_in, make_traverse

pytest.importorskip("distributed", reason="needs the extra pancam-graph[cluster]")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Traverse:
    return make_traverse(tmp_path_factory.mktemp("images"), pans_deg=(0.0, 20.0), eyes=("left",))[0]


@pytest.fixture(scope="module")
def alone(scene: Traverse) -> bytes:
    return as_bytes(found_in(find_observations(scene, QUICK)))


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bool, str]]:
    """Each result that was made instead of taken from the cache: whether on a worker, and its kind."""
    found: list[tuple[bool, str]] = []
    original = Cache._made

    def noting(
        self: Cache, kind: str, key: str, make: Callable[[], dict[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        found.append((self._must_keep, kind))
        return original(self, kind, key, make)

    monkeypatch.setattr(Cache, "_made", noting)
    return found


def test_workers_make_all_and_the_bytes_are_the_same(
    scene: Traverse, alone: bytes, client: Any, made: list[tuple[bool, str]], tmp_path: Path
) -> None:
    told: list[tuple[str, int, int]] = []
    found = find_observations(
        scene, QUICK, cache=tmp_path / "cache", client=client, progress=lambda *event: told.append(event)
    )
    assert as_bytes(found_in(found)) == alone
    assert sorted(made) == [
        (True, k)
        for k in ("features", "features", "mask", "mask", "matches", "observed", "refined", "tracks")
    ]
    assert found.folder == scene.folder
    assert ("images, stops and ties on workers", 9, 9) in told
    made.clear()
    assert (
        as_bytes(found_in(find_observations(scene, QUICK, cache=tmp_path / "cache", client=client))) == alone
    )
    assert not made


def test_workers_need_a_folder(scene: Traverse, client: Any) -> None:
    with pytest.raises(InputError, match="expected a folder for the cache"):
        find_observations(scene, QUICK, client=client)


def test_a_full_disk_at_a_worker_is_said(
    scene: Traverse, client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, key: str, arrays: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pancam_graph.images._cache._write", full)
    with pytest.raises(ClusterError, match=r"expected room for what a worker .* No space left on device"):
        find_observations(scene, QUICK, cache=tmp_path / "cache", client=client)
