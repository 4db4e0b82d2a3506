"""How the shell scripts find an interpreter and make `.venv`: with stubs for Python, nothing is installed."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from support.parameters import slow_but_for

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ("bash", "cat", "cksum", "cp", "dirname", "grep", "head", "mkdir", "rm", "sed", "sort", "tail", "tee")

# A stub answers `-c CODE` by running the code in the real interpreter, which is told to be another version.
# `-m venv` puts the stub into the new environment, as Python and as the command; all else is only noted.
STUB = """#!/bin/sh
case "$1" in
    -c) shift; code=$1; shift; exec {real} -c "import sys; sys.version_info = {version}; {also}
$code" "$@" ;;
    --version) echo "Python {dotted}" ;;
    -m)
        echo "{dotted} $*" >> "{log}"
        case "$2 $3" in
            "venv --clear") rm -r -f "$4" && mkdir -p "$4/bin"
                cp "$0" "$4/bin/python" && cp "$0" "$4/bin/pancam-graph" ;;
            "pip install") {pip} ;;
            "pytest "*) {pytest} ;;
        esac ;;
    *) echo "{dotted} $*" >> "{log}" ;;
esac
"""


class Checkout:
    """A copy of the scripts, and a PATH that holds stubs and the few tools that the scripts need."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "repository"
        self.path = folder / "bin"
        self.home = folder / "home"
        self.log = folder / "log"
        (self.folder / "scripts").mkdir(parents=True)
        (self.folder / ".ci").mkdir()
        self.path.mkdir()
        self.home.mkdir()
        for name in ("environment.sh", "demo.sh", "test.sh", "test_all_pythons.sh"):
            shutil.copy(ROOT / "scripts" / name, self.folder / "scripts")
        shutil.copy(ROOT / "pyproject.toml", self.folder)
        shutil.copy(ROOT / ".ci/requirements.lock", self.folder / ".ci")
        for tool in TOOLS:
            real = shutil.which(tool)
            assert real
            (self.path / tool).symlink_to(real)

    def stub(
        self,
        where: str,
        dotted: str,
        *,
        venv: bool = True,
        implementation: str = "",
        pip: str = ":",
        pytest: str = ":",
    ) -> Path:
        """An interpreter of a version: `where` is a name on the PATH or a path below the home folder.

        `pip` and `pytest` are the shell's commands that it runs in their place.
        """
        also = "" if venv else "sys.modules['ensurepip'] = None; "
        if implementation:
            also += f"sys.implementation.name = '{implementation}'"
        path = (self.home if "/" in where else self.path) / where
        path.parent.mkdir(parents=True, exist_ok=True)
        version = tuple(int(part) for part in dotted.split("."))
        text = STUB.format(
            real=sys.executable,
            version=version,
            also=also,
            dotted=dotted,
            log=self.log,
            pip=pip,
            pytest=pytest,
        )
        path.write_text(text)
        path.chmod(0o755)
        return path

    def shim(self, where: str) -> None:
        """A name on the PATH that starts no interpreter, as pyenv leaves for versions that are not chosen."""
        (self.path / where).write_text("#!/bin/sh\necho 'command not found' >&2\nexit 127\n")
        (self.path / where).chmod(0o755)

    def run(self, script: str = "demo.sh", **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["bash", str(self.folder / "scripts" / script)],
            env={"PATH": str(self.path), "HOME": str(self.home), **environment},
            text=True,
            capture_output=True,
            check=False,
        )

    @property
    def calls(self) -> list[str]:
        """What the stubs were asked to do, each with the version of the stub."""
        return self.log.read_text().splitlines() if self.log.exists() else []

    @property
    def installations(self) -> int:
        return sum("pip install" in call for call in self.calls)


@pytest.fixture
def checkout(scripts_folder: Path, tmp_path: Path) -> Checkout:
    assert scripts_folder == ROOT / "scripts"
    return Checkout(tmp_path)


