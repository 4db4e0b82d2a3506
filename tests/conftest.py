"""Fixtures that several test modules share, and the option --shuffle."""

import os
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pancam_graph.base.compiled import Entry
from pancam_graph.base.native_code import NativeFunction

ROOT = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --shuffle SEED, so that a run can show that no test depends on another."""
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run the tests in an order drawn from SEED")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Draw the order of modules, and of tests within each; a module's fixtures are still made once.

    Every process of pytest-xdist collects in the same order, as it must, because the seed is the same.
    """
    seed = config.getoption("--shuffle")
    if seed is None:
        return
    of_module: dict[Path, list[pytest.Item]] = {}
    for item in items:
        of_module.setdefault(item.path, []).append(item)
    order = random.Random(seed)
    modules = list(of_module.values())
    order.shuffle(modules)
    for module in modules:
        order.shuffle(module)
    items[:] = [item for module in modules for item in module]


@pytest.fixture(scope="session", autouse=True)
def _compiled_code_is_called_without_numba() -> Iterator[None]:
    """Any test fails that calls a function of the package which only Numba's dispatcher can call.

    Such a function is compiled anew in each process of a user's, and all that is seen of it is a warning.
    """
    compile_now = Entry._compiled

    def compiled(entry: Entry, *arguments: Any) -> NativeFunction | None:
        native = compile_now(entry, *arguments)
        package = (entry.__module__ or "").partition(".")[0]
        assert native is not None or package != "pancam_graph", f"{entry._kept.name} needs Numba at each run"
        return native

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Entry, "_compiled", compiled)
        yield


def shared(name: str) -> Path:
    """A file or folder that is not in the repository; the test is skipped where it is missing.

    Looked for in the folder that PANCAM_GRAPH_SHARED names, then in ../shared beside the repository.
    """
    named = os.environ.get("PANCAM_GRAPH_SHARED")
    roots = [Path(named)] if named else []
    roots.append(ROOT.parent / "shared")
    for root in roots:
        if (root / name).exists():
            return root / name
    pytest.skip(f"no {name} in {' or '.join(str(r) for r in roots)}; set PANCAM_GRAPH_SHARED")


@pytest.fixture(scope="session")
def opportunity_folder() -> Path:
    """Five left Navcam images of Opportunity, sol 4087."""
    return shared("data/opportunity_navcam_sol4087")


@pytest.fixture(scope="session")
def pds4_folder() -> Path:
    """A PDS4 label of a Navcam image of Perseverance, and two labelled images of the PanCam of ExoMars."""
    return shared("data/pds4_labels")


@pytest.fixture(scope="session")
def msl_label_folder() -> Path:
    """Labels of Curiosity, one of them with its image."""
    return shared("data/msl_labels")


@pytest.fixture(scope="session")
def feed_folder() -> Path:
    """A Navcam picture of Perseverance with its record, from the public feed of raw images."""
    return shared("data/mars2020_raw")


@pytest.fixture(scope="session")
def bench_generator() -> Path:
    """The program that writes the traverses of the benchmark."""
    return shared("bench/make_traverse.py")


@pytest.fixture(scope="session")
def scripts_folder() -> Path:
    """The repository's programs; tests of an installed wheel have none."""
    folder = ROOT / "scripts"
    if not folder.is_dir():
        pytest.skip(f"no {folder}: the programs are part of the repository, not of the package")
    return folder


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    """A client of two Dask workers of one thread in this process."""
    distributed = pytest.importorskip("distributed", reason="needs the extra pancam-graph[cluster]")
    with distributed.Client(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, set_as_default=False
    ) as client:
        yield client
