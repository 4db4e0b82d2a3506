"""The subcommand check, and exit statuses that say what the verdict says."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from pancam_graph import SimulationOptions, simulate, write_traverse
from pancam_graph.cli import main
from pancam_graph.results import read_solution_json
from pancam_graph.rigs import mer_navcam

Captured = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("right")
    options = SimulationOptions(stops=1, pans=7, points_per_image=15)
    write_traverse(simulate(mer_navcam(), options, seed=2).traverse, folder / "in")
    assert main(["refine", str(folder / "in"), "--out", str(folder / "out"), "--no-report", "--quiet"]) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    options = SimulationOptions(stops=1, pans=7, points_per_image=15)
    traverse = simulate(mer_navcam(), options, seed=2).traverse
    observations = traverse.observations
    assert observations is not None
    # The pixels of frame 3 see nothing that the other frames see.
    uv_px, of_frame = observations.uv_px.copy(), traverse.image_frame[observations.image] == 3
    uv_px[of_frame] = uv_px[of_frame][:, ::-1]
    write_traverse(traverse.with_observations(replace(observations, uv_px=uv_px)), folder / "in")
    assert main(["refine", str(folder / "in"), "--out", str(folder / "out"), "--no-report", "--quiet"]) == 1
    return folder / "out"


def test_a_right_solution_passes(right: Path, capsys: Captured) -> None:
    assert main(["check", str(right)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("passed all ")
    assert "FAILED" not in printed
    assert main(["check", str(right / "solution.json")]) == 0


def test_a_wrong_solution_is_written_and_fails(wrong: Path, capsys: Captured) -> None:
    assert main(["check", str(wrong)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("FAILED ")
    assert any(line.startswith("FAILED  frame links") and "frame00003" in line for line in lines)


def test_json_is_that_of_the_file(wrong: Path, capsys: Captured) -> None:
    assert main(["check", str(wrong), "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((wrong / "solution.json").read_text())["verdict"]
    assert printed["passed"] is False
    assert {"name", "value", "limit", "passed", "says"} == set(printed["tests"][0])


def test_a_verdict_is_read_as_it_was(wrong: Path) -> None:
    entry = read_solution_json(wrong / "solution.json").verdict
    assert entry is not None
    assert type(entry).of(entry.verdict()) == entry


def test_refine_says_what_failed(wrong: Path, tmp_path: Path, capsys: Captured) -> None:
    words = ["refine", str(wrong.parent / "in"), "--out", str(tmp_path / "out"), "--no-report"]
    assert main(words) == 1
    printed = capsys.readouterr()
    assert "converged, but FAILED its tests" in printed.out
    assert "failed test: frame links: of frame frame00003" in printed.err


@pytest.mark.parametrize("content", [None, "", "{}", '{"format": "pancam-graph/solution", "version": 1}'])
def test_what_is_no_solution_is_one_sentence(content: str | None, tmp_path: Path, capsys: Captured) -> None:
    if content is not None:
        (tmp_path / "solution.json").write_text(content)
    assert main(["check", str(tmp_path)]) == 2
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1
    assert "solution.json" in said


def test_a_solution_from_before_verdicts_is_to_be_refined_again(
    right: Path, tmp_path: Path, capsys: Captured
) -> None:
    data = json.loads((right / "solution.json").read_text())
    del data["verdict"]
    (tmp_path / "solution.json").write_text(json.dumps(data))
    assert main(["check", str(tmp_path)]) == 2
    assert "refine it again" in capsys.readouterr().err
