"""Pinholes of the Ames Stereo Pipeline: `.tsai`, one an image.

Source: the pipeline's documentation, "Frame camera models". Its pixels have the centre of the first at (0,
0), R takes the camera's directions (x along columns, y along rows, z forward) to the world, TSAI is Brown's
distortion as OpenCV has it, of normalised pixels.
"""

from pathlib import Path

from pancam_graph.cameras import Brown
from pancam_graph.results.formats._one_an_image import write_brown_cameras
from pancam_graph.results.formats._source import Source, row_text

__all__ = ["write_tsai"]


def write_tsai(source: Source, folder: Path) -> None:
    """Write `IMAGE.tsai` of each image into an empty folder; see `write_brown_cameras`."""
    write_brown_cameras(source, folder, "tsai", ".tsai", _text, skew=False)


def _text(source: Source, image: int, lens: Brown) -> str:
    pose = source.body_T_camera(image)
    lines = [
        "VERSION_4",
        "PINHOLE",
        f"fu = {lens.fx_px!r}",
        f"fv = {lens.fy_px!r}",
        f"cu = {lens.cx_px!r}",
        f"cv = {lens.cy_px!r}",
        "u_direction = 1 0 0",
        "v_direction = 0 1 0",
        "w_direction = 0 0 1",
        f"C = {row_text(pose.translation())}",
        f"R = {row_text(pose.rotation().matrix())}",
        "pitch = 1.0",
    ]
    if any(lens.distortion):
        names = ("k1", "k2", "p1", "p2", "k3")
        lines += ["TSAI", *(f"{n} = {value!r}" for n, value in zip(names, lens.distortion, strict=True))]
    else:
        lines.append("NULL")
    return "\n".join([*lines, ""])
