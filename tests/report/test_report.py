"""The page: self-contained, escaped, repeatable; its views hold what the solution says."""

import base64
import json
from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest

from pancam_graph.base.ellipses import ellipse_outlines, translation_covariance_in_world
from pancam_graph.base.geometry import rz
from pancam_graph.data import Solution
from pancam_graph.report import write_report
from pancam_graph.report._figures import histogram_edges, make_corrections, make_histogram
from pancam_graph.report._images import choose_images, image_residuals, vector_panels
from pancam_graph.report._map import make_map
from pancam_graph.report._page import headline, lead, make_page
from pancam_graph.report._scene import eye_circles, make_masts, scene_figure
from pancam_graph.report._shown_terrain import landmark_residuals, shown_terrain
from pancam_graph.rigs import mer_navcam
from support.made_solutions import fabricate
from support.report_pages import figures_of, parsed, unpacked


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


def test_how_far_the_pointing_moved_stands_first(solution: Solution) -> None:
    """Absolute, and between neighbouring frames of a stop: a turn that they share is not a gain."""
    frames = solution.traverse.frames
    alternating = np.where(np.arange(len(frames)) % 2 == 0, 1e-3, -1e-3)
    told = solution.traverse.pan_tilt_rad
    turned = told + np.column_stack([np.full(len(frames), 5e-3), alternating])
    turned[3] = np.nan
    moved = replace(solution, final=replace(solution.final, pan_tilt_rad=turned))
    name, value, remark, bad = headline(moved)[0]
    assert (name, value, bad) == ("pan and tilt moved by", "5.00 and 1.00 mrad", False)
    assert "between neighbouring frames of a stop 0 and 2.00 mrad" in remark
    nowhere = replace(solution, final=replace(solution.final, pan_tilt_rad=np.full_like(told, np.nan)))
    assert headline(nowhere)[0][0] == "residual, RMS"


def test_scene_and_map_hold_every_landmark_inside(solution: Solution) -> None:
    terrain = shown_terrain(solution)
    usable = np.isfinite(landmark_residuals(solution))
    assert len(terrain.points_m) + terrain.outside == usable.sum()
    assert terrain.unusable == np.sum(~usable)
    scene, views = scene_figure(solution, terrain, make_masts(solution))
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
    _, views = scene_figure(solution, shown_terrain(solution), make_masts(solution))
    for view in views:
        side = [high - low for low, high in view["range"]]
        scale = [view["ratio"][name] / s for name, s in zip("xyz", side, strict=True)]
        assert scale == pytest.approx([scale[0]] * 3, rel=1e-3)


def test_landmarks_on_the_horizon_do_not_shrink_the_scene(solution: Solution) -> None:
    points = solution.final.landmarks_m.copy()
    points[::20] *= 500.0
    far = replace(solution, final=replace(solution.final, landmarks_m=points))
    near_terrain, terrain = shown_terrain(solution), shown_terrain(far)
    assert terrain.extent_m < 1.5 * near_terrain.extent_m
    assert terrain.outside > near_terrain.outside
    scene, _ = scene_figure(far, terrain, make_masts(far))
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
    figure = make_map(solution, shown_terrain(solution))
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
    assert shown_terrain(replace(solution, residual_final_px=zero)).residual_limit_px == 1.0


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
    terrain = shown_terrain(moved)
    np.testing.assert_allclose(
        terrain.points_m.mean(axis=0), shown_terrain(solution).points_m.mean(axis=0), atol=3
    )
    scene, _ = scene_figure(moved, terrain, make_masts(moved))
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
