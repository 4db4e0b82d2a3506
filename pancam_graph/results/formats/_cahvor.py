"""CAHV, CAHVOR and CAHVORE cameras as text."""

from pathlib import Path

from pancam_graph.results._camera_models import fill_cameras
from pancam_graph.results._left_out_field import field_left_out
from pancam_graph.results.formats._source import Source

__all__ = ["write_cahvor"]


def write_cahvor(source: Source, folder: Path) -> None:
    """Write `IMAGE.cahvor` of each image into an empty folder, as `results.write_cameras` does."""
    fill_cameras(source.solution, folder)
    lost = field_left_out(source.solution)
    if lost:
        each = "; ".join(f"{name}: up to {px['max_px']:.2g} px" for name, px in lost.items())
        source.warnings.append(f"cahvor: files cannot hold the smooth fields of cameras, left out: {each}")
