"""Files of VICAR and control networks: what they say in numbers, out and in.

Truths are computed here from poses and points; XML is read with the standard library. Real files of marsnav
were not at hand.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import gtsam
import numpy as np
import pytest

from pancam_graph import Solution, SolveOptions, Traverse, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, rotation_from_wxyz
from pancam_graph.cameras import CAHV, CAHVORE, cahv_of_vectors
from pancam_graph.data import (
    Constraint,
    LandmarkAzimuth,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPlane,
    LandmarkPosition,
    Observations,
    Site,
)
from pancam_graph.io import read_input, with_network, write_traverse
from pancam_graph.io.vicar import picture_identities, read_nav, read_ties, with_pointing, with_ties
from pancam_graph.results import DOORS, convert
from pancam_graph.results._read_source import traverse_source
from pancam_graph.results.formats import source_of
from pancam_graph.rigs import rig_template
from support.fuzzing import mutated_bytes, mutated_text, outcome
from support.made_solutions import fabricate
from support.small_drives import simulated
from support.tied_drives import landmark_ties, noise_free

ROVER_T_MAST = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, -0.02, 0.4), np.array([0.46, 0.03, 1.1]))
SAID = {"landmark-position", "landmark-height", "landmark-azimuth", "landmark-elevation"}
NAMES = ("position", "map", "height", "far", "azimuth", "elevation")


@cache
def solved(template: str = "msl-navcam", *, rover: bool = False) -> Solution:
    """A solution with points on which something is known, each kind on a point of its own."""
    rig = rig_template(template)
    made = fabricate(
        rig=replace(rig, rover_T_mast=ROVER_T_MAST if rover else None), stops=2, pans=3, points=240
    )
    observations = made.traverse.observations
    assert observations is not None
    use = made.used & (np.bincount(observations.track[made.used])[observations.track] > 1)
    made = replace(made, used=use, reason=tuple("" if u else "outlier" for u in use))
    # Points that both eyes at the first stop see.
    at_first = use & (made.traverse.image_stop[observations.image] == 0)
    count = np.bincount(observations.track[at_first])
    tracks = np.flatnonzero(count >= 2)[: len(NAMES)].tolist()
    point = {t: made.final.landmarks_m[made.landmark_track.tolist().index(t)] for t in tracks}
    mast = made.final.world_T_mast[0].translation()
    said = dict(zip(NAMES, tracks, strict=True))

    def arm(name: str) -> FloatArray:
        return np.asarray(point[said[name]] - mast)

    x, y, _ = point[said["map"]].tolist()
    constraints: tuple[Constraint, ...] = (
        LandmarkPosition(
            landmark=said["position"], position_m=tuple(point[said["position"]].tolist()), sigma_m=(0.01,) * 3
        ),
        LandmarkPosition(landmark=said["map"], position_m=(x, y, None), sigma_m=(0.5, 0.5, None)),
        LandmarkHeight(landmark=said["height"], height_m=float(point[said["height"]][2]), sigma_m=0.05),
        LandmarkInfinity(landmark=said["far"]),
        LandmarkAzimuth(
            landmark=said["azimuth"],
            stop=made.traverse.stops[0].id,
            azimuth_rad=float(np.arctan2(arm("azimuth")[1], arm("azimuth")[0])),
            sigma_rad=2e-3,
        ),
        LandmarkElevation(
            landmark=said["elevation"],
            stop=made.traverse.stops[0].id,
            elevation_rad=float(np.arcsin(arm("elevation")[2] / np.linalg.norm(arm("elevation")))),
            sigma_rad=2e-3,
        ),
    )
    return replace(made, traverse=replace(made.traverse, constraints=constraints))


def written(solution: Solution, path: Path, to: str) -> list[str]:
    source = source_of(solution)
    if DOORS[to].is_folder:
        path.mkdir()
    DOORS[to].writer()(source, path)
    return source.warnings


def marks(observations: Observations, rows: Any = slice(None)) -> set[tuple[int, float, float]]:
    return {
        (int(i), float(u), float(v))
        for i, (u, v) in zip(observations.image[rows], observations.uv_px[rows], strict=True)
    }


def bare(solution: Solution) -> Traverse:
    return replace(solution.traverse, observations=None, constraints=())


# --- ties ---


def test_ties_come_back_with_all_that_is_known(tmp_path: Path) -> None:
    solution = solved()
    assert written(solution, tmp_path / "a.tpt", "tpt") == []
    found = read_ties(tmp_path / "a.tpt")
    assert {tie.type for tie in found.ties} == {0, 1, 3, 4, 6, 7, 8}
    back = with_ties(bare(solution), found, tmp_path / "a.tpt")
    given, again = solution.traverse.observations, back.observations
    assert given is not None
    assert again is not None
    assert marks(again) == marks(given, solution.used)
    track = {m: int(t) for m, t in zip(_rows(again), again.track, strict=True)}
    before = {m: int(t) for m, t in zip(_rows(given), given.track, strict=True)}
    for one in (m for m in track if m in before):
        alike = {m for m in track if track[m] == track[one]}
        assert alike == {m for m in track if before[m] == before[one]}
    assert len(back.constraints) == len(solution.traverse.constraints)
    # Which track is which, by its first mark.
    name = {track[m]: before[m] for m in track}
    for mine, theirs in zip(
        sorted(back.constraints, key=lambda c: (c.kind, str(c.stops), len(getattr(c, "axes", ())))),
        sorted(
            solution.traverse.constraints, key=lambda c: (c.kind, str(c.stops), len(getattr(c, "axes", ())))
        ),
        strict=True,
    ):
        assert type(mine) is type(theirs)
        assert mine.robust
        assert name[int(mine.landmarks[0])] == theirs.landmarks[0]
        for number in ("target_m", "value"):
            if hasattr(theirs, number):
                assert np.allclose(getattr(mine, number), getattr(theirs, number), atol=1e-12)


def _rows(observations: Observations) -> list[tuple[int, float, float]]:
    return [
        (int(i), float(u), float(v)) for i, (u, v) in zip(observations.image, observations.uv_px, strict=True)
    ]


def test_what_ties_say_of_an_adjustment(tmp_path: Path) -> None:
    """Residuals, and the final point, which projects onto its marks with these residuals."""
    solution = solved()
    written(solution, tmp_path / "a.tpt", "tpt")
    root = ET.parse(tmp_path / "a.tpt").getroot()
    keys = {i.attrib["key"]: i.attrib["unique_id"] for i in root.iter("image")}
    row = {image.id: i for i, image in enumerate(solution.traverse.images)}
    ties = [tie for tie in root.iter("tie") if tie.find("final_xyz") is not None]
    assert len(ties) > 40
    for tie in ties:
        xyz = tie.find("final_xyz")
        assert xyz is not None
        point = np.array([float(xyz.attrib[a]) for a in "xyz"]) * [1, -1, -1]
        for side in ("left", "right"):
            image = row[keys[tie.attrib[f"{side}_key"]]]
            mark, residual = tie.find(side), tie.find(f"{side}_final_residual")
            assert mark is not None
            assert residual is not None
            R, t = solution.final.world_R_camera[image], solution.final.world_t_camera[image]
            uv, _ = solution.image_cameras[image].project(((point - t) @ R)[None])
            expected = uv[0] - [float(mark.attrib["samp"]), float(mark.attrib["line"])]
            assert np.allclose([float(residual.attrib[a]) for a in ("samp", "line")], expected, atol=1e-6)
        miss = tie.find("final_miss")
        assert miss is not None
        assert 0 <= float(miss.attrib["dist"]) < 0.2


TIE = """<?xml version="1.0"?>
<tiepoint_file version="1.0"><tiepoint_set>
  <reference_frame name="SITE" index1="0"/>
  <images><image unique_id="{a}" key="7"/><image unique_id="{b}" key="9"/></images>
  <tiepoints>
    <tie type="0" left_key="7" right_key="9">
      <left line="{av}" samp="{au}"/><projected line="0" samp="0"/><right line="{bv}" samp="{bu}"/>
      <flags quality="0.9" interactive="1"/></tie>
    {tie}
  </tiepoints></tiepoint_set></tiepoint_file>
