"""Control networks, tables, and drives made of files of other programs: what they say in numbers."""

import csv
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.data import (
    LandmarkPosition,
    Site,
)
from pancam_graph.io import read_input, with_network, write_traverse
from pancam_graph.io.vicar import picture_identities, read_nav, read_ties, with_pointing, with_ties
from pancam_graph.results import convert
from support.door_solutions import bare, marks, solved, written
from support.fuzzing import mutated_bytes, mutated_text, outcome


@pytest.mark.parametrize("placed", [False, True])
def test_a_control_network_comes_back(tmp_path: Path, placed: bool) -> None:
    solution = solved()
    site = Site(body="Mars", latitude_deg=-4.6, longitude_deg=137.4, height_m=-4500.0, north_rad=0.3)
    solution = replace(solution, traverse=replace(solution.traverse, site=site if placed else None))
    (warning,) = written(solution, tmp_path / "net.csv", "control-network")
    assert warning.startswith("control-network: 5 constraints")
    back = with_network(bare(solution), tmp_path / "net.csv")
    given = solution.traverse.observations
    assert given is not None
    assert back.observations is not None
    (known,) = back.constraints
    assert isinstance(known, LandmarkPosition)
    truth = solution.traverse.constraints[0]
    assert isinstance(truth, LandmarkPosition)
    assert np.allclose(known.target_m, truth.target_m, atol=1e-8)
    assert np.allclose(known.covariance, 1e-4 * np.eye(3), atol=1e-12)
    ours = np.array(sorted(marks(back.observations)))
    theirs = np.array(sorted(marks(given, solution.used)))
    assert np.allclose(ours, theirs, atol=1e-9)


def test_a_network_counts_pixels_from_one(tmp_path: Path) -> None:
    t = solved().traverse
    rows = "".join(f"p,{t.images[i].id},{3 + i},7,false\nq,{t.images[i].id},1,1,true\n" for i in range(2))
    (tmp_path / "n.csv").write_text(f"id,serialnumber,sample,line,pointIgnore\n{rows}")
    back = with_network(bare(solved()), tmp_path / "n.csv")
    assert back.observations is not None
    assert back.observations.uv_px.tolist() == [[2, 6], [3, 6]]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("id,sample,line\n", "serialnumber: expected one such column"),
        ("id,serialnumber,sample,line\np,{a},x,1\n", 'line 2: sample: expected a number, found "x"'),
        ("id,serialnumber,sample,line\n,{a},1,1\n", "line 2: id: expected a name, found an empty cell"),
        (
            "id,serialnumber,sample,line\np,{a},1,1\n",
            "expected points that two images or more see, found none",
        ),
        ("id,serialnumber,sample,line\np,elsewhere,1,1\n", "expected pictures of .*, found elsewhere"),
        (
            "id,serialnumber,sample,line,pointType,aprioriX,aprioriY,aprioriZ,aprioriCovar\np,{a},1,1,3,1,2,3,[1]\n",
            "line 2: aprioriCovar: expected a list of six numbers",
        ),
    ],
)
def test_networks_that_are_wrong_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "n.csv"
    path.write_text(text.replace("{a}", solved().traverse.images[0].id))
    with pytest.raises(InputError, match=says) as error:
        with_network(bare(solved()), path)
    assert str(path) in str(error.value)


# --- the command ---


def test_files_become_a_drive(tmp_path: Path) -> None:
    solution = solved()
    write_traverse(solution.traverse, tmp_path / "drive")
    written(solution, tmp_path / "a.tpt", "tpt")
    written(solution, tmp_path / "a.nav", "nav")
    convert(tmp_path / "a.nav", tmp_path / "pointed", images=tmp_path / "drive")
    done = convert(tmp_path / "a.tpt", tmp_path / "tied", images=tmp_path / "pointed")
    assert (done.to, done.passed) == ("traverse", True)
    back = read_input(tmp_path / "tied")
    assert len(back.constraints) == 6
    assert np.allclose(np.sin(back.pan_tilt_rad), np.sin(solution.final.pan_tilt_rad), atol=1e-12)
    with pytest.raises(
        InputError, match=r"a\.tpt: expected the folder of its pictures \(--images\), found none told"
    ):
        convert(tmp_path / "a.tpt", tmp_path / "other")
    convert(tmp_path / "tied", tmp_path / "again.tpt")
    assert {t.type for t in read_ties(tmp_path / "again.tpt").ties} == {0, 1, 3, 4, 6, 7, 8}


