"""Folders with parts of one drive, read together: what is common, what is told apart, what is refused."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pancam_graph import Observations, SolveOptions, Traverse, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.data import NamedPoints, StopHeading
from pancam_graph.io import mask_file, picture_file, read_input, write_traverse
from pancam_graph.results import write_results
from pancam_graph.results._solved_folder import read_solved
from pancam_graph.rigs import rig_template
from pancam_graph.simulate import SimulationOptions
from support.rover_labels import POINTINGS, Shot, label_text, msl_mast, navcam_b_head, write
from support.small_drives import some_stops

DRIVE = SimulationOptions(
    stops=3, pans=3, sweep_rad=None, tilts_rad=(-0.3,), points_per_image=6, odometry=True
)


@pytest.fixture(scope="module")
def drive() -> Traverse:
    return simulate(rig_template("mer-navcam"), DRIVE, seed=31).traverse


def written(drive: Traverse, folder: Path) -> list[Path]:
    """The drive in two folders: two stops, then one."""
    folders = [folder / "sol12", folder / "sol13"]
    write_traverse(some_stops(drive, slice(0, 2)), folders[0])
    write_traverse(some_stops(drive, slice(2, 3)), folders[1])
    return folders


def change(folder: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    path = folder / "traverse.json"
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def write_picture(path: Path) -> None:
    cv2.imwrite(str(path), np.full((1024, 1024), 255, dtype=np.uint8))


def rows(observations: Observations | None) -> list[tuple[float, ...]]:
    assert observations is not None
    return sorted(
        zip(observations.image, observations.track, *observations.uv_px.T, observations.sigma_px, strict=True)
    )


def test_parts_of_a_drive_are_the_drive(drive: Traverse, tmp_path: Path) -> None:
    joined = read_input(*written(drive, tmp_path))
    assert joined.frames == drive.frames
    assert [image.id for image in joined.images] == [image.id for image in drive.images]
    assert rows(joined.observations) == rows(drive.observations)
    assert (joined.folder, joined.parts) == (tmp_path, ("sol12", "sol13"))
    options = SolveOptions(loss="none")
    assert solve(joined, options).cost_final == pytest.approx(solve(drive, options).cost_final, rel=1e-9)


def test_a_folder_may_lie_in_the_other(drive: Traverse, tmp_path: Path) -> None:
    first, second = written(drive, tmp_path)
    inner = first / "more"
    second.rename(inner)
    joined = read_input(first, inner)
    assert (joined.folder, joined.parts) == (first, (".", "more"))
    assert len(joined.stops) == 3


def test_results_know_all_folders(drive: Traverse, tmp_path: Path) -> None:
    folders, out = written(drive, tmp_path / "drive"), tmp_path / "out"
    solution = solve(read_input(*folders), SolveOptions(loss="none"))
    write_results(solution, out, report=False)
    content = json.loads((out / "solution.json").read_text())
    assert (content["folder"], content["parts"]) == ("../drive", ["sol12", "sol13"])
    _, again = read_solved(out, None)
    assert rows(again.observations) == rows(solution.traverse.observations)
    (tmp_path / "drive").rename(tmp_path / "moved")
    with pytest.raises(InputError, match="expected the folder that was refined"):
        read_solved(out, None)
    assert read_solved(out, tmp_path / "moved")[1].parts == ("sol12", "sol13")


def test_files_and_masks_are_those_of_their_folder(drive: Traverse, tmp_path: Path) -> None:
    folders = written(drive, tmp_path)
    eye = drive.rig.eyes[0].name
    for folder in folders:
        (folder / "masks").mkdir()
        write_picture(folder / "masks" / f"{eye}.png")

        def name_files(content: dict[str, Any]) -> None:
            for image in content["images"]:
                image["file"] = f"pictures/{image['id']}.png"

        change(folder, name_files)
    joined = read_input(*folders)
    for row, image in enumerate(joined.images):
        home = folders[0] if joined.image_stop[row] < 2 else folders[1]
        assert picture_file(joined, row) == home / "pictures" / f"{image.id}.png"
        mask = home / "masks" / f"{eye}.png" if image.camera == eye else None
        assert mask_file(joined, row) == mask


def test_named_points_and_ties_are_common(drive: Traverse, tmp_path: Path) -> None:
    folders = written(drive, tmp_path)
    marks = [
        NamedPoints(name=("rock", "peak"), image=[0, 1], uv_px=[[10, 20], [30, 40]], sigma_px=[1, 1]),  # type: ignore[arg-type]  # turned to arrays
        NamedPoints(name=("rock",), image=[2], uv_px=[[50, 60]], sigma_px=[2]),  # type: ignore[arg-type]  # turned to arrays
    ]
    for folder, points in zip(folders, marks, strict=True):
        one = read_input(folder)
        assert one.observations is not None
        ties = (StopHeading(stop=one.stops[-1].id, heading_rad=0.1, sigma_rad=0.01),)
        observations = one.observations.with_points(points)
        write_traverse(
            replace(one, points=points, observations=observations, constraints=ties), folder, overwrite=True
        )
    joined = read_input(*folders)
    n = len(read_input(folders[0]).images)
    assert joined.points is not None and joined.observations is not None
    assert joined.points.image.tolist() == [0, 1, n + 2]
    of_rock = joined.observations.track == joined.observations.point_track["rock"]
    assert sorted(joined.observations.image[of_rock].tolist()) == [0, n + 2]
    assert len(joined.constraints) == 2


def test_a_tie_that_both_folders_have_counts_once(drive: Traverse, tmp_path: Path) -> None:
    folders = written(drive, tmp_path)
    second = json.loads((folders[0] / "traverse.json").read_text())["stops"][1]
    tie = {"kind": "stop-heading", "stop": second["id"], "heading_rad": 0.1, "sigma_rad": 0.02}
    change(folders[1], lambda content: content["stops"].append(second))
    for folder in folders:
        change(folder, lambda c: c.update(constraints=[tie, tie | {"heading_rad": 0.2}]))
    change(folders[1], lambda c: c["constraints"].append(tie | {"sigma_rad": 0.01}))
    said = [
        (t.heading_rad, t.sigma_rad) for t in read_input(*folders).constraints if isinstance(t, StopHeading)
    ]
    assert said == [(0.1, 0.02), (0.2, 0.02), (0.1, 0.01)]


def test_a_stop_in_two_folders_is_one_and_said(drive: Traverse, tmp_path: Path) -> None:
    folders = written(drive, tmp_path)
    first = json.loads((folders[0] / "traverse.json").read_text())["stops"][0]
    change(folders[1], lambda content: content["stops"].append(first))
    joined = read_input(*folders)
    assert [stop.id for stop in joined.stops] == [stop.id for stop in drive.stops]
    (said,) = joined.warnings
    assert f"stop {first['id']}" in said and "sol12" in said and "sol13" in said


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (
            lambda c: c["rig"]["cameras"][1].update(fx_px=1300.0),
            r"sol13/traverse\.json: rig\.cameras\[1\]\.fx_px: expected 1222\.5 as in .*sol12.*found 1300",
        ),
        (
            lambda c: c["rig"]["cameras"].append(c["rig"]["cameras"][0] | {"name": "third"}),
            r"rig\.cameras: .*a list of 3",
        ),
        (
            lambda c: c.update(sharing={"calibration": {"scope": "all", "free": ["focal"]}}),
            r"sol13/traverse\.json: sharing: expected null",
        ),
        (
            lambda c: c.update(
                site={"body": "Mars", "latitude_deg": 1, "longitude_deg": 2, "height_m": 3, "north_rad": 0}
            ),
            r"sol13/traverse\.json: site: expected null",
        ),
        (lambda c: c.update(observations=None), r"observations: expected a file as in .*sol12, found null"),
        (
            lambda c: c["stops"].append(c["stops"][0] | {"id": "stop0000"}),
            r"sol13/traverse\.json: stops \(stop0000\)\.world_T_mast\.rotation_wxyz\[0\]: expected ",
        ),
        (
            lambda c: c["images"][0].update(id="stop0000-000-left"),
            r"sol13/traverse\.json: images: stop0000-000-left: expected another id than one of .*sol12",
        ),
    ],
)
def test_parts_that_differ_are_refused(
    drive: Traverse, tmp_path: Path, edit: Callable[[dict[str, Any]], None], says: str
) -> None:
    folders = written(drive, tmp_path)
    names = [image.id for image in drive.images]
    assert drive.stops[0].id == "stop0000"
    if "found null" in says:
        write_picture(folders[1] / "picture.png")

    def edited(content: dict[str, Any]) -> None:
        for image in content["images"]:
            image["file"] = "picture.png"  # so that a file without observations is one of a drive
        edit(content)

    change(folders[1], edited)
    if "stop0000-000-left" in says:
        change(folders[1], lambda content: content["images"][0].update(id=names[0]))
        says = says.replace("stop0000-000-left", names[0])
    with pytest.raises(InputError, match=says):
        read_input(*folders)


def test_a_folder_twice_and_another_format_are_refused(drive: Traverse, tmp_path: Path) -> None:
    folders = written(drive, tmp_path)
    with pytest.raises(InputError, match=r"sol12: expected each folder once, found it twice"):
        read_input(folders[0], folders[1], folders[0])
    labels = tmp_path / "labels"
    labels.mkdir()
    (labels / "A.LBL").write_text("PDS_VERSION_ID = PDS3\r\nEND\r\n")
    with pytest.raises(
        InputError, match=r"labels: expected a folder with traverse\.json as .*sol12, found one with rover"
    ):
        read_input(folders[0], labels)
    with pytest.raises(InputError, match=r"nowhere: expected a folder"):
        read_input(folders[0], tmp_path / "nowhere")


def test_rover_images_of_several_folders_are_read_as_of_one(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", [tmp_path / "sol1", tmp_path / "sol2"]
    for folder in (whole, *parts):
        folder.mkdir()
    for k in range(4):
        shot = Shot(head=navcam_b_head(), joints=POINTINGS[k % 2], counter=(4, 2100 + 10 * (k // 2), k))
        for folder in (whole, parts[k // 2]):
            write(folder, f"NRB_{k}", label_text(shot, msl_mast()))
    expected, joined = read_input(whole), read_input(*parts)
    assert [(i.id, i.frame, i.camera) for i in joined.images] == [
        (i.id, i.frame, i.camera) for i in expected.images
    ]
    assert joined.frames == expected.frames
    assert [stop.id for stop in joined.stops] == [stop.id for stop in expected.stops]
    assert [image.file for image in joined.images] == [
        f"sol{1 + k // 2}/{image.file}" for k, image in enumerate(expected.images)
    ]
    assert all(
        picture is not None and picture.is_file()
        for picture in (picture_file(joined, row) for row in range(4))
    )
