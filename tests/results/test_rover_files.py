"""Rover poses of VICAR's .rvf as where stops are told to be: what is written is read, errors are said."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from pancam_graph import Traverse, read_traverse, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.io.vicar import with_rovers
from pancam_graph.results import convert
from support.door_solutions import solved, written

MOUNT = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.01, 0.1), np.array([0.6, 0.3, -1.2]))
WRONG = {
    "a drive that is not there": (
        'index1="0" index2="7"',
        r"expected rover poses in site 0 .*0/0.*, found 0/7",
    ),
    "another site": (None, "expected rover poses in site 0 .*, found none"),
    "no number": ('index1="0" index2="x"', "solution: expected a whole number index2, found 'x'"),
}


def told() -> Traverse:
    """A drive whose telemetry is of another place than its solution."""
    traverse = solved(rover=True).traverse
    away = gtsam.Pose3(gtsam.Rot3.Rz(0.3), np.array([1.0, 2.0, 3.0]))
    return replace(
        traverse, stops=tuple(replace(s, world_T_mast=away * s.world_T_mast) for s in traverse.stops)
    )


def test_what_is_written_places_the_stops_and_sigmas_stay(tmp_path: Path) -> None:
    solution = solved(rover=True)
    written(solution, tmp_path / "a.rvf", "rvf")
    placed = with_rovers(told(), tmp_path / "a.rvf")
    assert placed.warnings == told().warnings
    for stop, pose, before in zip(placed.stops, solution.final.world_T_mast, told().stops, strict=True):
        assert stop.world_T_mast.matrix() == pytest.approx(pose.matrix(), abs=1e-12)
        assert stop.sigmas.tolist() == before.sigmas.tolist()


def test_a_rover_in_another_site_is_placed_by_the_sites_of_the_file(tmp_path: Path) -> None:
    """By hand: site 1 is 10 m north and 5 m east of site 0, z down; the rover is 1 m north in it."""
    still = '<orientation s="1" v1="0" v2="0" v3="0"/></solution>'
    (tmp_path / "a.rvf").write_text(
        '<rmc_file><priority><entry solution_id="old"/><entry solution_id="new"/></priority>'
        '<solution solution_id="new" name="ROVER_FRAME" index1="0" index2="0">'
        f'<reference_frame name="SITE_FRAME" index1="1"/><offset x="1" y="0" z="-2"/>{still}'
        '<solution solution_id="old" name="ROVER_FRAME" index1="0" index2="0">'
        f'<reference_frame name="SITE_FRAME" index1="0"/><offset x="9" y="9" z="9"/>{still}'
        '<solution solution_id="new" name="SITE_FRAME" index1="1">'
        f'<reference_frame name="SITE_FRAME" index1="0"/><offset x="10" y="5" z="0"/>{still}</rmc_file>'
    )
    placed = with_rovers(told(), tmp_path / "a.rvf")
    mounted = placed.rig.rover_T_mast
    assert mounted is not None
    rover = placed.stops[0].world_T_mast * mounted.inverse()
    assert rover.matrix() == pytest.approx(
        gtsam.Pose3(gtsam.Rot3(), np.array([11.0, -5.0, 2.0])).matrix(), abs=1e-12
    )
    assert placed.stops[1].world_T_mast.equals(told().stops[1].world_T_mast, 0.0)
    assert placed.warnings[-1] == "a.rvf: 1 of 2 stops are not in it and stay"


@pytest.mark.parametrize("name", WRONG)
def test_one_sentence_says_what_is_wrong(name: str, tmp_path: Path) -> None:
    place, sentence = WRONG[name]
    here = '<reference_frame name="SITE_FRAME" index1="0"/>'
    if place is None:
        place, here = 'index1="0" index2="0"', here.replace('"0"', '"4"')
    (tmp_path / "a.rvf").write_text(
        f'<rmc_file><solution name="ROVER_FRAME" {place}>{here}<offset x="1" y="0" z="0"/>'
        '<orientation s="1" v1="0" v2="0" v3="0"/></solution></rmc_file>'
    )
    with pytest.raises(InputError, match=sentence) as raised:
        with_rovers(told(), tmp_path / "a.rvf")
    assert "\n" not in str(raised.value)


def test_a_rig_without_a_rover_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.rvf").write_text("<rmc_file/>")
    with pytest.raises(InputError, match="expected a rig whose place on the rover is known"):
        with_rovers(solved().traverse, tmp_path / "a.rvf")


def test_convert_takes_it_into_a_drive(tmp_path: Path) -> None:
    traverse, solution = told(), solved(rover=True)
    write_traverse(
        replace(traverse, images=tuple(replace(i, file=None) for i in traverse.images)), tmp_path / "in"
    )
    written(solution, tmp_path / "a.rvf", "rvf")
    convert(tmp_path / "a.rvf", tmp_path / "out", images=tmp_path / "in")
    again = read_traverse(tmp_path / "out")
    for stop, pose in zip(again.stops, solution.final.world_T_mast, strict=True):
        assert stop.world_T_mast.matrix() == pytest.approx(pose.matrix(), abs=1e-12)
