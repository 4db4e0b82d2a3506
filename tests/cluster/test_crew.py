"""Work on workers: everything is done once or named, whoever dies; here with workers in this process."""

import logging
from pathlib import Path
from typing import Any

import pytest

from pancam_graph.base.errors import ClusterError, InputError
from pancam_graph.cluster import Crew, Job, _machine, connected, dashboard, log_workers
from pancam_graph.cluster._hanging import Pace
from support import cluster_jobs
from support.cluster_jobs import Folder, mark, mark_after, mark_but_for_seven, same

pytest.importorskip("distributed", reason="needs the extra: pip install 'pancam-graph[cluster]'")


def job(function: Any, folder: Path) -> Job:
    return Job(function=function, shared=Folder(folder), name=lambda item: f"item {item}")


def marks(folder: Path) -> dict[int, int]:
    return {int(path.name): int(path.read_text()) for path in folder.glob("[0-9]*")}


def test_all_items_are_done_and_counted_and_nothing_else_is_left(client: Any, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    crew = Crew(client, folder=tmp_path, machine=same)
    with crew.at_work():
        crew.share(job(mark, tmp_path), range(20), done=lambda done, total: told.append((done, total)))
        assert marks(tmp_path) == {i: i * i for i in range(20)}
        assert [done for done, _ in told] == sorted({done for done, _ in told})
        assert told[-1] == (20, 20)
        crew.share(job(mark, tmp_path), [])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(map(str, range(20)))


def test_an_item_that_fails_fails_alone_after_three_tries(
    client: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    crew, told = Crew(client, folder=tmp_path, machine=same), list[int]()
    with crew.at_work(), caplog.at_level(logging.WARNING, "pancam_graph"):
        crew.share(job(mark_but_for_seven, tmp_path), range(10), done=lambda done, _: told.append(done))
    assert set(marks(tmp_path)) == set(range(10)) - {7}
    assert told[-1] == 10
    assert (tmp_path / "tries").read_text().split().count("7") == 3
    said = [r.getMessage() for r in caplog.records if r.name.startswith("pancam_graph")]
    assert said == ["item 7: no worker could do it: ValueError: seven is not to be done"]


def test_another_version_is_named(client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    crew = Crew(client, folder=tmp_path, machine=same)
    monkeypatch.setattr(cluster_jobs, "SAME", {"pancam_graph": "2", "processor": "abacus"})
    with (
        pytest.raises(
            ClusterError,
            match=r"^worker inproc://.*: expected pancam_graph 1 as on the machine that asks, found 2$",
        ),
        crew.at_work(),
    ):
        pass


def test_a_worker_of_another_processor_that_comes_later_is_named(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crew = Crew(client, folder=tmp_path, machine=same)
    with crew.at_work():
        monkeypatch.setattr(cluster_jobs, "SAME", {"pancam_graph": "1", "processor": "slide rule"})
        with pytest.raises(
            ClusterError, match=r"^worker inproc://.*: expected processor abacus .*slide rule$"
        ):
            crew.share(job(mark, tmp_path), range(3))
    assert not marks(tmp_path)


def test_a_file_that_workers_see_otherwise_is_named(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"pixels")
    crew = Crew(client, folder=tmp_path, machine=same)
    monkeypatch.setattr("pancam_graph.cluster._worker._size", lambda path: 5)
    with (
        pytest.raises(ClusterError, match=r"expected the file .*picture\.png as the machine that asks"),
        crew.at_work([picture]),
    ):
        pass


def test_what_a_parcel_holds_is_what_the_client_wrote(client: Any, tmp_path: Path) -> None:
    crew = Crew(client, folder=tmp_path, machine=same)
    with crew.at_work():
        parcel = crew.parcel(Folder(tmp_path))
        parcel.path.write_bytes(b"something else")
        with pytest.raises(ClusterError, match="found other content"):
            crew.share(job(mark, tmp_path), range(3))


@pytest.mark.parametrize("address", ["", "local:0", "localhost", "127.0.0.1:8786", "http://here:80"])
def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(ClusterError, match="expected the address of a Dask scheduler"), connected(address):
        pass


def test_an_extra_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'pancam-graph\[cluster\]'"), connected("local"):
        pass


def test_a_machine_says_its_sources_and_processor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    here = dict(_machine.machine())
    assert list(here) == ["pancam_graph", "sources of pancam_graph", "Python", "processor"]
    assert all(here.values())
    known = dict(_machine._modules())
    assert "pancam_graph/__init__.py" in known
    assert "pancam_graph.factors/mast.py" in known
    edited = tmp_path / "mast.py"
    edited.write_text(known["pancam_graph.factors/mast.py"].read_text() + "\n")
    monkeypatch.setattr(
        _machine, "_modules", lambda: [*{**known, "pancam_graph.factors/mast.py": edited}.items()]
    )
    assert _machine._package_digest()[:12] != here["sources of pancam_graph"]


def test_items_begin_after_those_that_they_need(client: Any, tmp_path: Path) -> None:
    after: list[list[int]] = [[] for _ in range(8)] + [[k - 8, (k + 1) % 8] for k in range(8, 16)]
    crew = Crew(client, folder=tmp_path, machine=same)
    items = [(number, tuple(before)) for number, before in enumerate(after)]
    with crew.at_work():
        crew.share(job(mark_after, tmp_path), items, after)
    assert marks(tmp_path) == {i: i * i for i in range(16)}


def test_what_comes_after_a_failure_is_left_too(client: Any, tmp_path: Path) -> None:
    after: list[list[int]] = [[] for _ in range(8)] + [[7], [8], [6]]
    told = list[int]()
    crew = Crew(client, folder=tmp_path, machine=same)
    with crew.at_work():
        crew.share(job(mark_but_for_seven, tmp_path), range(11), after, lambda done, _: told.append(done))
    assert set(marks(tmp_path)) == {*range(7), 10}
    assert told[-1] == 11


def test_each_worker_has_a_log(client: Any, tmp_path: Path) -> None:
    logs, cache = tmp_path / "run.log.workers", tmp_path / "cache"
    cache.mkdir()
    level = logging.getLogger("pancam_graph").level
    log_workers(client, logs)
    crew = Crew(client, folder=cache, machine=same)
    with crew.at_work():
        crew.share(job(mark, cache), range(4))
    assert logging.getLogger("pancam_graph").level == logging.DEBUG
    client.unregister_worker_plugin("pancam-graph-log")
    assert logging.getLogger("pancam_graph").level == level
    text = [path.read_text() for path in sorted(logs.iterdir())]
    assert len(text) == 2
    assert all(f"{item}" in "".join(text) for item in range(4))
    assert dashboard(client) is None or str(dashboard(client)).startswith("http")


def test_what_hangs_is_told_by_the_longest_of_its_kind() -> None:
    pace = Pace()
    assert pace.limit_s(["a", "b"], 0) == 600.0
    pace.ended(["a"], 50.0)
    pace.ended(["a", "a"], 40.0)
    pace.ended(["b"], 1.0)
    assert pace.limit_s(["b"], 0) == 600.0
    assert pace.limit_s(["a"], 0) == 1000.0
    assert pace.limit_s(["a", "a", "b"], 0) == 2020.0
    assert pace.limit_s(["a"], 2) == 4000.0


def test_a_scheduler_that_cannot_tell_what_runs_is_said_once(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: Any) -> None:
        raise ModuleNotFoundError("No module named 'pancam_graph'")

    monkeypatch.setattr("pancam_graph.cluster._crew._LOOK_S", 0.0)
    monkeypatch.setattr(client, "run_on_scheduler", refuse)
    crew = Crew(client, folder=tmp_path, machine=same)
    with crew.at_work(), caplog.at_level(logging.WARNING, "pancam_graph"):
        crew.share(job(mark, tmp_path), range(20))
    assert len(marks(tmp_path)) == 20
    assert len([r for r in caplog.records if "does not tell what runs" in r.getMessage()]) == 1
