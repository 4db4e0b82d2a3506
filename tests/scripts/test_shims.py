"""Scripts that stand for subcommands, where the package is not installed."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.mark.skipif(not SCRIPTS.is_dir(), reason="no scripts: they are part of the repository")
@pytest.mark.parametrize("name", ["drive", "optimize_traverse", "render_traverse", "simulate_traverse"])
def test_outside_the_environment_a_sentence_says_what_to_run(name: str) -> None:
    # -S and -E: an interpreter that has no packages.
    command = [sys.executable, "-S", "-E", str(SCRIPTS / f"{name}.py"), "--help"]
    run = subprocess.run(command, check=False, capture_output=True, text=True)
    assert run.returncode == 2
    assert run.stderr.startswith(
        f"pancam_graph is not installed for {sys.executable}: run `. .venv/bin/activate`"
    )
    assert run.stderr.count("\n") == 1
