"""The folder of results: its four files, and that it is whole or not there."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

import pancam_graph.report
from pancam_graph.base.errors import InputError
from pancam_graph.data import Refined, RigCorrection, Solution
from pancam_graph.results import EXPORTS, check_exports, check_out, read_solution_json, write_results
from pancam_graph.results._brightness import brightness_of
from pancam_graph.results._output import Output, OutputWriter, Written
from pancam_graph.results._outputs import OUTPUTS
from support import io_samples


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(autouse=True)
def small_report(monkeypatch: pytest.MonkeyPatch) -> None:
    def write_report(solution: Solution, path: Path, mosaics: None, terrain: None) -> None:
        path.write_text(f"<html>{solution.model}</html>")

    monkeypatch.setattr(pancam_graph.report, "write_report", write_report, raising=False)


def read_ply(path: Path) -> tuple[list[str], np.ndarray[Any, Any]]:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    types = {"double": "<f8", "float": "<f4", "int": "<i4", "uchar": "u1"}
    lines = header.decode("ascii").splitlines()
    properties = [line.split()[1:] for line in lines if line.startswith("property")]
    return lines, np.frombuffer(body, dtype=[(name, types[kind]) for kind, name in properties])


def test_solution_json_has_the_keys_of_the_contract(tmp_path: Path) -> None:
    write_results(io_samples.solution(), tmp_path / "out")
    data = json.loads((tmp_path / "out" / "solution.json").read_text())
    assert list(data) == [
        "format",
        "version",
        "model",
        "landmarks",
        "converged",
        "stop_reason",
        "iterations",
        "seconds",
        "cost",
        "rms_px",
        "observations",
        "stops",
        "frames",
        "images",
        "cameras",
        "warnings",
    ]
    assert (data["format"], data["version"]) == ("pancam-graph/solution", 1)
    assert set(data["seconds"]) == {"read", "initialise", "solve", "report"}
    assert data["cost"] == {"initial": 200.0, "final": 50.0}
    assert data["rms_px"] == {"initial": pytest.approx(1.0), "final": pytest.approx(0.5)}
    assert set(data["stops"][0]) == {"id", "world_T_mast", "covariance"}
    assert set(data["stops"][0]["world_T_mast"]) == {"rotation_wxyz", "translation_m"}
    assert np.array(data["stops"][1]["covariance"]).tolist() == np.diag(np.arange(1.0, 7.0)).tolist()
    assert set(data["frames"][0]) == {"id", "pan_rad", "tilt_rad", "sigma_pan_rad", "sigma_tilt_rad"}
    assert data["frames"][0]["pan_rad"] == pytest.approx(0.1001)
    assert set(data["images"][0]) == {"id", "world_T_camera", "rms_px", "observations"}
    assert data["warnings"] == ["a track is seen once"]


def test_a_method_other_than_joint_is_named(tmp_path: Path) -> None:
    write_results(io_samples.solution(method="alternation"), tmp_path / "out")
    assert json.loads((tmp_path / "out" / "solution.json").read_text())["method"] == "alternation"
    assert read_solution_json(tmp_path / "out" / "solution.json").method == "alternation"


def test_solution_json_counts_the_used_observations(tmp_path: Path) -> None:
    solution = io_samples.solution()
    write_results(solution, tmp_path / "out")
    found = read_solution_json(tmp_path / "out" / "solution.json")
    assert found.observations.used + found.observations.rejected == len(solution.used)
    assert found.observations.used == sum(i.observations for i in found.images)
    assert (found.images[0].rms_px, found.images[0].observations) == (None, 0)
    assert found.images[1].rms_px == pytest.approx(0.5)
    assert found.images[1].observations == 1


def test_cameras_are_those_of_a_traverse(tmp_path: Path) -> None:
    solution = io_samples.solution()
    write_results(solution, tmp_path / "out")
    cameras = read_solution_json(tmp_path / "out" / "solution.json").cameras
    assert [c.name for c in cameras] == [e.name for e in solution.traverse.rig.eyes]
    for entry, eye in zip(cameras, solution.traverse.rig.eyes, strict=True):
        assert type(entry.eye("camera").camera) is type(eye.camera)


def test_refined_cameras_and_entries(tmp_path: Path) -> None:
    """Of each eye what all its images agree on; of an eye whose images differ, what the input has."""
    plain = io_samples.solution()
    t = plain.traverse
    n = len(t.images)
    calibration, mount = np.zeros((n, 5)), np.zeros((n, 6))
    calibration[:] = [1.0, 2.0, 0.1, -0.5, 0.25]
    mount[:] = [0.01, -0.02, 0.03, 0.1, 0.2, 0.3]
    calibration[0, 0] = 7.0  # image 0 is of eye 0
    rig = RigCorrection(
        calibration_px=calibration, mount=mount, pan_T_tilt=np.zeros((len(t.stops), 6)), radius_m=np.zeros(n)
    )
    entry = Refined(
        quantity="calibration",
        entry="fx_px",
        camera="brown",
        stop=None,
        image=None,
        nominal=None,
        change=1.0,
        sigma=np.nan,
        prior_sigma=np.inf,
    )
    solution = io_samples.solution(final=replace(plain.final, rig=rig), refined=(entry,))
    write_results(solution, tmp_path / "out")
    found = read_solution_json(tmp_path / "out" / "solution.json")
    [refined] = found.refined
    assert (refined.camera, refined.entry, refined.change) == ("brown", "fx_px", 1.0)
    assert (refined.stop, refined.image, refined.nominal, refined.sigma, refined.prior_sigma) == (None,) * 5
    for i, (camera, eye) in enumerate(zip(found.cameras, t.rig.eyes, strict=True)):
        read = camera.eye("camera")
        change = read.camera.pinhole.calibration_matrix - eye.camera.pinhole.calibration_matrix
        expected = np.array([[1.0, 0.1, -0.5], [0.0, 2.0, 0.25], [0.0, 0.0, 0.0]])
        assert change == pytest.approx(np.zeros((3, 3)) if i == 0 else expected, abs=1e-12)
        between = eye.head_T_camera.between(read.head_T_camera)
        assert gtsam.Rot3.Logmap(between.rotation()) == pytest.approx(mount[0, :3], abs=1e-13)
        assert between.translation() == pytest.approx(mount[0, 3:], abs=1e-13)
        if hasattr(eye.camera, "distortion"):
            assert read.camera.distortion == eye.camera.distortion  # type: ignore[attr-defined]  # a Brown camera


def test_what_is_not_finite_becomes_null(tmp_path: Path) -> None:
    solution = io_samples.solution(cost_final=np.inf, used=np.zeros(60, dtype=bool))
    state = replace(solution.final, world_t_camera=np.full((20, 3), np.nan))
    covariance = np.full((2, 6, 6), np.nan)
    sigma = np.full((4, 2), np.inf)
    bad = replace(solution, final=state, stop_covariance=covariance, angle_sigma_rad=sigma)
    write_results(bad, tmp_path / "out")
    text = (tmp_path / "out" / "solution.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    found = read_solution_json(tmp_path / "out" / "solution.json")
    assert (found.cost.final, found.rms_px.final) == (None, None)
    assert found.images[0].world_T_camera is None
    assert found.stops[0].covariance is None
    assert found.frames[0].sigma_pan_rad is None


def test_warnings_of_reader_and_solver_stand_once(tmp_path: Path) -> None:
    given = replace(io_samples.traverse(), warnings=("from the label", "both"))
    write_results(io_samples.solution(traverse=given, warnings=("both", "solver")), tmp_path / "out")
    assert read_solution_json(tmp_path / "out" / "solution.json").warnings == [
        "from the label",
        "both",
        "solver",
    ]


def test_points_ply(tmp_path: Path) -> None:
    write_results(io_samples.solution(), tmp_path / "out")
    header, points = read_ply(tmp_path / "out" / "points.ply")
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 2" in header
    assert points.dtype.names == ("x", "y", "z", "track", "residual_px", "observations")
    assert points["track"].tolist() == [7, 0]
    assert points["x"].tolist() == [1.0, 5.0]
    np.testing.assert_allclose(points["residual_px"], 0.5, rtol=1e-6)
    assert points["observations"].tolist() == [18, 19]  # of 20 images, less the outliers


def test_points_ply_with_large_track_numbers_and_without_points(tmp_path: Path) -> None:
    write_results(io_samples.solution(landmark_track=np.array([2**40, 2, 0])), tmp_path / "out")
    _, points = read_ply(tmp_path / "out" / "points.ply")
    assert points["track"].tolist() == [2.0**40, 0.0]
    assert np.isnan(points["residual_px"][0])
    nothing = replace(io_samples.solution().final, landmarks_m=np.zeros((0, 3)))
    write_results(
        io_samples.solution(final=nothing, landmark_track=np.zeros(0, dtype=np.int64)), tmp_path / "out"
    )
    assert len(read_ply(tmp_path / "out" / "points.ply")[1]) == 0


def test_points_ply_with_sigmas_and_grey_values(tmp_path: Path) -> None:
    """The worst direction's sigma; the mean grey of used observations; 16 bits scaled to white."""
    made = io_samples.solution()
    sheared = np.array([[5.0, 4.0, 0.0], [4.0, 5.0, 0.0], [0.0, 0.0, 2.0]])  # eigenvalues 9, 2, 1
    covariance = np.stack([0.01 * sheared, np.full((3, 3), np.nan), np.full((3, 3), np.nan)])
    images = list(made.traverse.images)
    width, height = io_samples.SIZE["width_px"], io_samples.SIZE["height_px"]
    for row, level in ((1, 1000), (2, 300), (4, 900)):
        images[row] = replace(images[row], file=f"{row}.png")
        cv2.imwrite(str(tmp_path / f"{row}.png"), np.full((height, width), level, dtype=np.uint16))
    images[3] = replace(images[3], file="lost.png")
    pictured = replace(made.traverse, images=tuple(images), folder=tmp_path)
    write_results(replace(made, traverse=pictured, landmark_covariance_m2=covariance), tmp_path / "out")
    _, points = read_ply(tmp_path / "out" / "points.ply")
    assert points.dtype.names[6:] == ("sigma_m", "red", "green", "blue")
    assert points["sigma_m"][0] == pytest.approx(0.3)
    assert np.isnan(points["sigma_m"][1])
    # White is the median, 900. Track 7 is an outlier in the first: its mean is 600, that of track 0 733.
    assert made.reason[5] == "outlier"
    for colour in ("red", "green", "blue"):
        assert points[colour].tolist() == [170, 208]
    brightness = brightness_of(replace(made, traverse=pictured))
    assert brightness.white == 900.0
    assert brightness.to_8_bits(np.array([450.0]), np.dtype(np.uint16)).tolist() == [128]
    assert brightness.to_8_bits(np.array([77.0]), np.dtype(np.uint8)).tolist() == [77]


