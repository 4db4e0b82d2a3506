"""The report: well formed, self-contained, small, and whole on every kind of solution."""

import base64
import gzip
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

from pancam_graph import Frame, Image, Observations, Stop, Traverse
from pancam_graph.base.geometry import FloatArray, rz
from pancam_graph.cli._program import print_summary
from pancam_graph.data import Matching, PairMatching, Refined, Refusal, Seconds, Solution, State, StopMatching
from pancam_graph.report import write_report
from pancam_graph.report._figures import histogram_edges, make_corrections, make_histogram
from pancam_graph.report._images import choose_images, image_residuals, magnification, vector_panels
from pancam_graph.report._map import ellipse_outlines, make_map, place_labels, translation_covariance_in_world
from pancam_graph.report._numbers import round_factor, rounded, short, thinned
from pancam_graph.report._page import headline, lead, make_page
from pancam_graph.report._scene import eye_circles, label_stops, make_masts, make_scene
from pancam_graph.report._tables import observation_table
from pancam_graph.report._terrain import landmark_residuals, make_terrain
from pancam_graph.rigs import Rig, mer_navcam

VOID = {"meta", "link", "br", "img", "input", "hr"}


def fabricate(
    *,
    rig: Rig | None = None,
    stops: int = 2,
    pans: int = 6,
    points: int = 300,
    spacing_m: float = 5.0,
    noise_px: float = 0.3,
    outliers: float = 0.03,
    seed: int = 0,
    model: str = "mast",
    folder: Path | None = None,
    ids: Callable[[str], str] = lambda name: name,
) -> Solution:
    """A solution without a solver: its start is disturbed telemetry, its end the truth."""
    rng = np.random.default_rng(seed)
    rig = rig or mer_navcam()
    sigma = 1.34e-3
    mast_m = np.column_stack([spacing_m * np.arange(stops), np.zeros(stops), np.full(stops, 1.5)])
    true_masts = tuple(gtsam.Pose3(gtsam.Rot3(rz(0.3 * s)), mast_m[s]) for s in range(stops))
    held = [s == 0 for s in range(stops)]
    noise = np.concatenate([rng.normal(0, 0.005, (stops, 3)), rng.normal(0, 0.05, (stops, 3))], axis=1)
    given_masts = tuple(
        pose if fixed else pose.retract(d) for pose, d, fixed in zip(true_masts, noise, held, strict=True)
    )
    true_angles = np.array([[2 * np.pi * p / pans, -0.15] for _ in range(stops) for p in range(pans)])
    given_angles = true_angles + rng.normal(0, sigma, true_angles.shape)
    traverse = Traverse(
        name=ids("test traverse"),
        rig=rig,
        folder=folder,
        stops=tuple(
            Stop(
                id=ids(f"stop{s}"),
                world_T_mast=pose,
                sigma_rotation_rad=0.0 if fixed else 0.005,
                sigma_translation_m=0.0 if fixed else 0.05,
            )
            for s, (pose, fixed) in enumerate(zip(given_masts, held, strict=True))
        ),
        frames=tuple(
            Frame(
                id=ids(f"frame{f}"),
                stop=ids(f"stop{f // pans}"),
                pan_rad=pan,
                tilt_rad=tilt,
                sigma_pan_rad=sigma,
                sigma_tilt_rad=sigma,
            )
            for f, (pan, tilt) in enumerate(given_angles.tolist())
        ),
        images=tuple(
            Image(
                id=ids(f"image{f}{eye.name}"),
                frame=ids(f"frame{f}"),
                camera=eye.name,
                file=f"{f}{eye.name}.png" if folder else None,
            )
            for f in range(stops * pans)
            for eye in rig.eyes
        ),
    )
    distance = np.exp(rng.uniform(np.log(2.0), np.log(40.0), points))
    bearing, home = rng.uniform(0, 2 * np.pi, points), rng.integers(stops, size=points)
    landmarks = mast_m[home] + np.column_stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-1.6, -0.5, points)]
    )
    rows = []
    for image, (R, t) in enumerate(zip(*traverse.camera_poses(true_masts, true_angles), strict=True)):
        camera = rig.eyes[traverse.image_eye[image]].camera
        uv, valid = camera.project((landmarks - t) @ R)
        seen = np.flatnonzero(valid & camera.contains(uv) & (rng.random(points) < 0.6))
        rows.append(np.column_stack([np.full(len(seen), image), seen, uv[seen]]))
    table = np.concatenate(rows)
    uv = table[:, 2:] + rng.normal(0, noise_px, (len(table), 2)) if noise_px else table[:, 2:]
    bad = rng.random(len(table)) < outliers
    uv[bad] += rng.uniform(20, 90, (int(bad.sum()), 2))
    observations = Observations(
        image=table[:, 0].astype(np.int64),
        track=2 * table[:, 1].astype(np.int64) + 1,  # numbers may leave gaps
        uv_px=uv,
        sigma_px=np.full(len(uv), noise_px or 0.5),
    )
    traverse = traverse.with_observations(observations)

    def state(masts: tuple[gtsam.Pose3, ...], angles: FloatArray) -> State:
        R, t = traverse.camera_poses(masts, angles)
        return State(
            world_T_mast=masts,
            pan_tilt_rad=angles,
            world_R_camera=R,
            world_t_camera=t,
            landmarks_m=landmarks.copy(),
        )

    def residuals(at: State) -> FloatArray:
        out = np.full((len(uv), 2), np.nan)
        for image in range(len(traverse.images)):
            mine = observations.image == image
            camera = rig.eyes[traverse.image_eye[image]].camera
            point = landmarks[table[mine, 1].astype(int)]
            found, _ = camera.project((point - at.world_t_camera[image]) @ at.world_R_camera[image])
            out[mine] = found - observations.uv_px[mine]
        return out

    initial, final = state(given_masts, given_angles), state(true_masts, true_angles)
    before, after = residuals(initial), residuals(final)
    covariance = np.zeros((stops, 6, 6))
    for s in range(1, stops):
        root = rng.normal(0, 1, (6, 6)) * np.array([2e-4] * 3 + [2e-3] * 3)[:, None]
        covariance[s] = root @ root.T
    return Solution(
        traverse=traverse,
        model=model,
        landmarks="explicit",
        converged=True,
        stop_reason="the cost fell by less than 1e-9 of itself",
        iterations=6,
        cost_history=(9000.0, 1000.0),
        cost_initial=9000.0,
        cost_final=1000.0,
        initial=initial,
        final=final,
        landmark_track=2 * np.arange(points) + 1,
        used=~bad,
        reason=tuple("outlier" if b else "" for b in bad),
        residual_initial_px=before,
        residual_final_px=after,
        sigma_px=observations.sigma_px,
        stop_covariance=covariance,
        angle_sigma_rad=np.full(true_angles.shape, 1e-4),
        seconds=Seconds(read=0.1, initialise=0.2, solve=1.5),
    )


