"""Folders of labelled pictures, from labels to refined pointing: rendered pictures with labels made for them.

Labels are real ones with their fields changed. What this does not prove: that labels of other images name
their fields as these do.
"""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pancam_graph import RenderOptions, SolveOptions, find_observations, read_input, render, solve
from pancam_graph.base.geometry import FloatArray
from pancam_graph.io._template_cameras import subframed
from pancam_graph.rigs import MARS2020_MAST, Eye, mars2020_navcam
from pancam_graph.simulate import Rendering
from support.pds4_labels import pds4_text, real_text, write_pds4
from support.rover_labels import Shot, mars2020_mast, turned

pytestmark = pytest.mark.slow

FRAMES = 4


@pytest.fixture(scope="module")
def rendering() -> Rendering:
    """A left Navcam of Perseverance at an eighth of its size, four pointings of one position."""
    rig = mars2020_navcam()
    head_model = subframed(rig.eyes[0].head_model(), 640, 480, binned=8)
    small = replace(rig, eyes=(Eye.from_head_model("navcam-left", head_model),))
    options = RenderOptions(stops=1, pans=FRAMES, sweep_rad=np.deg2rad(120), tilts_rad=(-0.3,))
    return render(small, options, seed=5)


def shots(rendering: Rendering) -> list[Shot]:
    """What labels say: the telemetry of the rendering, with its errors."""
    eye, frames = rendering.traverse.rig.eyes[0], rendering.traverse.frames
    document = eye.head_model().transformed(MARS2020_MAST.head_T_document().inverse())
    home = MARS2020_MAST.home_azimuth_rad, MARS2020_MAST.home_elevation_rad
    return [
        Shot(
            head=document,
            joints=(home[0] - frame.pan_rad, home[1] + frame.tilt_rad),
            instrument="NAVCAM_LEFT",
            counter=(30, 1344, k),
        )
        for k, frame in enumerate(frames)
    ]


def relative_error_rad(found: FloatArray, truth: FloatArray) -> FloatArray:
    error = found - truth
    return np.asarray(np.sqrt(np.mean((error - error.mean(axis=0)) ** 2, axis=0)))


def check(folder: Path, rendering: Rendering) -> None:
    """Pan and tilt come from the labels as telemetry has them, and from the solution nearer to the truth."""
    traverse = read_input(folder)
    assert len(traverse.frames) == FRAMES
    truth = rendering.truth.pan_tilt_rad
    told = np.array([[f.pan_rad, f.tilt_rad] for f in rendering.traverse.frames])
    read = np.array([[f.pan_rad, f.tilt_rad] for f in traverse.frames])
    assert (relative_error_rad(read, told) < 5e-5).all()
    solution = solve(find_observations(traverse), SolveOptions())
    assert solution.verdict is not None
    assert solution.verdict.passed
    assert (
        relative_error_rad(solution.final.pan_tilt_rad, truth) < 0.5 * relative_error_rad(told, truth)
    ).all()


def test_pictures_with_pds4_labels_are_solved(
    pds4_folder: Path, rendering: Rendering, tmp_path: Path
) -> None:
    real, mast = real_text(pds4_folder), mars2020_mast(as_designed=True)
    for k, shot in enumerate(shots(rendering)):
        text = pds4_text(real, f"NLF_{k}", shot, mast, clock=f"72278278{k}.631")
        write_pds4(tmp_path, f"NLF_{k}", text, rendering.image(k).tobytes())
    check(tmp_path, rendering)


def test_pictures_of_the_feed_are_solved(feed_folder: Path, rendering: Rendering, tmp_path: Path) -> None:
    (real,) = feed_folder.glob("*.json")
    record = json.loads(real.read_text())
    for k, shot in enumerate(shots(rendering)):
        model = turned(shot.head, *mars2020_mast(as_designed=True).head(*shot.joints))
        vectors = [f"({','.join(repr(float(v)) for v in getattr(model, letter))})" for letter in "CAHVORE"]
        name = f"NLF_0670_07264214{k:02d}_362ECM_N0320604NCAM08111_01_095J"
        changes = {
            "imageid": name,
            "link": f"https://mars.nasa.gov/{name}01.png",
            "dimension": "(640,480)",
            "camera_model_component_list": ";".join([*vectors, "3", "0.37"]),
            "mast_az": np.rad2deg(shot.joints[0] - MARS2020_MAST.home_azimuth_rad),
            "mast_el": np.rad2deg(shot.joints[1] - MARS2020_MAST.home_elevation_rad),
        }
        (tmp_path / f"{name}01-metadata.json").write_text(json.dumps(record | changes))
        cv2.imwrite(str(tmp_path / f"{name}01.png"), rendering.image(k))
    check(tmp_path, rendering)
