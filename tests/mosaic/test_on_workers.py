"""Mosaics on workers of a cluster: the same files, and none lost where the cluster fails."""

from pathlib import Path
from typing import Any

import pytest

from pancam_graph.base.errors import ClusterError
from pancam_graph.images import Cache
from pancam_graph.mosaic import MosaicOptions, _files, write_mosaics
from pancam_graph.mosaic._stop_files import EyeFiles
from pancam_graph.results import write_results
from support.mosaic_scenes import Scene, solved, without_file

NEAR = MosaicOptions(ground_radius_m=4.0, ground_m_per_px=0.02)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.slow
def test_stops_on_workers_give_the_same_files(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both eyes, with 16 bits, one picture that cannot be shown; nothing stays in the cache."""
    (tmp_path / "images").mkdir()
    solution = without_file(solved(Scene(cameras=("left", "right"), bits=16), tmp_path / "images"), 1)
    folders = [tmp_path / "alone", tmp_path / "shared"]
    told: list[tuple[str, int, int]] = []
    for folder in folders:
        folder.mkdir()
    alone = write_mosaics(solution, folders[0], NEAR)
    kept, by_hand = _files._Stops.kept, list[int]()

    def noted(stops: _files._Stops, stop: int, cache: Cache) -> list[EyeFiles]:
        by_hand.append(stop)
        return kept(stops, stop, cache)

    monkeypatch.setattr(_files._Stops, "kept", noted)
    shared = write_mosaics(
        solution,
        folders[1],
        NEAR,
        cache=tmp_path / "cache",
        client=client,
        progress=lambda *event: told.append(event),
    )
    assert by_hand == [0, 0]  # on a worker, and to take it from the cache
    assert told == [("mosaics on workers", 1, 1)]
    assert contents(folders[1]) == contents(folders[0])
    assert len(contents(folders[0])) > 10
    assert (shared.lines, shared.warnings, shared.blinks) == (alone.lines, alone.warnings, alone.blinks)
    assert alone.warnings
    assert alone.blinks
    assert not list((tmp_path / "cache").glob("mosaics-*"))


@pytest.mark.slow
def test_mosaics_are_drawn_alone_where_the_cluster_fails(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    def gone(*_: Any, **__: Any) -> None:
        raise ClusterError("the scheduler is gone")

    monkeypatch.setattr("pancam_graph.cluster.Crew.share", gone)
    (tmp_path / "images").mkdir()
    solution = solved(Scene(), tmp_path / "images")
    with caplog.at_level("WARNING", "pancam_graph"):
        write_results(solution, tmp_path / "out", report=False, mosaics=NEAR, client=client)
    assert "the scheduler is gone; this process goes on alone" in caplog.text
    assert (tmp_path / "out" / "mosaics" / "mosaics.json").is_file()