def unpacked(page: str, name: str) -> str:
    """What is packed in one of the page's script elements."""
    found = re.search(f'<script type="text/plain" id="{name}">([^<]*)</script>', page)
    assert found is not None
    return gzip.decompress(base64.b64decode(found[1])).decode()


def figures_of(page: str) -> dict[str, Any]:
    """The packed figures, by id, with everything else that the script gets."""
    data = json.loads(unpacked(page, "packed-figures"))
    return {**data, **{figure["id"]: figure for figure in data["figures"]}}


class Structure(HTMLParser):
    """Follows tags, so that a page with unbalanced or unknown nesting is noticed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.resources: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in {"src", "href", "srcset", "data", "action"}:
                self.resources.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["script"], ["style"]):
            self.text.append(data)


def parsed(page: str) -> Structure:
    structure = Structure()
    structure.feed(page)
    structure.close()
    assert structure.open == []
    assert len(set(structure.ids)) == len(structure.ids)
    return structure


@pytest.fixture(scope="module")
def solution() -> Solution:
    return fabricate()


@pytest.fixture(scope="module")
def page(solution: Solution) -> str:
    return make_page(solution)


def test_page_is_well_formed_and_loads_nothing(page: str) -> None:
    structure = parsed(page)
    assert structure.resources == []
    assert "@import" not in page
    assert "url(" not in page
    assert "Content-Security-Policy" in page
    assert "default-src 'none'" in page
    assert {"scene", "map", "histogram", "vectors", "corrections"} <= set(structure.ids)


def test_page_does_not_offer_to_upload(page: str) -> None:
    assert "showSendToCloud: false" in page
    assert 'plotlyServerURL: ""' in page


def test_page_is_small_and_holds_plotly(page: str, solution: Solution, tmp_path: Path) -> None:
    write_report(solution, tmp_path / "report.html")
    written = (tmp_path / "report.html").read_bytes()
    assert written.decode() == page
    assert len(written) < 3_000_000
    assert "Plotly" in unpacked(page, "packed-plotly")


def test_same_solution_gives_same_bytes(page: str) -> None:
    assert make_page(fabricate()) == page


def test_user_strings_are_escaped(tmp_path: Path) -> None:
    hostile = fabricate(ids=lambda name: f"</script><b>{name}&\"'", points=60, stops=1, pans=2)
    hostile = replace(hostile, warnings=("<img src=x onerror=alert(1)>",), stop_reason="a < b")
    page = make_page(hostile)
    structure = parsed(page)
    assert structure.resources == []
    assert "<b>" not in page.replace("<b>${side}</b>", "")
    assert any("<img src=x onerror=alert(1)>" in text for text in structure.text)
    figures = figures_of(page)
    marks = [t for t in figures["map"]["data"] if t["name"].startswith("stop")]
    assert marks[0]["text"] == ["&lt;/script&gt;&lt;b&gt;stop0&amp;&quot;&#x27;"]


def test_words_of_the_head(solution: Solution) -> None:
    assert "24 images that 2 cameras of the mast rig “mer-navcam” took at 2 stops" in lead(solution)
    figures = {name: (value, remark) for name, value, remark, _ in headline(solution)}
    assert figures["outcome"][0] == "converged"
    assert figures["observations"][0] == f"{int(solution.used.sum()):,} used"
    assert "as outliers" in figures["observations"][1]
    assert figures["cost"][0] == "9,000 → 1,000"
    assert figures["time"][0] == "1.8 s"


def test_scene_and_map_hold_every_landmark_inside(solution: Solution) -> None:
    terrain = make_terrain(solution)
    usable = np.isfinite(landmark_residuals(solution))
    assert len(terrain.points_m) + terrain.outside == usable.sum()
    assert terrain.unusable == np.sum(~usable)
    scene, views = make_scene(solution, terrain, make_masts(solution))
    (landmarks,) = [t for t in scene.traces if t["name"] == "landmark"]
    assert len(landmarks["x"]) == len(landmarks["marker"]["color"]) == len(terrain.points_m)
    (on_map,) = [t for t in make_map(solution, terrain).traces if t["name"] == "landmark"]
    assert len(on_map["x"]) == len(terrain.points_m)
    assert [v["name"] for v in views] == ["All stops", "Mast at stop0", "Mast at stop1"]


def test_landmark_residuals_are_of_their_used_observations(solution: Solution) -> None:
    observations = solution.traverse.observations
    assert observations is not None
    found = landmark_residuals(solution)
    for row in np.flatnonzero(np.isfinite(found))[::40]:
        mine = (observations.track == solution.landmark_track[row]) & solution.used
        square = np.sum(solution.residual_final_px[mine] ** 2, axis=1)
        assert found[row] == pytest.approx(np.sqrt(square.mean()))
    shuffled = np.random.default_rng(1).permutation(len(found))
    other = replace(solution, landmark_track=solution.landmark_track[shuffled])
    np.testing.assert_allclose(landmark_residuals(other), found[shuffled])


def test_all_axes_of_a_view_have_one_scale(solution: Solution) -> None:
    _, views = make_scene(solution, make_terrain(solution), make_masts(solution))
    for view in views:
        side = [high - low for low, high in view["range"]]
        scale = [view["ratio"][name] / s for name, s in zip("xyz", side, strict=True)]
        assert scale == pytest.approx([scale[0]] * 3, rel=1e-3)


def test_landmarks_on_the_horizon_do_not_shrink_the_scene(solution: Solution) -> None:
    points = solution.final.landmarks_m.copy()
    points[::20] *= 500.0
    far = replace(solution, final=replace(solution.final, landmarks_m=points))
    near_terrain, terrain = make_terrain(solution), make_terrain(far)
    assert terrain.extent_m < 1.5 * near_terrain.extent_m
    assert terrain.outside > near_terrain.outside
    scene, _ = make_scene(far, terrain, make_masts(far))
    assert f"{terrain.outside} more lie outside the box" in scene.caption


def test_circles_hold_the_centres_of_their_eyes(solution: Solution) -> None:
    outlines, stops, eyes = eye_circles(solution)
    assert len(outlines) == 4  # two stops, two eyes, one tilt
    traverse = solution.traverse
    for outline, stop, eye in zip(outlines, stops, eyes, strict=True):
        mine = (traverse.image_stop == stop) & (traverse.image_eye == eye)
        radius, _, height = traverse.rig.circle(int(eye), -0.15)
        mast = solution.final.world_T_mast[stop]
        in_mast = np.array([mast.transformTo(p) for p in outline])
        np.testing.assert_allclose(np.hypot(in_mast[:, 0], in_mast[:, 1]), radius, atol=1e-12)
        np.testing.assert_allclose(in_mast[:, 2], height, atol=1e-12)
        centres = np.array([mast.transformTo(p) for p in solution.final.world_t_camera[mine]])
        np.testing.assert_allclose(np.hypot(centres[:, 0], centres[:, 1]), radius, atol=1e-12)


def test_body_covariance_turns_into_the_world() -> None:
    # Forward (body x) is known to 0.1 m, sideways to 0.02 m; the mast faces the world's y axis.
    covariance = np.zeros((1, 6, 6))
    covariance[0, 3, 3], covariance[0, 4, 4], covariance[0, 5, 5] = 0.1**2, 0.02**2, 0.05**2
    found = translation_covariance_in_world(rz(np.pi / 2)[None], covariance)[0]
    np.testing.assert_allclose(found, np.diag([0.02**2, 0.1**2, 0.05**2]), atol=1e-15)
    outline = ellipse_outlines(found[None, :2, :2], 2.0)[0]
    np.testing.assert_allclose(outline.max(axis=0), [0.04, 0.2], rtol=1e-12)
    # At 45 degrees: (a^2 + b^2) / 2 on the diagonal, (a^2 - b^2) / 2 beside it.
    found = translation_covariance_in_world(rz(np.pi / 4)[None], covariance)[0]
    assert found[0, 0] == pytest.approx((0.1**2 + 0.02**2) / 2)
    assert found[0, 1] == pytest.approx((0.1**2 - 0.02**2) / 2)


def test_body_covariance_agrees_with_gtsam() -> None:
    rng = np.random.default_rng(3)
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 1, 3)), rng.normal(0, 5, 3))
    root = rng.normal(0, 1e-4, (6, 6))
    draws = rng.normal(0, 1, (4000, 6)) @ root.T
    moved = np.array([pose.retract(d).translation() for d in draws])
    found = translation_covariance_in_world(pose.rotation().matrix()[None], (root @ root.T)[None])[0]
    np.testing.assert_allclose(np.cov(moved.T), found, atol=0.1 * np.abs(found).max())


def test_ellipses_are_enlarged_by_the_factor_that_is_stated(solution: Solution) -> None:
    figure = make_map(solution, make_terrain(solution))
    (trace,) = [t for t in figure.traces if "ellipse" in t["name"]]
    factor = float(trace["name"].split(", ")[1].split()[0].replace(",", ""))
    assert f"drawn {factor:,.0f} times larger" in figure.caption
    pose = solution.final.world_T_mast[1]
    covariance = translation_covariance_in_world(
        pose.rotation().matrix()[None], solution.stop_covariance[1:2]
    )[0]
    x = np.array([v for v in trace["x"] if v is not None])
    expected = factor * np.sqrt(5.991 * covariance[0, 0])  # chi-square of two at 95 %
    assert (x.max() - x.min()) / 2 == pytest.approx(expected, rel=0.01)


def test_histogram_counts_every_used_observation_in_common_bins(solution: Solution) -> None:
    figure = make_histogram(solution)
    before, after = figure.traces
    assert before["x"] == after["x"]
    for trace in figure.traces:
        assert sum(trace["y"][1:-1:2]) == solution.used.sum()


@pytest.mark.parametrize("ratio", [0.0, 1e-12, 0.02, 0.9, 1.0])
def test_histogram_edges_grow_and_cover_both(ratio: float) -> None:
    before = np.linspace(0.5, 5.0, 1000)
    edges, geometric = histogram_edges(before, ratio * before)
    assert np.all(np.diff(edges) > 0)
    assert edges[-1] == pytest.approx(5.0, rel=0.02)
    assert geometric == (ratio < 0.1)


def test_corrections_and_sigmas_are_in_milliradians(solution: Solution) -> None:
    figure = make_corrections(solution)
    marks = [t for t in figure.traces if t["mode"] == "markers"]
    for column, trace in enumerate(marks):
        np.testing.assert_allclose(trace["y"], 1e3 * solution.correction_rad[:, column], atol=1e-5)
        np.testing.assert_allclose(trace["error_y"]["array"], 0.1, atol=1e-9)


def test_corrections_do_not_jump_by_a_turn(solution: Solution) -> None:
    turned = solution.final.pan_tilt_rad + np.array([2 * np.pi, 0.0])
    figure = make_corrections(replace(solution, final=replace(solution.final, pan_tilt_rad=turned)))
    assert np.abs(figure.traces[1]["y"]).max() < 10


def test_image_table_counts_what_the_solution_says(solution: Solution, page: str) -> None:
    table, rows = image_residuals(solution)
    assert sum(e.used for e in table) == solution.used.sum()
    assert sum(e.rejected for e in table) == np.sum(~solution.used)
    observations = solution.traverse.observations
    assert observations is not None
    assert all(np.all(observations.image[r] == i) for i, r in enumerate(rows))
    total = sum(e.used * e.after_px**2 for e in table) / solution.used.sum()
    assert np.sqrt(total) == pytest.approx(solution.rms_final_px)
    assert page.count("<tr><td") == len(solution.traverse.images) + len(solution.traverse.stops) + 3


def test_observation_table_counts_by_reason(solution: Solution) -> None:
    observations = solution.traverse.observations
    assert observations is not None
    cells = [
        re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in observation_table(solution).split("<tr>")[2:]
    ]
    assert [row[0] for row in cells] == ["one stop", "several stops", "all"]
    numbers = np.array([[int(c) for c in (*row[1:4], *row[5:9])] for row in cells])
    assert (numbers[0] + numbers[1] == numbers[2]).all()
    assert (numbers[:2, :3] > 0).all()
    kinds = ("outlier", "single", "behind", "outside")
    expected = [len(observations), solution.used.sum(), *(solution.reason.count(kind) for kind in kinds)]
    assert numbers[2, 1:].tolist() == expected
    assert (numbers[:, 1] == numbers[:, 2:].sum(axis=1)).all()
    assert [float(row[4]) for row in cells] == pytest.approx(100 * numbers[:, 2] / numbers[:, 1], abs=0.06)


def matched(solution: Solution) -> Solution:
    """The same, as if its observations came from images."""
    pairs = (
        PairMatching(a=0, b=1, candidates=120, rover=0, off_line=20, kept=100),
        PairMatching(a=0, b=2, candidates=50, rover=7, off_line=3, kept=40),
        PairMatching(a=1, b=2, candidates=9, rover=0, off_line=0, kept=0, refusal=Refusal.FEW_ALIKE),
        PairMatching(a=1, b=3, candidates=90, rover=0, off_line=0, kept=0, refusal=Refusal.CHANCE),
    )
    counts: dict[str, Any] = {
        "sought": 300,
        "unlike": 40,
        "ambiguous": 30,
        "unstable": 20,
        "masked": 5,
        "off_pose": 10,
    }
    nothing = dict.fromkeys(counts, 0)
    stops = (
        StopMatching(a=0, b=1, **counts, kept=195, noise_px=0.1234),
        StopMatching(a=1, b=0, **nothing, kept=0, noise_px=0.0, refusal=Refusal.CHANCE),
    )
    traverse = replace(solution.traverse, matching=Matching(pairs=pairs, stops=stops))
    came_back = np.zeros(len(solution.used), dtype=bool)
    came_back[np.flatnonzero(solution.used)[:3]] = True
    return replace(solution, traverse=traverse, came_back=came_back)


def test_page_says_what_was_thrown_away_and_why(solution: Solution, page: str) -> None:
    assert "<h2>Matching</h2>" not in page
    found = make_page(matched(solution))
    parsed(found)
    section = found[found.index("<h2>Matching</h2>") :]
    section = section[: section.index("</section>")]
    lines = [unescape(line) for line in re.findall("<li>(.*?)</li>", section)]
    assert lines == [
        "pairs of images: 2 of 4 matched; 1 too few look alike, 1 no more agree than by chance",
        "their matches: 140 of 170 kept; 23 off their epipolar lines, 7 standing still relative to the mast",
        "patches between stops: 195 of 300 kept; 40 unlike, 30 ambiguous, 20 unstable, 5 masked, "
        "10 off the common pose",
    ]
    rows = [re.findall("<td[^>]*>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", section)]
    stops = [s.id for s in solution.traverse.stops]
    images = [i.id for i in solution.traverse.images]
    filled = [row for row in rows if row]
    assert filled[0] == [*stops[:2], "", "300", "195", "40", "30", "20", "5", "10", "0.123"]
    assert filled[1][:3] == [stops[1], stops[0], "no more agree than by chance"]
    assert filled[3] == [images[0], images[2], "", "50", "40", "3", "7"]
    assert filled[5] == [images[1], images[3], "no more agree than by chance", "90", "0", "0", "0"]
    table = observation_table(matched(solution))
    back = [re.findall("<td[^>]*>(.*?)</td>", row)[9] for row in re.findall("<tr>(<td.*?)</tr>", table)]
    assert back[2] == "3"
    assert int(back[0]) + int(back[1]) == 3


def test_program_prints_what_was_thrown_away_and_why(
    solution: Solution, capsys: pytest.CaptureFixture[str]
) -> None:
    print_summary(solution, "out")
    assert len(capsys.readouterr().out.splitlines()) == 1
    print_summary(matched(solution), "out")
    lines = capsys.readouterr().out.splitlines()
    matching = matched(solution).traverse.matching
    assert matching is not None
    assert lines[1:4] == list(matching.summary())
    left_out = int(np.sum(~solution.used))
    assert lines[4].startswith(f"in the solve: {left_out} of {len(solution.used)} observations left out")
    assert lines[4].endswith("3 of those used came back after they had been set aside")


def test_rig_table_says_what_was_free(solution: Solution, page: str) -> None:
    assert "<h2>Rig</h2>" not in page
    common: dict[str, Any] = {"stop": None, "image": None, "sigma": 1e-3, "prior_sigma": np.inf}
    entries = (
        Refined(quantity="calibration", entry="focal", camera="<left>", nominal=1.0, change=2e-3, **common),
        Refined(quantity="mounts", entry="rx_rad", camera="<left>", nominal=0.0, change=0.1, **common),
        Refined(
            quantity="radius",
            entry="radius_m",
            camera="right",
            stop="s1",
            image="im1",
            nominal=0.25,
            change=-2e-3,
            sigma=np.nan,
            prior_sigma=5e-3,
        ),
        Refined(quantity="calibration", entry="cx_px", camera=None, nominal=None, change=1.5, **common),
    )
    page = make_page(replace(solution, refined=entries))
    text = parsed(page).text
    assert "Rig" in text
    rows = re.findall(r"<tr>(.*?)</tr>", page[page.index("<h2>Rig</h2>") :])[1:5]
    found = [[unescape(cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row)] for row in rows]
    assert found == [
        ["calibration", "<left>", "focal", "", "1.000000", "0.002000", "0.001000", "none"],
        ["mounts", "<left>", "rx", "°", "0.0000", "5.7296", "0.0573", "none"],
        ["radius", "im1", "radius", "mm", "250.00", "-2.00", "\N{EN DASH}", "5.00"],
        ["calibration", "all", "cx", "px", "differs", "1.500", "0.001", "none"],
    ]


def test_vectors_are_those_of_the_image_worst_first(solution: Solution) -> None:
    table, rows = image_residuals(solution)
    order = choose_images(table)
    after = [table[row].after_px for row in order]
    assert after == sorted(after, reverse=True)
    panel = vector_panels(solution, table, rows)[0]
    mine = rows[order[0]]
    assert panel["shown"] == panel["total"] == len(mine)
    np.testing.assert_allclose(np.transpose(panel["after"]), solution.residual_final_px[mine], atol=1e-3)
    assert panel["used"] == solution.used[mine].astype(int).tolist()
    assert panel["picture"] is None


def test_pictures_are_drawn_small_where_they_can_be_read(tmp_path: Path) -> None:
    solution = fabricate(stops=1, pans=2, points=80, folder=tmp_path)
    first, second, *_ = solution.traverse.images
    ramp = np.linspace(0, 4095, 1024 * 1024).reshape(1024, 1024).astype(np.uint16)
    cv2.imwrite(str(tmp_path / str(first.file)), ramp)
    (tmp_path / str(second.file)).write_bytes(b"not an image")
    panels = {p["label"].split(":")[0]: p for p in vector_panels(solution, *image_residuals(solution))}
    source = panels[first.id]["picture"]
    assert source.startswith("data:image/jpeg;base64,")
    jpeg = cv2.imdecode(np.frombuffer(base64.b64decode(source.split(",")[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert jpeg is not None
    assert jpeg.shape == (640, 640)
    assert int(jpeg.max()) - int(jpeg.min()) > 120
    assert panels[second.id]["picture"] is None


@pytest.mark.parametrize("model", ["free", "circle", "projective"])
def test_other_models(model: str) -> None:
    parsed(make_page(fabricate(model=model, points=60, pans=3)))


def test_one_stop_one_eye_one_frame() -> None:
    rig = replace(mer_navcam(), eyes=mer_navcam().eyes[:1])
    solution = fabricate(rig=rig, stops=1, pans=1, points=80)
    page = make_page(solution)
    assert "1 image that 1 camera of the mast rig" in page
    assert len(eye_circles(solution)[0]) == 1


def test_no_residuals_at_all() -> None:
    solution = fabricate(noise_px=0.0, outliers=0.0, points=60, pans=3)
    zero = np.zeros_like(solution.residual_final_px)
    still = replace(solution, residual_initial_px=zero, residual_final_px=zero)
    parsed(make_page(still))
    assert vector_panels(still, *image_residuals(still))[0]["factor"] == [1, 1]
    assert make_terrain(replace(solution, residual_final_px=zero)).residual_limit_px == 1.0


def test_nothing_used_and_no_landmark() -> None:
    solution = fabricate(points=60, pans=3)
    nan = np.full_like(solution.residual_final_px, np.nan)
    page = make_page(
        replace(
            solution,
            used=np.zeros_like(solution.used),
            reason=("single",) * len(solution.used),
            residual_initial_px=nan,
            residual_final_px=nan,
            final=replace(solution.final, landmarks_m=np.zeros((0, 3))),
            landmark_track=np.zeros(0, dtype=np.int64),
            converged=False,
        )
    )
    parsed(page)
    assert "of points seen only once" in page
    assert "not converged" in page


def test_undefined_numbers_become_gaps() -> None:
    solution = fabricate(points=100, pans=3)
    points = solution.final.landmarks_m.copy()
    points[::3] = np.nan
    residuals = solution.residual_final_px.copy()
    residuals[::5] = np.nan
    page = make_page(
        replace(
            solution,
            final=replace(solution.final, landmarks_m=points),
            residual_final_px=residuals,
            residual_initial_px=residuals,
            angle_sigma_rad=np.full_like(solution.angle_sigma_rad, np.nan),
            stop_covariance=np.full_like(solution.stop_covariance, np.nan),
            cost_final=float("nan"),
        )
    )
    parsed(page)  # and the figures are JSON, which has no NaN


def test_a_world_far_from_its_origin_keeps_its_digits() -> None:
    solution = fabricate(points=100, pans=3)
    offset = np.array([432_100.0, 5_678_900.0, -2_000.0])
    final = replace(
        solution.final,
        world_T_mast=tuple(
            gtsam.Pose3(p.rotation(), p.translation() + offset) for p in solution.final.world_T_mast
        ),
        world_t_camera=solution.final.world_t_camera + offset,
        landmarks_m=solution.final.landmarks_m + offset,
    )
    moved = replace(solution, final=final)
    terrain = make_terrain(moved)
    np.testing.assert_allclose(
        terrain.points_m.mean(axis=0), make_terrain(solution).points_m.mean(axis=0), atol=3
    )
    scene, _ = make_scene(moved, terrain, make_masts(moved))
    assert "Coordinates count from (432,100, 5,678,900, -1,998) m" in scene.caption


def test_many_images_stay_within_the_budget() -> None:
    solution = fabricate(stops=12, pans=18, points=1200)
    page = make_page(solution)
    assert len(solution.traverse.images) == 432
    assert len(page) < 5_000_000
    figures = figures_of(page)
    assert figures["vectors"]["id"] == "vectors"
    assert len(json.loads(unpacked(page, "packed-figures"))["vectors"]) == 40
    assert "Of 432 images, the 40 with the largest residuals can be chosen" in page


def test_labels_keep_their_distance() -> None:
    stops = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    assert label_stops(stops, 2.5) == [0, 3, 6, 9]


def test_map_labels_cover_neither_stops_nor_labels() -> None:
    rng = np.random.default_rng(5)
    stops, half = rng.uniform(0, 30, (40, 2)), np.array([2.0, 0.5])
    placed = place_labels(stops, [2 * half] * len(stops), clear_m=0.6)
    assert 10 < len(placed) < 40
    for row, centre in placed.items():
        assert not np.any(np.all(np.abs(stops - centre) < half, axis=1))
        for other, at in placed.items():
            assert other == row or np.any(np.abs(at - centre) >= 2 * half - 1e-9)
    alone = place_labels(np.zeros((1, 2)), [2 * half], clear_m=0.6)
    np.testing.assert_allclose(alone[0], [0.0, -1.1])


@pytest.mark.parametrize(
    ("wanted", "found"), [(0.3, 1), (1, 1), (1.99, 1), (2, 2), (9.9, 5), (10, 10), (730, 500), (np.inf, 1)]
)
def test_round_factors(wanted: float, found: float) -> None:
    assert round_factor(wanted) == found


def test_magnification_of_round_off_is_one() -> None:
    assert magnification(np.full((5, 2), 1e-9), 1024) == 1
    assert magnification(np.full((5, 2), 1.0), 1024) == 20


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.41234, "0.412"),
        (12345.6, "12,346"),
        (1000.4, "1,000"),
        (2.5e-9, "2.50·10⁻⁹"),
        (97_036_128.0, "9.70·10⁷"),
        (float("nan"), "\N{EN DASH}"),
        (150.2, "150"),
    ],
)
def test_short_numbers(value: float, text: str) -> None:
    assert short(value) == text


def test_rounded_has_no_nan_and_no_negative_zero() -> None:
    found = rounded([1.23456, np.nan, -1e-9, np.inf], 2)
    assert found == [1.23, None, 0.0, None]
    assert str(found[2]) == "0.0"


def test_thinned_is_even_and_whole_when_few() -> None:
    assert thinned(5, 10).tolist() == [0, 1, 2, 3, 4]
    assert thinned(100, 4).tolist() == [0, 33, 66, 99]
