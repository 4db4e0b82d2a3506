"""Completion scripts: what a shell completes."""

import shutil
import subprocess
from pathlib import Path

import pytest

from pancam_graph.cli import main

Captured = pytest.CaptureFixture[str]


def completed(script: Path, *words: str) -> set[str]:
    """What bash would complete the last word to."""
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash")
    asked = f"""
set -u
source {script}
COMP_WORDS=({" ".join(repr(w) for w in words)})
COMP_CWORD={len(words) - 1}
COMP_LINE="{" ".join(words)}"
COMP_POINT=${{#COMP_LINE}}
COMP_TYPE=9
complete -p pancam-graph >&2
"$(complete -p pancam-graph | sed 's/.*-F \\([^ ]*\\).*/\\1/')" pancam-graph {words[-1]!r} {words[-2]!r}
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run([bash, "-c", asked], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "complete" in done.stderr
    return set(done.stdout.split())


@pytest.fixture
def script(tmp_path: Path, capsys: Captured) -> Path:
    assert main(["completion", "bash"]) == 0
    path = tmp_path / "completion.bash"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    return path


def test_bash_completes_subcommands_options_and_choices(script: Path) -> None:
    assert completed(script, "pancam-graph", "ref") == {"refine"}
    assert {"refine", "simulate", "render", "drive", "completion"} <= completed(script, "pancam-graph", "")
    assert completed(script, "pancam-graph", "refine", "--mod") == {"--model"}
    assert completed(script, "pancam-graph", "refine", "--model", "ci") == {"circle"}
    assert completed(script, "pancam-graph", "refine", "--export", "c") == {"colmap", "cahvor"}
    assert completed(script, "pancam-graph", "drive", "--rig", "mer-n") == {"mer-navcam"}


def test_every_shell_has_a_script(capsys: Captured) -> None:
    for shell, word in (("zsh", "#compdef pancam-graph"), ("fish", "complete -c pancam-graph")):
        assert main(["completion", shell]) == 0
        out = capsys.readouterr().out
        assert word in out
        assert "simulate" in out
        assert "cross-validate" in out
    assert main(["completion", "cmd"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