def test_takes_python3_where_it_is_promised(checkout: Checkout) -> None:
    checkout.stub("python3", "3.12.4")
    checkout.stub("python3.13", "3.13.1")
    done = checkout.run()
    assert (done.returncode, done.stderr) == (0, "")
    assert "making .venv with Python 3.12.4" in done.stdout
    assert "so " not in done.stdout
    assert all(call.startswith("3.12.4") for call in checkout.calls)
    assert any(call.startswith("3.12.4 refine ") for call in checkout.calls)


@pytest.mark.parametrize("dotted", slow_but_for("3.10.13", ["3.10.13", "3.99.0"]), ids=["too old", "too new"])
def test_takes_another_version_from_the_path(checkout: Checkout, dotted: str) -> None:
    checkout.stub("python3", dotted)
    checkout.stub("python3.11", "3.11.2")
    other = checkout.stub("python3.12", "3.12.4")
    done = checkout.run()
    assert (done.returncode, done.stderr) == (0, "")
    named = dotted.rpartition(".")[0]
    assert re.match(rf"python3 is Python {named}; .* 3\.11 to 3\.\d+, so {other} is used\n", done.stdout)
    assert all(call.startswith("3.12.4") for call in checkout.calls)


@pytest.mark.parametrize(
    "where",
    [".pyenv/versions/3.13.0/bin/python3.13", ".local/share/uv/python/cpython-3.13.0-linux/bin/python3.13"],
)
def test_looks_where_pyenv_and_uv_keep_interpreters(checkout: Checkout, where: str) -> None:
    checkout.shim("python3")
    checkout.shim("python3.13")
    other = checkout.stub(where, "3.13.0")
    done = checkout.run()
    assert (done.returncode, done.stderr) == (0, "")
    assert "python3 does not start; pancam_graph needs Python 3.11 to" in done.stdout
    assert f"so {other} is used" in done.stdout


