"""Fit of a rig: what cannot be fitted is said in one sentence."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.rigs import (
    ReferenceSigma,
    RigFitOptions,
    fit_rig,
)
from support.published_cameras import MODEL_B
from support.rig_cameras import NAVCAM, angles_of, cameras_of

POSES = cameras_of(NAVCAM, angles_of(4), ["left"] * 4)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"cameras": []}, "cameras: expected 2 or more, found 0"),
        ({"cameras": POSES[:1], "pan_tilt_rad": np.zeros((1, 2))}, "cameras: expected 2 or more, found 1"),
        ({"pan_tilt_rad": np.zeros((3, 2))}, r"pan_tilt_rad: expected shape \(4, 2\), found \(3, 2\)"),
        ({"pan_tilt_rad": np.zeros((2, 4))}, r"pan_tilt_rad: expected shape \(4, 2\), found \(2, 4\)"),
        (
            {"pan_tilt_rad": np.full((4, 2), np.nan)},
            r"pan_tilt_rad, row 0: expected finite angles, found \[nan, nan\]",
        ),
        ({"eyes": ["left"] * 3}, "eyes: expected 4 names, one per camera, found 3"),
        ({"pointings": [0]}, "pointings: expected 4 numbers, one per camera, found 1"),
        ({"eyes": ["up"] * 4, "reference": NAVCAM}, "camera 'up': the rig msl-navcam has left, right"),
        (
            {"reference": NAVCAM, "pan_T_tilt": gtsam.Pose3(), "eyes": ["left"] * 4},
            "pan_T_tilt: expected none beside a reference rig, which has one; found one",
        ),
        (
            {"cameras": [*POSES[:3], gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0, 0]))]},
            r"cameras\[3\]: expected a pose of finite numbers, found .*nan",
        ),
        (
            {"cameras": [*POSES[:3], gtsam.Pose3(gtsam.Rot3(), np.array([1e300, 0, 0]))]},
            r"cameras\[3\]: expected a pose of finite numbers, found .*1e\+300",
        ),
        (
            {"cameras": [*POSES[:3], MODEL_B]},
            r"cameras\[3\]: expected a pose like the others of eye camera, found a CAHVOR of 1024 x 1024",
        ),
        (
            {"cameras": [MODEL_B, MODEL_B, replace(MODEL_B, width_px=512), MODEL_B]},
            r"cameras\[2\]: expected a CAHVOR of 1024 x 1024 like the others of eye camera, found .* 512 x",
        ),
    ],
)
def test_what_cannot_be_fitted_is_said_in_one_sentence(arguments: dict[str, object], sentence: str) -> None:
    given: dict[str, object] = {"cameras": POSES, "pan_tilt_rad": np.zeros((len(POSES), 2))}
    given |= arguments
    if given["cameras"] == []:
        given["pan_tilt_rad"] = np.zeros((0, 2))
    with pytest.raises(InputError, match=sentence) as caught:
        fit_rig(**given)  # type: ignore[arg-type]  # what a type checker would refuse too
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: RigFitOptions(angles="about right"),  # type: ignore[arg-type]  # the mistake under test
            "angles: expected exact, offsets or free; found 'about",
        ),
        (lambda: RigFitOptions(centre_sigma_m=0.0), "centre_sigma_m: expected a number above 0, found 0.0"),
        (lambda: RigFitOptions(angle_sigma_rad=float("nan")), "angle_sigma_rad: expected a number above 0"),
        (
            lambda: RigFitOptions(reference_sigma=ReferenceSigma(axis_m=-1.0)),
            r"reference_sigma: axis_m: expected 0 \(held\) or above, found -1.0",
        ),
    ],
)
def test_options_of_nonsense_are_refused(make: Callable[[], RigFitOptions], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make()