def test_tables_hold_what_the_solution_does(tmp_path: Path) -> None:
    solution = solved()
    written(solution, tmp_path / "tables", "tables")
    text = (tmp_path / "tables" / "frames.csv").read_text().splitlines()
    numbers = np.array([[float(c) for c in line.split(",")[2:6]] for line in text[1:]])
    assert np.array_equal(numbers[:, :2], solution.final.pan_tilt_rad)
    assert np.array_equal(numbers[:, 2:], solution.angle_sigma_rad)
    stops = [line.split(",") for line in (tmp_path / "tables" / "stops.csv").read_text().splitlines()]
    sigmas = np.array([[float(c) for c in line[8:14]] for line in stops[1:]])
    assert np.allclose(sigmas**2, [np.diag(c) for c in solution.stop_covariance], rtol=1e-12, atol=0)
    assert sorted(p.name for p in (tmp_path / "tables").iterdir()) == sorted(
        ["export.json", *(f"{n}.csv" for n in ("stops", "frames", "images", "points", "observations", "rig"))]
    )


def test_parquet_has_the_tables_with_nulls_for_empty_cells(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is an extra (parquet)")
    solution = solved()
    written(solution, tmp_path / "csv", "tables")
    written(solution, tmp_path / "parquet", "parquet")
    for file in (tmp_path / "csv").glob("*.csv"):
        with file.open(newline="") as stream:
            header, *lines = csv.reader(stream)
        table = parquet.read_table(tmp_path / "parquet" / f"{file.stem}.parquet")
        assert table.column_names == header
        assert table.num_rows == len(lines)
        for i, name in enumerate(header):
            cells = [
                "" if v is None else v if isinstance(v, str) else repr(v) for v in table[name].to_pylist()
            ]
            assert cells == [line[i] for line in lines], (file.stem, name)


def test_parquet_without_its_package_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(
        InputError, match=r"parquet: expected the Python package pyarrow, found none: pip inst"
    ):
        written(solved(), tmp_path / "parquet", "parquet")


# --- hostile files ---


@pytest.mark.parametrize(
    ("to", "name"),
    [
        ("tpt", "a.tpt"),
        ("tpt-text", "b.tpt"),
        ("nav", "a.nav"),
        ("nav-text", "b.nav"),
        ("control-network", "n.csv"),
    ],
)
def test_mutated_files_are_read_or_refused_in_a_sentence(tmp_path: Path, to: str, name: str) -> None:
    solution, path = solved(), tmp_path / name
    written(solution, path, to)
    lines = path.read_text().splitlines(keepends=True)
    text = "".join(lines[:60] + lines[-3:] if name.endswith("a.tpt") or name == "a.nav" else lines[:20])
    traverse = bare(solution)
    take: dict[str, Callable[[], object]] = {
        ".tpt": lambda: with_ties(traverse, read_ties(path), path),
        ".nav": lambda: with_pointing(traverse, read_nav(path), path),
        ".csv": lambda: with_network(traverse, path),
    }
    rng, said = np.random.default_rng(5), set()
    for case in range(24):
        if case % 2:
            path.write_bytes(mutated_bytes(rng, text.encode()))
        else:
            path.write_text(mutated_text(rng, text), encoding="utf-8", errors="replace")
        said.add(outcome(take[path.suffix], path))
    assert len(said) > 3


def test_labels_say_who_an_image_is(opportunity_folder: Path) -> None:
    who = picture_identities(read_input(opportunity_folder))
    assert [w.unique_id for w in who[:2]] == ["MER1NL_491020376", "MER1NL_491020519"]
    assert {w.place for w in who} == {(195, 973)}
    assert who[0].pointing_type == "MERpmaCamera"
