"""Cameras of templates, for labels without a camera or without the turn of the head."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHV
from pancam_graph.rigs import Eye, rig_template

__all__ = ["pan_tilt_of_camera", "subframed", "template_eye"]

_TEMPLATES = {
    "M20": {"NAVCAM": "mars2020-navcam", "NAV_": "mars2020-navcam", "MCZ": "mars2020-mastcam-z-34mm"},
    "MSL": {"NAV": "msl-navcam", "MAST": "msl-mastcam"},
}
"""By rover, and by how the name of a camera begins. A Mastcam-Z hardly turns on the head as it zooms."""


def template_eye(host: str, instrument: str) -> Eye | None:
    """The eye of a template that stands for a camera of a rover; None where no template has it."""
    named = _TEMPLATES.get(host, {})
    template = next((name for start, name in named.items() if instrument.startswith(start)), None)
    if template is None:
        return None
    side = "right" if "RIGHT" in instrument else "left"
    return next((eye for eye in _eyes(template) if eye.name.endswith(side)), None)


@lru_cache(maxsize=8)
def _eyes(template: str) -> tuple[Eye, ...]:
    return rig_template(template).eyes


def pan_tilt_of_camera(model: CAHV, eye: Eye, rover_R_mast: FloatArray) -> tuple[float, float]:
    """Pan and tilt at which the camera of an eye looks as a model in the rover frame (z up) does, radians.

    The axes are taken as meeting at right angles; a roll that no pointing explains is left out.
    """
    _, rover_T_camera = model.split()
    head_R_camera = eye.head_model().split()[1].rotation().matrix()
    forward = (rover_R_mast.T @ rover_T_camera.rotation().matrix() @ head_R_camera.T)[:, 0]
    return float(np.arctan2(forward[1], forward[0])), float(np.arcsin(np.clip(forward[2], -1.0, 1.0)))


def subframed(
    model: CAHV, width_px: int, height_px: int, *, binned: int = 1, left_px: float = 0.0, top_px: float = 0.0
) -> CAHV:
    """The camera of a part of a picture whose pixels are `binned` x `binned` pixels of the model's.

    `left_px` and `top_px` are pixels of the binned picture that are left of and above the part.
    """
    return replace(
        model,
        width_px=width_px,
        height_px=height_px,
        H=(model.H + 0.5 * model.A) / binned - (0.5 + left_px) * model.A,
        V=(model.V + 0.5 * model.A) / binned - (0.5 + top_px) * model.A,
    )
