"""What a solution says of its rig: in solution.json, and as an export that another run reads."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph import (
    Freedom,
    Sharing,
    SimulationOptions,
    SolveOptions,
    Traverse,
    simulate,
    solve,
    write_results,
)
from pancam_graph.base.errors import InputError
from pancam_graph.cameras import FieldCamera
from pancam_graph.data import RigTreatment, State
from pancam_graph.io import read_cahvor, read_pds, read_rig, use_rig
from pancam_graph.results._rig import rover_models
from pancam_graph.results._solution_json import solution_json
from pancam_graph.rigs import mer_navcam
from support import io_samples


def drive() -> Traverse:
    options = SimulationOptions(stops=1, pans=3, points_per_image=30)
    return simulate(mer_navcam(), options, seed=1).traverse


def test_solution_json_says_what_became_of_the_rig() -> None:
    traverse = drive()
    found = {}
    treatments: tuple[RigTreatment, ...] = ("estimated", "held", "considered")
    for rig in treatments:
        found[rig] = json.loads(solution_json(solve(traverse, SolveOptions(rig=rig))))
        assert found[rig]["rig"]["treatment"] == rig
    (flex,) = found["estimated"]["rig"]["flex"]
    twists = {frame["id"]: frame["flex"]["twist_rad"] for frame in found["estimated"]["frames"]}
    assert flex["entry"] == "twist_rad"
    assert flex["sigma"] == traverse.rig.uncertainty.flex_rad
    assert flex["rms"] == pytest.approx(np.sqrt(np.mean(np.square(list(twists.values())))))
    assert abs(flex["largest"]) == max(abs(twist) for twist in twists.values())
    assert twists[flex["frame"]] == flex["largest"]
    assert found["considered"]["rig"]["flex"][0]["sigma"] == flex["sigma"]
    assert found["held"]["rig"]["flex"] == []
    assert all("flex" not in frame for frame in found["held"]["frames"])
    # What a sharing of the user's frees is estimated, though not within the rig's own uncertainty.
    chosen = SolveOptions(sharing=Sharing(calibration=Freedom(scope="eye", free=("focal",))))
    assert json.loads(solution_json(solve(traverse, chosen)))["rig"] == {"treatment": "estimated", "flex": []}


def test_the_rig_is_an_export_that_another_run_reads(tmp_path: Path) -> None:
    traverse = drive()
    solution = solve(traverse)
    for _ in range(2):  # an older one is replaced
        write_results(solution, tmp_path / "out", exports=["rig"])
    folder = tmp_path / "out/rig"
    assert {p.name for p in folder.iterdir()} == {"export.json", "rig.json", "left.cahvor", "right.cahvor"}
    rig, joint = read_rig(folder / "rig.json"), solution.rig_covariance
    assert rig.uncertainty.covariance is not None
    assert joint is not None
    np.testing.assert_array_equal(rig.uncertainty.covariance.matrix, joint.matrix)
    for i, eye in enumerate(solution.rig.eyes):
        model = read_cahvor(folder / f"{eye.name}.cahvor")
        R, t = solution.rig.mast_T_camera(np.zeros((1, 2)), np.array([i]))
        point = R[0] @ np.array([0.3, -0.2, 5.0]) + t[0]
        expected, _ = eye.camera.project(np.array([[0.3, -0.2, 5.0]]))
        np.testing.assert_allclose(model.project(point[None])[0], expected, atol=1e-8)
    with pytest.raises(InputError, match="expected others than those that the rig was calibrated with"):
        use_rig(traverse, folder / "rig.json")


def test_smooth_fields_are_in_the_rig_and_said_to_be_missing_elsewhere(tmp_path: Path) -> None:
    solution = solve(drive(), SolveOptions(field=True))
    written = write_results(solution, tmp_path / "out", report=False, exports=["rig", "cahvor", "colmap"])
    rig, joint = read_rig(tmp_path / "out/rig/rig.json"), solution.rig_covariance
    assert rig.uncertainty.covariance is not None and joint is not None
    assert [e for e in joint.entries if e.quantity == "field"] != []
    np.testing.assert_array_equal(rig.uncertainty.covariance.matrix, joint.matrix)
    for eye, other in zip(rig.eyes, solution.rig.eyes, strict=True):
        assert isinstance(eye.camera, FieldCamera) and isinstance(other.camera, FieldCamera)
        np.testing.assert_array_equal(eye.camera.field_px, other.camera.field_px)
    said = [w for w in written.warnings if "cannot hold the smooth fields" in w]
    assert len(said) == 2
    lost = json.loads((tmp_path / "out/cahvor/export.json").read_text())["field_left_out"]
    pixels = np.random.default_rng(0).uniform(0, 1023, (5000, 2))
    for eye in solution.rig.eyes:
        assert isinstance(eye.camera, FieldCamera)
        length = np.linalg.norm(eye.camera.at(pixels)[0], axis=1)
        assert lost[eye.name]["max_px"] >= 0.98 * length.max()
        assert lost[eye.name]["rms_px"] == pytest.approx(np.sqrt(np.mean(length**2)), rel=0.1)
    # COLMAP's pinholes see the straightened observations as the solution sees the raw ones.
    about = json.loads((tmp_path / "out/colmap/export.json").read_text())
    assert about["rms_px"] == pytest.approx(about["rms_raw_px"], rel=0.02)


def test_cameras_in_the_rover_frame_are_those_of_labels_where_nothing_moved(opportunity_folder: Path) -> None:
    traverse = read_pds(opportunity_folder)
    R, t = traverse.camera_poses()
    state = State(
        world_T_mast=tuple(s.world_T_mast for s in traverse.stops),
        pan_tilt_rad=traverse.pan_tilt_rad,
        world_R_camera=R,
        world_t_camera=t,
        landmarks_m=np.zeros((0, 3)),
    )
    models = rover_models(replace(io_samples.solution(), traverse=traverse, final=state))
    first = models[0]
    assert first is not None
    # MODEL_COMPONENT_1 to 6 of the label of 1N491020376: its axes are written to six digits.
    np.testing.assert_allclose(first.C, [0.442604, -0.0611635, -1.25106], atol=5e-6)
    np.testing.assert_allclose(first.A, [0.93995, -0.338133, 0.0464979], atol=5e-6)
    np.testing.assert_allclose(first.H, [884.72, 981.763, 24.1472], atol=0.01)
    np.testing.assert_allclose(first.V, [418.579, -152.039, 1245.75], atol=0.01)
