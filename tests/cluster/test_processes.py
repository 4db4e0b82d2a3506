"""Workers and schedulers as processes that are killed, lack the package, or are not there."""

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph.base.errors import ClusterError
from pancam_graph.cluster import Crew, Job, connected
from pancam_graph.images import find_observations
from support.cluster_jobs import (
    Folder,
    die_of_seven,
    hang_of_seven,
    hang_of_seven_once,
    mark,
    mark_slowly,
    same,
)
from support.image_scenes import QUICK, as_bytes, found_in, make_traverse

distributed = pytest.importorskip("distributed", reason="needs the extra pancam-graph[cluster]")
pytestmark = pytest.mark.slow
N_KILLS = 10
WITHOUT = "import sys; sys.modules['pancam_graph'] = None; "


def job(function: Callable[[Any, Any], None], folder: Path) -> Job:
    return Job(function=function, shared=Folder(folder), name=lambda item: f"item {item}")


def done_in(folder: Path) -> set[int]:
    return {int(path.name) for path in folder.glob("[0-9]*")}


@contextmanager
def scheduler(folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler in a process of its own, and its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    run = "from distributed.cli.dask_scheduler import main; main()"
    words = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    with process(folder, run, *words) as running:
        yield f"tcp://127.0.0.1:{port}", running


@contextmanager
def worker(folder: Path, address: str, before: str = "") -> Iterator[subprocess.Popen[bytes]]:
    run = f"{before}from distributed.cli.dask_worker import main; main()"
    words = [address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder)]
    with process(folder, run, *words) as running:
        yield running


@contextmanager
def process(folder: Path, run: str, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with (folder / f"log-{time.monotonic_ns()}").open("wb") as log:
        running = subprocess.Popen(
            [sys.executable, "-c", run, *words], stdout=log, stderr=log, cwd=folder, env=environment
        )
        try:
            yield running
        finally:
            running.kill()
            running.wait()


def test_a_run_ends_with_the_same_bytes_whoever_is_killed(tmp_path: Path) -> None:
    """Two stops, so that their terrain and their ties are among what is killed."""
    (tmp_path / "images").mkdir()
    stops = (gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.array([0.3, 0.2, 0.0])))
    scene, _ = make_traverse(tmp_path / "images", pans_deg=(-20.0, 0.0), stops=stops)
    found_alone = find_observations(scene, QUICK)
    assert found_alone.matching is not None
    assert all(pair.kept for pair in found_alone.matching.stops)
    alone = as_bytes(found_in(found_alone))
    draw, killed = random.Random(20), list[int]()
    with connected("local:2") as client:

        def kill(stage: str, done: int, total: int) -> None:
            if "on workers" not in stage or len(killed) == N_KILLS or done == total:
                return
            processes = [nanny.process.pid for nanny in client.cluster.workers.values() if nanny.process]
            living = [pid for pid in processes if pid is not None and pid not in killed]
            if living:
                killed.append(draw.choice(living))
                os.kill(killed[-1], signal.SIGKILL)

        found = find_observations(scene, QUICK, cache=tmp_path / "cache", client=client, progress=kill)
    assert len(killed) == N_KILLS
    assert as_bytes(found_in(found)) == alone
    assert found.matching == found_alone.matching
    assert not list((tmp_path / "cache").glob("parcel-*"))


def test_an_item_that_kills_each_worker_is_named(tmp_path: Path) -> None:
    with connected("local:1") as client:
        crew = Crew(client, folder=tmp_path, machine=same)
        with (
            pytest.raises(ClusterError, match="all workers that tried item 7 died; what was found so far"),
            crew.at_work(),
        ):
            crew.share(job(die_of_seven, tmp_path), range(10))
    assert done_in(tmp_path) >= set(range(7))


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A task that runs for two seconds hangs; however often it was given up."""
    monkeypatch.setattr("pancam_graph.cluster._hanging._LEAST_S", 2.0)
    monkeypatch.setattr("pancam_graph.cluster._hanging._GROWTH", 1.0)
    monkeypatch.setattr("pancam_graph.cluster._crew._LOOK_S", 0.5)


@pytest.mark.usefixtures("impatient")
def test_a_worker_that_hangs_is_ended_and_another_does_its_work(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with connected("local:2") as client:
        crew = Crew(client, folder=tmp_path, machine=same)
        with crew.at_work(), caplog.at_level("WARNING", "pancam_graph"):
            crew.share(job(hang_of_seven_once, tmp_path), range(40))
    assert done_in(tmp_path) == set(range(40))
    assert len([r for r in caplog.records if "did not end in" in r.getMessage()]) == 1
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "hangs").read_text()), 0)


@pytest.mark.usefixtures("impatient")
def test_an_item_that_hangs_on_each_worker_is_named(tmp_path: Path) -> None:
    with connected("local:1") as client:
        crew = Crew(client, folder=tmp_path, machine=same)
        expected = r"item 7: worker tcp://.* did not end in . s, nor did 2 others; what was found so far"
        with pytest.raises(ClusterError, match=expected), crew.at_work():
            crew.share(job(hang_of_seven, tmp_path), range(10))
    assert done_in(tmp_path) >= set(range(7))
    assert len(set((tmp_path / "hangs").read_text().split())) == 3


def test_a_scheduler_that_goes_is_said_and_what_is_done_stays(tmp_path: Path) -> None:
    with (
        scheduler(tmp_path) as (address, running),
        worker(tmp_path, address),
        connected(address) as client,
    ):
        crew = Crew(client, folder=tmp_path, machine=same)

        def kill(done: int, total: int) -> None:
            if done >= 5:
                running.kill()

        with (
            pytest.raises(ClusterError, match="the scheduler is gone; what was found so far is in"),
            crew.at_work(),
        ):
            crew.share(job(mark_slowly, tmp_path), range(400), done=kill)
    assert 5 <= len(done_in(tmp_path)) < 400


def test_no_worker_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pancam_graph.cluster._crew._WAIT_FOR_WORKERS_S", 2.0)
    with scheduler(tmp_path) as (address, _), connected(address) as client:
        crew = Crew(client, folder=tmp_path, machine=same)
        with pytest.raises(ClusterError, match="expected workers, found none in 2 s"), crew.at_work():
            pass
        monkeypatch.setattr("pancam_graph.cluster._crew._WAIT_FOR_WORKERS_S", 60.0)
        with worker(tmp_path, address) as only:

            def kill(done: int, total: int) -> None:
                monkeypatch.setattr("pancam_graph.cluster._crew._WAIT_FOR_WORKERS_S", 2.0)
                only.kill()

            with pytest.raises(ClusterError, match="no worker is left, and none came in 2 s"), crew.at_work():
                crew.share(job(mark_slowly, tmp_path), range(400), done=kill)


def test_a_worker_without_the_package_is_named(tmp_path: Path) -> None:
    with (
        scheduler(tmp_path) as (address, _),
        worker(tmp_path, address, WITHOUT),
        connected(address) as client,
    ):
        crew = Crew(client, folder=tmp_path, machine=same)
        with (
            pytest.raises(
                ClusterError, match=r"^worker tcp://.*: expected pancam_graph .*, found .*pancam_graph"
            ),
            crew.at_work(),
        ):
            crew.share(job(mark, tmp_path), range(3))


def test_nobody_listens_or_somebody_else_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pancam_graph.cluster._connect._CONNECT_S", 1.0)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{other.getsockname()[1]}"
        for listens in (False, True):
            if listens:
                other.listen()
            expected = f"^cluster {address}: expected a Dask scheduler that listens there, found none"
            with pytest.raises(ClusterError, match=expected), connected(address):
                pass