"""


@pytest.mark.parametrize("kind", range(11))
def test_each_type_of_tie_has_its_truth(tmp_path: Path, kind: int) -> None:
    """A tie of a known point, made by the definition of its type, leaves no residual at the truth."""
    solution = solved()
    given = solution.traverse.observations
    assert given is not None
    final, t = solution.final, solution.traverse
    seen = [r for r in np.flatnonzero(solution.used) if t.image_stop[given.image[r]] == 0]
    track = next(k for k in given.track[seen] if np.count_nonzero(given.track[seen] == k) >= 2)
    left, right = (int(r) for r in [r for r in seen if given.track[r] == track][:2])
    point = final.landmarks_m[solution.landmark_track.tolist().index(track)]
    a, b = int(given.image[left]), int(given.image[right])
    pixel = []
    for image in (a, b):
        R, centre = final.world_R_camera[image], final.world_t_camera[image]
        pixel.append(solution.image_cameras[image].project(((point - centre) @ R)[None])[0][0])
    (au, av), (bu, bv) = pixel
    x, y, z = point * [1, -1, -1]  # z down
    arm = (point - final.world_T_mast[0].translation()) * [1, -1, -1]
    azimuth, elevation = (
        np.degrees(np.arctan2(arm[1], arm[0])),
        np.degrees(np.arctan2(-arm[2], np.hypot(*arm[:2]))),
    )
    pair = f'left_key="7" right_key="9"><left line="{av}" samp="{au}"/><right line="{bv}" samp="{bu}"/>'
    one = f'left_key="7"><left line="{av}" samp="{au}"/>'
    inside = {
        0: pair,
        1: f'{one}<xyz x="{x}" y="{y}" z="{z}"/>',
        # It slides along its line: the mark is 5 px off on it.
        2: f'left_key="7" right_key="9"><left line="{av}" samp="{au}"/>'
        f'<right line="{bv - 5 * np.sin(np.radians(30))}" samp="{bu + 5 * np.cos(np.radians(30))}"/>'
        '<angle degrees="30"/>',
        3: pair,
        4: f'{one}<xy x="{x}" y="{y}"/>',
        5: f'{one}<xyz x="{x}" y="{y}" z="{z}"/>',
        6: f'{one}<azimuth degrees="{azimuth}"/>',
        7: f'{one}<elevation degrees="{elevation}"/>',
        8: f'{pair}<z z="{z}"/>',
        9: pair,
        10: pair,
    }[kind]
    tie = f'<tie type="{kind}" {inside}<flags quality="0.9" interactive="0"/></tie>'
    text = TIE.format(a=t.images[a].id, b=t.images[b].id, au=au, av=av, bu=bu, bv=bv, tie=tie)
    if kind == 2:  # alone: a pair on the same marks would be another mark of the right image
        text = re.sub(r'<tie type="0".*?</tie>', "", text, flags=re.DOTALL)
    (tmp_path / "one.tpt").write_text(text)
    back = with_ties(bare(solution), read_ties(tmp_path / "one.tpt"), tmp_path / "one.tpt")
    assert back.observations is not None
    assert sorted(back.observations.image.tolist()) == sorted([a, b])
    assert set(back.observations.track.tolist()) == {0}
    expected = {1: LandmarkPosition, 3: LandmarkInfinity, 4: LandmarkPosition, 5: LandmarkPosition}
    expected |= {6: LandmarkAzimuth, 7: LandmarkElevation, 8: LandmarkHeight}
    assert [type(c) for c in back.constraints] == ([expected[kind]] if kind in expected else [])
    (known,) = back.constraints or (None,)
    if isinstance(known, LandmarkPosition):
        assert known.axes.tolist() == ([0, 1] if kind == 4 else [0, 1, 2])
        assert np.allclose(known.target_m, point[known.axes], atol=1e-12)
    if isinstance(known, LandmarkHeight):
        assert known.value == pytest.approx(point[2], abs=1e-12)
    if isinstance(known, LandmarkAzimuth):
        assert known.value == pytest.approx(np.arctan2(-arm[1], arm[0]), abs=1e-12)
    if isinstance(known, LandmarkElevation):
        assert known.value == pytest.approx(np.radians(elevation), abs=1e-12)
    if kind == 2:
        row = back.observations.image.tolist().index(b)
        off = back.observations.uv_px[row] - [bu, bv]
        assert np.linalg.norm(off) == pytest.approx(5)
        assert back.observations.covariance_px2 is not None
        weight = np.linalg.inv(back.observations.covariance_px2[row])
        assert off @ weight @ off < 1e-4  # along the line it weighs nothing
        across = np.array([off[1], -off[0]]) / 5
        assert across @ weight @ across == pytest.approx(1 / 0.5**2, rel=1e-6)
        other = back.observations.covariance_px2[1 - row]
        assert np.allclose(other, 0.5**2 * np.eye(2))


def test_a_tie_of_each_image_is_one_fiducial(tmp_path: Path) -> None:
    """Fiducials of the same coordinates join images without a pair; one that one image sees is left out."""
    t = solved().traverse
    lines = "".join(
        f'<tie type="1" left_key="{key}"><left line="{10 * y}" samp="{key}"/><xyz x="1" y="{y}" z="3"/></tie>'
        for key, y in ((7, 2), (9, 2), (7, 5))
    )
    text = TIE.format(a=t.images[0].id, b=t.images[1].id, au=1, av=1, bu=2, bv=2, tie=lines)
    (tmp_path / "f.tpt").write_text(text)
    back = with_ties(bare(solved()), read_ties(tmp_path / "f.tpt"), tmp_path / "f.tpt")
    assert back.observations is not None
    assert len(back.observations) == 4
    (known,) = back.constraints
    assert isinstance(known, LandmarkPosition)
    assert known.target_m.tolist() == [1, -2, -3]
    assert (
        "1 points are seen in one image alone: they are left out, and 1 constraints on them"
        in back.warnings[-1]
    )


def test_older_text_counts_images(tmp_path: Path) -> None:
    solution = solved()
    (warning,) = written(solution, tmp_path / "a.tpt", "tpt-text")
    assert "the older text has no constraints" in warning
    back = with_ties(bare(solution), read_ties(tmp_path / "a.tpt"), tmp_path / "a.tpt")
    given = solution.traverse.observations
    assert given is not None
    assert back.observations is not None
    assert marks(back.observations) <= marks(given, solution.used)
    assert len(back.observations) > 80


def test_constraints_without_a_type_are_named(tmp_path: Path) -> None:
    solution = solved()
    plane = LandmarkPlane(landmark=1, normal=(0, 0, 1), offset_m=0.0, sigma_m=0.1)
    solution = replace(solution, traverse=replace(solution.traverse, constraints=(plane,)))
    (warning,) = written(solution, tmp_path / "a.tpt", "tpt")
    assert warning.endswith("left out: 1 landmark-plane")


@pytest.mark.parametrize(
    ("pattern", "by", "says"),
    [
        (
            'unique_id="[^"]*"',
            'unique_id="MER1NL_1"',
            "key of its own|expected pictures of .*, found MER1NL_1",
        ),
        (
            'name="SITE"',
            'name="ROVER_FRAME"',
            r"tie 1 \(fiducial\): reference_frame: expected SITE, found ROVER_FRAME",
        ),
        ('type="1"', 'type="11"', "tie 1: type: expected 0 to 10, found 11"),
        ('left_key="7"', 'left_key="8"', "tie 0: left_key: expected the key of an image, found 8"),
        ("<xyz[^>]*>", "", "tie 1: expected an element xyz, found none"),
        ('samp="20"', 'samp="many"', "tie 1: left samp: expected a number, found 'many'"),
        ("<tiepoints>.*</tiepoints>", "<tiepoints/>", "expected at least one tie, found none"),
        ("tiepoint_file", "tiepoints", r"expected a file of tie points \(tiepoint_file\), found 'tiepoints'"),
    ],
)
def test_ties_that_are_wrong_are_refused(tmp_path: Path, pattern: str, by: str, says: str) -> None:
    t = solved().traverse
    tie = '<tie type="1" left_key="7"><left line="10" samp="20"/><xyz x="1" y="2" z="3"/></tie>'
    text = TIE.format(a=t.images[0].id, b=t.images[1].id, au=1, av=1, bu=2, bv=2, tie=tie)
    path = tmp_path / "a.tpt"
    path.write_text(re.sub(pattern, by, text, flags=re.DOTALL))
    with pytest.raises(InputError, match=says) as error:
        with_ties(bare(solved()), read_ties(path), path)
    assert str(path) in str(error.value)


@pytest.mark.slow
def test_ties_lead_a_drive_back(tmp_path: Path) -> None:
    """Without noise a drive whose telemetry is off, and loose, ends where the ties of a .tpt say."""
    simulation = simulated(2, 2)
    ties = [tie for tie in landmark_ties(simulation) if tie.kind in SAID]
    told = noise_free(simulation)
    source = traverse_source(replace(told, constraints=(ties[0], *ties[3:])))
    DOORS["tpt"].writer()(source, tmp_path / "a.tpt")
    assert {tie.type for tie in read_ties(tmp_path / "a.tpt").ties} == {0, 1, 6, 8}
    assert source.warnings[0].endswith(
        "left out: 1 landmark-elevation"
    )  # no image of its stop sees the point
    first, second = told.stops
    shift = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.01, -0.01, 0.03), np.array([0.4, -0.3, 0.1]))
    loose = replace(
        told,
        observations=None,
        stops=(
            first,
            replace(
                second,
                world_T_mast=second.world_T_mast * shift,
                sigma_rotation_rad=1.0,
                sigma_translation_m=10.0,
            ),
        ),
        frames=tuple(replace(f, sigma_pan_rad=0.5, sigma_tilt_rad=0.5) for f in told.frames),
    )
    back = with_ties(loose, read_ties(tmp_path / "a.tpt"), tmp_path / "a.tpt")
    solution = solve(back, SolveOptions(rig="held"))
    assert solution.converged
    true = simulation.truth.world_T_mast[1]
    apart = np.abs(true.localCoordinates(solution.final.world_T_mast[1]))
    # With loose pans a turn of the mast about its axis is told by their sum with it alone.
    heading = solution.final.pan_tilt_rad[:, 0] - simulation.truth.pan_tilt_rad[:, 0]
    turn = true.between(solution.final.world_T_mast[1]).rotation().yaw()
    assert np.abs(heading[solution.traverse.frame_stop == 1] + turn).max() < 1e-4
    assert np.delete(apart, 2).max() < 1e-4
    assert not [
        test for test in (solution.verdict.failures if solution.verdict else ()) if "let go" in test.name
    ]


# --- pointing and places ---


def test_pointings_come_back(tmp_path: Path) -> None:
    solution = solved()
    written(solution, tmp_path / "a.nav", "nav")
    written(solution, tmp_path / "t.nav", "nav-text")
    for name, digits in (("a.nav", 1e-12), ("t.nav", 2e-11)):
        back = with_pointing(solution.traverse, read_nav(tmp_path / name), tmp_path / name)
        off = np.abs(np.angle(np.exp(1j * (back.pan_tilt_rad - solution.final.pan_tilt_rad))))
        assert off.max() < digits
        assert back.warnings == solution.traverse.warnings
    first = read_nav(tmp_path / "a.nav").entries[0]
    told = solution.traverse.pan_tilt_rad[solution.traverse.image_frame[0]]
    assert np.allclose(np.radians(first.original_deg) * [-1, 1], told, atol=2 * np.pi)
    assert abs(first.original_deg[0] - first.pointing_deg[0]) < 5


def test_the_highest_priority_counts(tmp_path: Path) -> None:
    who = solved().traverse.images[0].id
    one = (
        '<solution solution_id="{id}"><image unique_id="{who}"><original_parameters type="x"/></image>'
        '<pointing_parameters><parameter id="Joint Elevation" value="{el}"/>'
        '<parameter id="Joint Azimuth" value="20"/></pointing_parameters></solution>'
    )
    for order, expected in ((("low", "high"), 2.0), (("high", "low"), 1.0), ((), 3.0)):
        listed = "".join(f'<entry solution_id="{o}"/>' for o in order)
        solutions = [("high", 2.0), ("low", 1.0), *([("other", 3.0)] if not order else [])]
        text = "".join(one.format(id=i, who=who, el=e) for i, e in solutions)
        text = text.replace('<original_parameters type="x"/>', "")
        (tmp_path / "p.nav").write_text(
            f"<pointing_correction><priority>{listed}</priority>{text}</pointing_correction>"
        )
        (entry,) = read_nav(tmp_path / "p.nav").entries
        assert entry.pointing_deg == (20.0, expected)


def model_of(element: ET.Element, size: tuple[int, int]) -> CAHV:
    vectors: dict[str, FloatArray] = {}
    linearity = 1.0
    for p in element.iter("parameter"):
        if p.attrib["id"] == "P":
            linearity = float(p.attrib.get("value") or p.attrib["v"])
        elif p.attrib["id"] != "T":
            names = ("value1", "value2", "value3") if "value1" in p.attrib else ("x", "y", "z")
            vectors[p.attrib["id"]] = np.array([float(p.attrib[n]) for n in names])
    return cahv_of_vectors(*size, vectors, linearity)


@pytest.mark.parametrize("rover", [False, True])
@pytest.mark.parametrize("template", ["mer-navcam", "msl-navcam"])
def test_cameras_of_nav_and_vector_project_as_the_solution(
    tmp_path: Path, template: str, rover: bool
) -> None:
    """With a rover, its cameras are in the rover frame, and the .rvf says where that is."""
    solution = solved(template, rover=rover)
    written(solution, tmp_path / "a.nav", "nav")
    written(solution, tmp_path / "v", "vector")
    nav = {}
    for element in ET.parse(tmp_path / "a.nav").getroot().iter("solution"):
        named = element.find("image")
        assert named is not None
        nav[named.attrib["unique_id"]] = element
    vector = {c.attrib["id"]: c for c in ET.parse(tmp_path / "v" / "cameras.xml").getroot().iter("camera")}
    site_T_rover = {}
    if rover:
        written(solution, tmp_path / "a.rvf", "rvf")
        for s in ET.parse(tmp_path / "a.rvf").getroot().iter("solution"):
            offset, turn = s.find("offset"), s.find("orientation")
            assert offset is not None
            assert turn is not None
            R = rotation_from_wxyz([float(turn.attrib[n]) for n in ("s", "v1", "v2", "v3")])
            site_T_rover[int(s.attrib["index2"])] = R, np.array([float(offset.attrib[a]) for a in "xyz"])
    rng = np.random.default_rng(0)
    for row, image in enumerate(solution.traverse.images):
        camera = solution.image_cameras[row]
        size = camera.width_px, camera.height_px
        uv = rng.uniform(0, np.array(size) - 1, (100, 2))
        local = np.exp(rng.uniform(0, 5, (100, 1))) * camera.unproject(uv).direction
        world = local @ solution.final.world_R_camera[row].T + solution.final.world_t_camera[row]
        site = world * [1, -1, -1]
        if rover:
            R, t = site_T_rover[int(solution.traverse.image_stop[row])]
            site = (site - t) @ R
        told = nav[image.id].find("camera_model")
        assert told is not None
        assert np.abs(model_of(told, size).project(site)[0] - uv).max() < 1e-6
        final = vector[image.id].find("final")
        assert final is not None
        model = model_of(final, size)
        assert isinstance(model, CAHVORE)
        # Templates have O to seven digits; a CAHVORE takes it as of unit length, a CAHVOR as it is.
        assert np.abs(model.project(site)[0] - uv).max() < (1e-6 if template == "mer-navcam" else 2e-5)


def test_tracks_of_vector_are_the_observations(tmp_path: Path) -> None:
    solution = solved()
    written(solution, tmp_path / "v", "vector")
    root = ET.parse(tmp_path / "v" / "tracks.xml").getroot()
    row = {image.id: i for i, image in enumerate(solution.traverse.images)}
    found = set()
    for point in root.iter("point"):
        pixel = point.find("pixel")
        assert pixel is not None
        found.add((row[point.attrib["camera_id"]], float(pixel.attrib["x"]), float(pixel.attrib["y"])))
    given = solution.traverse.observations
    assert given is not None
    assert found == marks(given, solution.used)


def test_without_a_rover_there_is_no_rvf(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="rvf: rig: expected a mast whose place on the rover is known"):
        written(solved(), tmp_path / "a.rvf", "rvf")


# --- control networks ---


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