def test_residuals_csv(tmp_path: Path) -> None:
    solution = io_samples.solution()
    write_results(solution, tmp_path / "out", csv=True)
    with (tmp_path / "out" / "residuals.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    observations = solution.traverse.observations
    assert observations is not None
    assert len(rows) == len(observations)
    assert rows[4] == {
        "image": "s0f0_brown",
        "track": "2",
        "u_px": f"{observations.uv_px[4, 0]:.10g}",
        "v_px": f"{observations.uv_px[4, 1]:.10g}",
        "sigma_px": "0.3",
        "initial_du_px": "",
        "initial_dv_px": "",
        "final_du_px": "",
        "final_dv_px": "",
        "used": "0",
        "reason": "single",
    }
    assert [rows[3][k] for k in ("final_du_px", "final_dv_px", "used", "reason")] == ["0.3", "-0.4", "1", ""]


def test_residuals_as_arrays_say_what_the_table_says(tmp_path: Path) -> None:
    solution = io_samples.solution()
    write_results(solution, tmp_path / "out", csv=True)
    with (tmp_path / "out" / "residuals.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    with np.load(tmp_path / "out" / "residuals.npz") as found:
        assert [n for n in found.files if not n.endswith("_names")] == [*rows[0]]
        for name in rows[0]:
            cells = [row[name] for row in rows]
            if f"{name}_names" in found:
                assert found[f"{name}_names"][found[name]].tolist() == cells
            else:
                expected = np.array([float(cell or "nan") for cell in cells])
                assert found[name].astype(float) == pytest.approx(expected, rel=1e-9, nan_ok=True)


def test_the_time_of_writing_is_in_the_file_and_in_what_returns(tmp_path: Path) -> None:
    timed = write_results(io_samples.solution().with_seconds(read=1.5), tmp_path / "a" / "b" / "out")
    found = read_solution_json(tmp_path / "a" / "b" / "out" / "solution.json")
    assert found.seconds.read == 1.5
    assert found.seconds.report == timed.seconds.report > 0


def test_an_older_folder_of_results_is_replaced_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()  # an empty folder is as good as none
    write_results(io_samples.solution(), out, csv=True)
    of_all = {"solution.json", "points.ply", "residuals.npz"}
    assert set(contents(out)) == {*of_all, "residuals.csv", "report.html"}
    write_results(io_samples.solution(model="circle"), out, report=False)
    assert set(contents(out)) == of_all
    assert read_solution_json(out / "solution.json").model == "circle"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_an_output_more_is_written_and_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An entry of the registry is enough; without it, the same file is a stranger."""

    def write(written: Written, path: Path) -> Written:
        path.write_text(written.solution.model)
        return written

    note = Output(name="note.txt", when="always", writer=lambda: OutputWriter(write=write))
    with monkeypatch.context() as patch:
        patch.setattr("pancam_graph.results._results.OUTPUTS", (note, *OUTPUTS))
        write_results(io_samples.solution(), tmp_path / "out")
        check_out(tmp_path / "out")
    assert (tmp_path / "out" / "note.txt").read_text() == "mast"
    with pytest.raises(InputError, match=r"found other things in it: note\.txt$"):
        check_out(tmp_path / "out")


def test_exports_are_what_the_registry_has() -> None:
    assert list(EXPORTS) == ["colmap", "cahvor", "rig", "gis"]
    assert all(EXPORTS.values())
    with pytest.raises(InputError, match="export: expected colmap or cahvor or rig or gis, found 'ply'"):
        check_exports(io_samples.traverse(), ["colmap", "ply"])


def test_a_link_keeps_pointing_at_the_results(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to("disk", target_is_directory=True)
    write_results(io_samples.solution(), tmp_path / "out")
    assert (tmp_path / "out").is_symlink()
    assert "solution.json" in contents(tmp_path / "disk")


@pytest.mark.parametrize("older", [True, False])
@pytest.mark.parametrize("error", [RuntimeError("no report"), KeyboardInterrupt()])
def test_an_older_folder_stays_whole_if_the_report_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, older: bool, error: BaseException
) -> None:
    out = tmp_path / "out"
    if older:
        write_results(io_samples.solution(), out)
    before = contents(tmp_path)

    def fail(solution: Solution, path: Path, mosaics: None, terrain: None) -> None:
        path.write_text("half a rep")
        raise error

    monkeypatch.setattr(pancam_graph.report, "write_report", fail)
    with pytest.raises(type(error)):
        write_results(io_samples.solution(model="circle"), out)
    assert contents(tmp_path) == before
    assert len(list(tmp_path.iterdir())) == int(older)


def test_an_older_folder_stays_whole_if_the_renaming_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    write_results(io_samples.solution(), out)
    before = contents(tmp_path)
    rename = Path.rename

    def fail_for_the_new(self: Path, target: Path) -> Path:
        if self.name.endswith("partial"):
            raise OSError(28, "No space left on device")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail_for_the_new)
    with pytest.raises(InputError, match=r"out: expected a place where .* No space left on device"):
        write_results(io_samples.solution(model="circle"), out)
    assert contents(tmp_path) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_out_that_is_not_ours_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(out: Path, found: str) -> None:
        before = contents(tmp_path)
        for attempt in (check_out, lambda o: write_results(io_samples.solution(), o)):
            with pytest.raises(InputError) as caught:
                attempt(out)
            text = str(caught.value)
            assert text.startswith(f"{out}: expected a new folder or one of older results, found ")
            assert found in text
            assert "\n" not in text
        assert contents(tmp_path) == before

    out = tmp_path / "out"
    out.write_text("")
    refuse(out, "a file")
    refuse(out / "below", "a file in its place")
    out.unlink()
    out.mkdir()
    (out / "thesis.tex").write_text("")
    (out / "thoughts.txt").write_text("")
    refuse(out, "other things in it: thesis.tex and 1 more")
    (out / "thesis.tex").unlink()
    (out / "thoughts.txt").rename(out / "points.ply")
    refuse(out, "points.ply but no solution.json")
    (out / "solution.json").write_text('{"format": "other"}')
    refuse(out, "none of ours")
    (out / "solution.json").unlink()
    (out / "solution.json").mkdir()
    refuse(out, "other things in it: solution.json")
    (tmp_path / "link").symlink_to("nothing")
    refuse(tmp_path / "link", "a link that leads nowhere")
    refuse(tmp_path / ("long" * 100), "a path that cannot be used")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    refuse(Path(), "the folder that this program works in")
    monkeypatch.setattr("os.access", lambda *_: False)
    refuse(tmp_path / "new", "no permission to write")


def test_check_out_writes_nothing(tmp_path: Path) -> None:
    check_out(tmp_path / "a" / "b")
    assert not list(tmp_path.iterdir())
