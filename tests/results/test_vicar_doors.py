"""Files of VICAR and control networks: what they say in numbers, out and in.

Truths are computed here from poses and points; XML is read with the standard library. Real files of marsnav
were not at hand.
"""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import gtsam
import numpy as np
import pytest

from pancam_graph import SolveOptions, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, rotation_from_wxyz
from pancam_graph.cameras import CAHV, CAHVORE, cahv_of_vectors
from pancam_graph.data import (
    FramePoint,
    LandmarkAzimuth,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPlane,
    LandmarkPosition,
    Observations,
)
from pancam_graph.io.vicar import read_nav, read_ties, with_pointing, with_ties
from pancam_graph.results import DOORS
from pancam_graph.results._read_source import traverse_source
from support.door_solutions import SAID, bare, marks, solved, written
from support.small_drives import simulated
from support.tied_drives import landmark_ties, noise_free


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
    """Fiducials of the same coordinates join images without a pair; one image's own is of its frame."""
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
    known, alone = back.constraints
    assert isinstance(known, LandmarkPosition)
    assert known.target_m.tolist() == [1, -2, -3]
    assert isinstance(alone, FramePoint)
    assert (alone.frame, alone.camera) == (t.images[0].frame, t.images[0].camera)
    assert (alone.u_px, alone.v_px, alone.sigma_px, alone.sigma_m) == (7, 50, 0.5, 0.01)
    assert list(alone.position_m) == [1, -5, -3]
    assert alone.robust
    assert back.warnings == bare(solved()).warnings


def test_a_known_place_that_one_image_sees_is_written_and_read(tmp_path: Path) -> None:
    solution = solved()
    t = solution.traverse
    known = FramePoint(
        frame=t.images[0].frame,
        camera=t.images[0].camera,
        u_px=12.5,
        v_px=20.25,
        sigma_px=0.5,
        position_m=(3.0, -2.0, 0.5),
        sigma_m=0.01,
        robust=True,
    )
    told = replace(solution, traverse=replace(t, constraints=(known,)))
    assert written(told, tmp_path / "f.tpt", "tpt") == []
    other = replace(known, u_px=99.0)  # as other points, it gives way to those of the file
    before = replace(bare(told), constraints=(other,))
    back = with_ties(before, read_ties(tmp_path / "f.tpt"), tmp_path / "f.tpt")
    (found,) = back.constraints
    assert isinstance(found, FramePoint)
    for name, value in vars(known).items():
        assert getattr(found, name) == value, name


def test_what_one_image_knows_of_a_point_but_its_place_is_left_out(tmp_path: Path) -> None:
    t = solved().traverse
    tie = '<tie type="4" left_key="7"><left line="10" samp="7"/><xy x="1" y="5"/></tie>'
    pair = (
        '<tie type="0" left_key="7" right_key="9"><left line="1" samp="1"/><right line="2" samp="2"/></tie>'
    )
    text = TIE.format(a=t.images[0].id, b=t.images[1].id, au=1, av=1, bu=2, bv=2, tie=tie + pair)
    (tmp_path / "f.tpt").write_text(text)
    back = with_ties(bare(solved()), read_ties(tmp_path / "f.tpt"), tmp_path / "f.tpt")
    assert not back.constraints
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
