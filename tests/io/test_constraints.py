"""Constraints and named points in files: both ways, and one sentence for each that is wrong."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph import Traverse, read_traverse, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.data import (
    CONSTRAINTS,
    FrameDirection,
    FramePoint,
    LandmarkAzimuth,
    LandmarkDistance,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPlane,
    LandmarkPosition,
    LandmarkSurface,
    NamedPoints,
    StopDistance,
    StopHeading,
    StopPlacement,
    StopPose,
    StopPosition,
    Surface,
)
from support.fuzzing import dumped, mutated_bytes, mutated_tree, outcome
from support.small_drives import simulated

S0, S1 = "stop0000", "stop0001"
POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3), np.array([4.0, 0.1, -0.2]))
GROUND = Surface(
    first_m=np.array([-3.0, 4.0]),
    step_m=np.array([0.5, -0.25]),
    height_m=np.where(np.eye(9, 7, dtype=bool), np.nan, np.arange(63.0).reshape(9, 7) / 7.0),
)
EVERY = (
    LandmarkPosition(landmark="rock7", position_m=(1.0, None, 3.0), sigma_m=(0.01, None, 0.0), robust=True),
    LandmarkPosition(landmark=0, position_m=(1.0, 2.0, 3.0), covariance_m2=np.diag([1e-4, 2e-4, 3e-4])),
    LandmarkHeight(landmark="rock7", height_m=0.2, sigma_m=0.01),
    LandmarkPlane(landmark="peak", normal=(0.0, 0.6, 0.8), offset_m=0.2, sigma_m=0.01),
    LandmarkAzimuth(landmark="peak", stop=S0, azimuth_rad=0.5, sigma_rad=1e-3),
    LandmarkElevation(landmark="peak", stop=S1, elevation_rad=0.05, sigma_rad=1e-3),
    LandmarkInfinity(landmark="peak"),
    StopPosition(stop=S1, position_m=(None, None, 0.4), sigma_m=(None, None, 0.02)),
    StopPose(between=(S0, S1), a_T_b=POSE, covariance=1e-4 * np.eye(6)),
    StopDistance(between=(S0, S1), distance_m=4.0, sigma_m=0.01),
    StopHeading(stop=S1, heading_rad=-0.3, sigma_rad=0.01),
    LandmarkSurface(landmark="rock7", surface=GROUND, sigma_m=0.1, robust=True),
    LandmarkDistance(between=("rock7", 0), distance_m=2.5, sigma_m=0.01),
    StopPlacement(stop=S1, world_T_mast=POSE, covariance=1e-4 * np.eye(6)),
    FrameDirection(
        frame="frame00000",
        camera="left",
        u_px=100.5,
        v_px=-0.5,
        sigma_px=0.3,
        azimuth_rad=-2.0,
        elevation_rad=0.6,
        sigma_rad=1e-4,
    ),
    FramePoint(
        frame="frame00001",
        camera="right",
        u_px=10.0,
        v_px=20.0,
        sigma_px=0.5,
        position_m=(3.0, 2.0, -1.0),
        sigma_m=0.01,
    ),
)


def named(traverse: Traverse) -> NamedPoints:
    return NamedPoints(
        name=("rock7", "peak", "rock7", "peak"),
        image=np.array([0, 0, 1, 1]),
        uv_px=np.array([[100.25, 200.5], [300.0, 10.0], [90.125, 201.0], [299.0, 1.0 / 3.0]]),
        sigma_px=np.array([0.3, 0.3, 0.4, 0.5]),
    )


def sample() -> Traverse:
    traverse = simulated(2, 2).traverse
    points = named(traverse)
    assert traverse.observations is not None
    marked = replace(traverse, observations=traverse.observations.with_points(points), points=points)
    return replace(marked, constraints=EVERY)


def test_every_kind_has_a_sample() -> None:
    assert {type(one) for one in EVERY} == set(CONSTRAINTS)


def test_every_kind_is_written_and_read_back(tmp_path: Path) -> None:
    traverse = sample()
    write_traverse(traverse, tmp_path / "a")
    again = read_traverse(tmp_path / "a")
    assert [type(one) for one in again.constraints] == [type(one) for one in EVERY]
    for one, other in zip(again.constraints, EVERY, strict=True):
        for name, value in vars(other).items():
            found = getattr(one, name)
            if isinstance(value, gtsam.Pose3):
                assert found.matrix() == pytest.approx(value.matrix(), abs=1e-15)
            elif isinstance(value, np.ndarray):
                assert np.array_equal(found, value)
            elif isinstance(value, Surface):
                for part in ("first_m", "step_m", "height_m"):
                    assert np.array_equal(getattr(found, part), getattr(value, part), equal_nan=True)
            else:
                assert found == value or list(found) == list(value), name
    assert traverse.observations is not None
    assert again.observations is not None
    assert np.array_equal(again.observations.uv_px, traverse.observations.uv_px)
    assert again.observations.point_track == traverse.observations.point_track
    write_traverse(again, tmp_path / "b")
    for file in ("points.csv", "observations.npz", "surface.tif"):
        assert (tmp_path / "b" / file).read_bytes() == (tmp_path / "a" / file).read_bytes()


def test_marks_of_a_point_are_observations_of_one_track() -> None:
    traverse = sample()
    observations = traverse.observations
    assert observations is not None
    track = traverse.track_of("rock7")
    rows = np.flatnonzero(observations.track == track)
    assert observations.image[rows].tolist() == [0, 1]
    assert observations.uv_px[rows].tolist() == [[100.25, 200.5], [90.125, 201.0]]
    before = observations.without_points()
    assert track is not None
    assert track > before.track.max()
    assert before.point_track == {}


Change = Callable[[dict[str, Any]], object]


def entry(number: int, **changes: Any) -> Change:
    return lambda content: content["constraints"][number].update(changes)


def appended(**constraint: Any) -> Change:
    return lambda content: content["constraints"].append(constraint)


EXACT = [{"kind": "landmark-height", "landmark": "peak", "height_m": h, "sigma_m": 0.0} for h in (1.0, 2.0)]
DISTANCES = [
    {"kind": "landmark-distance", "landmarks": pair, "distance_m": d, "sigma_m": 0.0}
    for pair, d in ((["rock7", "peak"], 1.0), (["peak", "rock7"], 2.0))
]
WRONG: dict[str, tuple[Change, str]] = {
    "unknown kind": (
        entry(9, kind="stop-distanc"),
        r"constraints\[9\].kind: expected one of .*'stop-distance' meant",
    ),
    "no kind": (lambda c: c["constraints"][0].pop("kind"), r"constraints\[0\].kind: expected this key"),
    "unknown name": (
        entry(2, landmark="rock8"),
        r"constraints\[2\] \(landmark-height\): landmark: expected one of rock7, peak; "
        r"found 'rock8'; is 'rock7' meant\?",
    ),
    "unknown track": (entry(2, landmark=123456), "123456, which no observation has"),
    "unknown stop": (entry(10, stop="stop001"), r"stop: expected one of .*'stop001'; is 'stop0001' meant"),
    "one stop twice": (entry(9, stops=[S1, S1]), "expected the ids of two different stops"),
    "three stops": (
        entry(9, stops=[S0, S1, S1]),
        r"stops: expected 2 numbers, found 3|expected the ids of two",
    ),
    "a stop that is held": (
        appended(kind="stop-heading", stop=S0, heading_rad=0.0, sigma_rad=0.0),
        "found stop0000 held by sigma 0",
    ),
    "no coordinate": (entry(0, position_m=[None, None, None]), "expected one coordinate at least"),
    "two coordinates": (entry(0, position_m=[1.0, 2.0]), r"position_m: expected 3 numbers, found 2"),
    "no sigma": (entry(0, sigma_m=None), "expected it, or covariance_m2; found neither"),
    "sigma of a known axis": (
        entry(0, sigma_m=[0.1, 0.1, None]),
        r"sigma_m\[2\]: expected 0 \(exact\) or a positive number",
    ),
    "negative sigma": (entry(2, sigma_m=-0.1), "sigma_m: expected 0"),
    "NaN": (entry(2, height_m=float("nan")), "expected a finite number"),
    "text": (entry(2, height_m="0.2"), "expected a number"),
    "unknown key": (entry(2, heigth_m=0.2), "unknown key"),
    "covariance of another shape": (
        entry(8, covariance=[[1.0] * 3] * 3),
        "covariance: expected 6 rows of 6 numbers",
    ),
    "covariance that is singular": (
        entry(8, covariance=[[1e-4] * 6] * 6),
        "expected a positive definite matrix",
    ),
    "ragged covariance": (
        entry(1, covariance_m2=[[1.0], [1.0, 2.0], [1.0]]),
        "covariance_m2: expected 3 rows",
    ),
    "elevation of the zenith": (entry(5, elevation_rad=1.6), "between -pi / 2 and pi / 2"),
    "long normal": (
        entry(3, normal=[0.0, 0.0, 2.0]),
        r"normal: expected three numbers of length 1, found .* of length 2",
    ),
    "huge": (entry(2, height_m=1e308), r"height_m: expected a number of at most 1e\+09, found 1e\+308"),
    "no normal": (
        entry(3, normal=[0.0, 0.0, 0.0]),
        r"normal: expected three numbers of length 1, found .* of length 0",
    ),
    "contradictory exact heights": (
        lambda c: c["constraints"].extend(EXACT),
        r"constraints\[17\] \(landmark-height\): expected what constraints\[16\] says, which is exact",
    ),
    "a surface that is not there": (entry(11, file="hills.tif"), "hills.tif: expected a GeoTIFF, found"),
    "a surface outside": (entry(11, file="../dem.tif"), "file: expected a path inside the traverse folder"),
    "a surface that is none": (entry(11, file="points.csv"), "points.csv: expected a GeoTIFF, found"),
    "negative sigma of a surface": (entry(11, sigma_m=-1.0), "sigma_m: expected 0"),
    "one point twice": (entry(12, landmarks=[0, 0]), "expected two different terrain points, found"),
    "distance of an unknown point": (
        entry(12, landmarks=["rock7", "rock8"]),
        "landmark: expected one of rock7, peak; found 'rock8'",
    ),
    "no distance": (entry(12, distance_m=0.0), "distance_m: expected a number above 0, found 0.0"),
    "contradictory exact distances": (
        lambda c: c["constraints"].extend(DISTANCES),
        r"constraints\[17\] \(landmark-distance\): expected what constraints\[16\] says, which is exact",
    ),
    "a place told in two ways": (
        entry(13, position_m=[0.0, 0.0, 0.0]),
        "expected position_m with sigma_m or covariance_m2, or world_T_mast with covariance; found pos",
    ),
    "a pose without covariance": (entry(13, covariance=None), "found world_T_mast"),
    "direction of an unknown frame": (
        entry(14, frame="frame0000"),
        r"constraints\[14\] \(frame-direction\): frame: expected one of .*found 'frame0000'",
    ),
    "direction seen by an unknown camera": (
        entry(14, camera="lefy"),
        "camera: expected one of left, right; found 'lefy'; is 'left' meant",
    ),
    "direction beside the picture": (
        entry(14, u_px=1023.6),
        r"expected pixels in a picture of 1024 x 1024, found \(1023.6, -0.5\)",
    ),
    "direction without a sigma of pixels": (
        entry(14, sigma_px=0.0),
        "sigma_px: expected a number above 0, found 0.0",
    ),
    "direction with a negative sigma": (entry(14, sigma_rad=-1e-3), "sigma_rad: expected 0"),
    "direction beyond the zenith": (entry(14, elevation_rad=1.58), "a number from -pi / 2 to pi / 2"),
    "direction without an azimuth": (
        lambda c: c["constraints"][14].pop("azimuth_rad"),
        "azimuth_rad: expected",
    ),
    "point of a frame without a height": (
        entry(15, position_m=[1.0, 2.0, None]),
        r"constraints\[15\].*position_m",
    ),
    "point of a frame with a negative sigma": (entry(15, sigma_m=-1.0), "sigma_m: expected 0"),
    "point beside its picture": (entry(15, v_px=-1.0), "expected pixels in a picture of 1024 x 1024"),
    "points that are not there": (
        lambda c: c.update(points="marks.csv"),
        "marks.csv: expected a file, found",
    ),
    "points outside": (lambda c: c.update(points="../points.csv"), "points: expected a path inside"),
}


@pytest.mark.parametrize("name", WRONG)
def test_one_sentence_says_what_is_wrong(name: str, tmp_path: Path) -> None:
    write_traverse(sample(), tmp_path)
    change, sentence = WRONG[name]
    content = json.loads((tmp_path / "traverse.json").read_text())
    change(content)
    (tmp_path / "traverse.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=sentence) as raised:
        read_traverse(tmp_path)
    assert "\n" not in str(raised.value)


CELLS = {
    "image": ("rock7,nowhere,1,2,0.3", r"line 2: image: expected one of .*found 'nowhere'"),
    "name": (",frame00000-left,1,2,0.3", "line 2: name: expected a name"),
    "number": ("rock7,frame00000-left,1,x,0.3", "line 2: v_px: expected a number, found"),
    "sigma": ("rock7,frame00000-left,1,2,0", "sigma_px: expected a finite number above 0, found 0.0"),
    "NaN": ("rock7,frame00000-left,nan,2,1", "expected finite pixels"),
    "twice": (
        "rock7,frame00000-left,1,2,1\nrock7,frame00000-left,3,2,1",
        "expected an image once, found it twice",
    ),
    "cells": ("rock7,frame00000-left,1,2", "expected 5 cells, found 4"),
}


@pytest.mark.parametrize("name", CELLS)
def test_a_wrong_cell_of_points_is_named(name: str, tmp_path: Path) -> None:
    write_traverse(sample(), tmp_path)
    row, sentence = CELLS[name]
    (tmp_path / "points.csv").write_text(f"name,image,u_px,v_px,sigma_px\n{row}\n")
    with pytest.raises(InputError, match=sentence) as raised:
        read_traverse(tmp_path)
    assert "points.csv" in str(raised.value)


def damaged(folder: Path, seeds: range) -> set[str]:
    """What reading says of a folder whose constraints, or table of points, are damaged."""
    write_traverse(sample(), folder)
    content, table = json.loads((folder / "traverse.json").read_text()), (folder / "points.csv").read_text()
    said = set()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        changed = {**content, "constraints": mutated_tree(rng, content["constraints"])}
        (folder / "traverse.json").write_bytes(dumped(changed if seed % 3 else content))
        (folder / "points.csv").write_bytes(
            mutated_bytes(rng, table.encode()) if seed % 3 == 0 else table.encode()
        )
        said.add(outcome(lambda: read_traverse(folder), folder))
    return said


def test_damaged_constraints_end_in_a_result_or_one_sentence(tmp_path: Path) -> None:
    assert len(damaged(tmp_path, range(15))) > 5


@pytest.mark.slow
def test_hundreds_of_damaged_constraints_end_in_a_result_or_one_sentence(tmp_path: Path) -> None:
    assert len(damaged(tmp_path, range(100, 700))) > 50


def test_a_mark_beside_its_picture_is_refused_by_name(tmp_path: Path) -> None:
    write_traverse(sample(), tmp_path)
    (tmp_path / "points.csv").write_text("name,image,u_px,v_px,sigma_px\nrock7,frame00000-left,-5000,3,0.1\n")
    sentence = r"points: rock7: image frame00000-left: expected pixels in a picture of .* found \(-5000, 3\)"
    with pytest.raises(InputError, match=sentence):
        read_traverse(tmp_path)
