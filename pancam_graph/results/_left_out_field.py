"""What exports without smooth distortion fields leave out of a solution's cameras."""

from dataclasses import replace

import numpy as np

from pancam_graph.cameras import Camera, FieldCamera
from pancam_graph.data import Solution
from pancam_graph.results._output import Written

__all__ = ["field_left_out", "left_out_px", "warned_of_field"]

_ACROSS = 65


def left_out_px(camera: Camera) -> dict[str, float] | None:
    """Largest length and RMS of a camera's smooth field over its image, pixels; None where it has none."""
    if not isinstance(camera, FieldCamera):
        return None
    u, v = (np.linspace(-0.5, n - 0.5, _ACROSS) for n in (camera.width_px, camera.height_px))
    field, _ = camera.at(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    length = np.linalg.norm(field, axis=1)
    return {"max_px": float(length.max()), "rms_px": float(np.sqrt(np.mean(length**2)))}


def field_left_out(solution: Solution) -> dict[str, dict[str, float]]:
    """`left_out_px` of each eye of the adjusted rig that has a field, by its name."""
    found = ((eye.name, left_out_px(eye.camera)) for eye in solution.rig.eyes)
    return {name: lost for name, lost in found if lost is not None}


def warned_of_field(written: Written, export: str) -> Written:
    """With a warning of what an export of `.cahvor` files leaves out, if it leaves out anything."""
    lost = field_left_out(written.solution)
    if not lost:
        return written
    each = "; ".join(f"{name}: {px['max_px']:.2g} px, RMS {px['rms_px']:.2g} px" for name, px in lost.items())
    warning = (
        f"{export}: .cahvor files cannot hold the smooth fields of cameras, which are left out: up to {each}"
    )
    return replace(
        written, solution=replace(written.solution, warnings=(*written.solution.warnings, warning))
    )