def test_a_hidden_interpreter_is_found_behind_a_shim(checkout: Checkout, tmp_path: Path) -> None:
    checkout.stub("python3", "3.9.2")
    checkout.shim("python3.12")
    behind = tmp_path / "behind"
    other = checkout.stub("behind/python3.12", "3.12.1")
    behind.symlink_to(other.parent)
    done = subprocess.run(
        ["bash", str(checkout.folder / "scripts/demo.sh")],
        env={"PATH": f"{checkout.path}{os.pathsep}{behind}", "HOME": str(tmp_path / "nobody")},
        text=True,
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert f"so {behind}/python3.12 is used" in done.stdout


Prepared = Callable[[Checkout], object]


@pytest.mark.parametrize(
    ("have", "said"),
    [
        (lambda c: None, "python3 is not on the PATH"),
        (lambda c: c.stub("python3", "3.10.13"), "python3 is Python 3.10"),
        (lambda c: c.stub("python3", "3.11.7", implementation="pypy"), "python3 is pypy, not CPython"),
        (lambda c: c.stub("python3", "3.11.7", venv=False), "have it in python3.11-venv"),
        (
            lambda c: (c.stub("python3", "3.9.2"), c.stub("python3.12", "3.12.1", venv=False)),
            "python3 is Python 3.9",
        ),
    ],
    ids=["nothing", "too old", "PyPy", "no venv module", "two that do not do"],
)
def test_says_in_one_sentence_that_no_interpreter_will_do(
    checkout: Checkout, have: Prepared, said: str
) -> None:
    have(checkout)
    done = checkout.run()
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert said in done.stderr
    assert "needs Python 3.11 to" in done.stderr
    assert "install one" in done.stderr
    assert not (checkout.folder / ".venv").exists()
    assert checkout.calls == []


def test_an_environment_is_filled_once_for_each_place_and_each_pyproject(
    checkout: Checkout, tmp_path: Path
) -> None:
    checkout.stub("python3", "3.11.7")
    for _ in range(2):
        assert checkout.run().returncode == 0
    assert checkout.installations == 1
    moved = tmp_path / "moved"
    checkout.folder.rename(moved)
    checkout.folder = moved
    assert checkout.run().returncode == 0
    assert checkout.installations == 2
    with (moved / "pyproject.toml").open("a") as project:
        project.write("# changed\n")
    for _ in range(2):
        assert checkout.run().returncode == 0
    assert checkout.installations == 3


def test_tests_are_installed_with_the_locked_versions_and_serve_the_demo_too(checkout: Checkout) -> None:
    checkout.stub("python3", "3.11.7")
    assert checkout.run("test.sh").returncode == 0
    assert [call for call in checkout.calls if "pip install" in call] == [
        "3.11.7 -m pip install --quiet --disable-pip-version-check --editable .[dev]"
        " --constraint .ci/requirements.lock"
    ]
    assert checkout.run("demo.sh").returncode == 0
    assert checkout.installations == 1


@pytest.mark.parametrize(
    "broken", slow_but_for("does not start", ["interpreter gone", "does not start", "empty folder"])
)
def test_a_broken_environment_is_made_anew(checkout: Checkout, broken: str) -> None:
    checkout.stub("python3", "3.11.7")
    assert checkout.run().returncode == 0
    python = checkout.folder / ".venv/bin/python"
    python.unlink()
    if broken == "interpreter gone":
        python.symlink_to("/nowhere/python3.11")
    elif broken == "does not start":
        python.write_text("#!/bin/sh\nexit 127\n")
        python.chmod(0o755)
    done = checkout.run()
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(
        ".venv is broken: its interpreter does not start\nmaking .venv with Python 3.11.7\n"
    )
    assert checkout.installations == 2


def test_an_environment_of_a_version_that_is_not_promised_is_made_anew(checkout: Checkout) -> None:
    old = checkout.stub("python3", "3.10.13")
    venv_python = checkout.folder / ".venv/bin/python"
    venv_python.parent.mkdir(parents=True)
    shutil.copy(old, venv_python)
    checkout.stub("python3", "3.12.1")
    done = checkout.run()
    assert (done.returncode, done.stderr) == (0, "")
    assert re.match(r"\.venv is of Python 3\.10, and pancam_graph needs 3\.11 to 3\.\d+\n", done.stdout)
    assert all(call.startswith("3.12.1") for call in checkout.calls)


def test_a_failed_installation_is_said_and_tried_again(checkout: Checkout) -> None:
    checkout.stub("python3", "3.11.7", pip="echo 'ERROR: no network' >&2; exit 1")
    for attempt in (1, 2):
        done = checkout.run()
        assert done.returncode == 2
        assert done.stderr.splitlines() == [
            "ERROR: no network",
            "could not install pancam_graph into .venv: see pip's message above",
        ]
        assert checkout.installations == attempt


def test_every_version_that_is_found_has_its_row(checkout: Checkout) -> None:
    checkout.stub("python3.13", "3.13.1", pytest="echo 7 passed")
    checkout.stub("python3.12", "3.12.1", pytest="echo 1 failed, 6 passed; exit 1")
    checkout.stub("python3.11", "3.11.7", pytest="echo 5 passed")
    done = checkout.run("test_all_pythons.sh")
    assert done.returncode == 1
    assert done.stdout.rpartition("\n\n")[2].splitlines() == [
        "3.14          no interpreter found",
        "3.13          7 passed",
        "3.12          1 failed, 6 passed",
        "3.11          5 passed",
        "3.11-lowest   5 passed",
    ]
    lowest = (checkout.folder / ".venvs/3.11-lowest/lowest.txt").read_text().splitlines()
    assert "gtsam==4.3" in lowest
    assert all(re.fullmatch(r"[\w.-]+==[\d.]+", line) for line in lowest)
    options = [call.partition("--editable ")[2] for call in checkout.calls if "pip install" in call]
    assert options == [
        *[".[test,terrain,cluster] --upgrade --upgrade-strategy eager"] * 3,
        ".[test,terrain,cluster] --constraint .venvs/3.11-lowest/lowest.txt",
    ]


def test_a_version_that_cannot_be_installed_fails_and_the_next_is_tried(checkout: Checkout) -> None:
    checkout.stub("python3.13", "3.13.1", pip="exit 1")
    checkout.stub("python3.12", "3.12.1", pytest="echo 7 passed")
    done = checkout.run("test_all_pythons.sh", PYTHONS="3.13 3.12")
    assert done.returncode == 1
    assert done.stdout.endswith("\n\n3.13          could not be installed\n3.12          7 passed\n")
