"""What Bundler and NVM can say of a solution: square pinholes about the middle of their images."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.cameras import Pinhole
from pancam_graph.results._brightness import Brightness, brightness_of
from pancam_graph.results._colmap_scene import Placed, Straight, place_observations, straight_cameras
from pancam_graph.results._exported import file_names, write_export_json
from pancam_graph.results._straight_images import write_straight_images
from pancam_graph.results.formats._source import Source

__all__ = ["Centred", "centred"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Centred:
    """A solution with images resampled to square pinholes about the middle of the image."""

    source: Source
    rows: list[int]
    """Rows of the images that have a finite pose, in the order of their numbers in the file."""
    names: list[str]
    """Path of each of these images in the folder."""
    cameras: list[Straight]
    placed: Placed
    number: IntArray
    """(images,) place of each image of the traverse among `rows`; -1: none."""
    brightness: Brightness

    def pose(self, row: int) -> tuple[FloatArray, FloatArray]:
        """`camera_R_world` (3, 3) and the centre (3,) of an image."""
        final = self.source.solution.final
        return final.world_R_camera[row].T, final.world_t_camera[row]

    def points(self) -> list[tuple[int, IntArray]]:
        """Landmark row, and rows of `placed` that see it, of each point."""
        order = np.argsort(self.placed.landmark, kind="stable")
        parts = np.split(order, np.flatnonzero(np.diff(self.placed.landmark[order])) + 1)
        return [(int(self.placed.landmark[rows[0]]), rows) for rows in parts if len(rows)]

    def from_middle_px(self) -> FloatArray:
        """(m, 2) pixels of `placed` from the middle of their images, u to the right, v down."""
        middle = np.array([[c.pinhole.cx_px, c.pinhole.cy_px] for c in self.cameras]).reshape(-1, 2)
        return np.asarray(self.placed.uv_px - middle[self.number[self.placed.image]])

    def shade(self, landmark: int) -> int:
        """Grey of a landmark, 0 to 255."""
        grey = self.brightness.grey
        return 128 if grey is None else int(grey[landmark])

    def write(self, folder: Path, kind: str, files: dict[str, str]) -> None:
        """Write the images, these text files, and `export.json`."""
        solution = self.source.solution
        names = {row: name.removeprefix("images/") for row, name in zip(self.rows, self.names, strict=True)}
        of_row = dict(zip(self.rows, self.cameras, strict=True))
        every = [of_row.get(row) for row in range(len(solution.traverse.images))]
        written = set(write_straight_images(solution, folder / "images", every, names, self.brightness))
        if len(written) < len(names):
            none = "no file of an image" if not written else f"files of {len(written)} of {len(names)} images"
            self.source.warnings.append(f"{kind}: {none} can be read; the others are named and not written")
        if not self.source.is_solved:
            self.source.warnings.append(f"{kind}: a drive as telemetry has it has no points: refine it first")
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8", newline="\n")
        images = solution.traverse.images
        listed = [
            {
                "id": images[row].id,
                "file": name,
                "width_px": camera.pinhole.width_px,
                "height_px": camera.pinhole.height_px,
                "range_m": camera.range_m if camera.camera.pupil_moves else None,
                "written": row in written,
            }
            for row, name, camera in zip(self.rows, self.names, self.cameras, strict=True)
        ]
        write_export_json(folder, kind, {"images": listed, "points_beyond_infinity": self.placed.beyond})


def centred(source: Source) -> Centred:
    """A source with its images resampled to square pinholes about the middle of the image.

    Observations are carried along their lines of sight. Raises InputError as `straight_cameras` does.
    """
    solution = source.solution
    made: dict[int, Straight] = {}
    straight: list[Straight | None] = []
    for s in straight_cameras(solution):
        if s is not None and id(s) not in made:
            made[id(s)] = replace(s, pinhole=_about_middle(s.pinhole))
        straight.append(None if s is None else made[id(s)])
    rows = [row for row, s in enumerate(straight) if s is not None]
    number = np.full(len(straight), -1)
    number[rows] = np.arange(len(rows))
    ids = file_names([solution.traverse.images[row].id for row in rows])
    return Centred(
        source=source,
        rows=rows,
        names=[f"images/{name}.png" for name in ids],
        cameras=[s for s in straight if s is not None],
        placed=place_observations(solution, straight),
        number=number,
        brightness=brightness_of(solution),
    )


def _about_middle(pinhole: Pinhole) -> Pinhole:
    """A square pinhole of the same axes, large enough for all pixels of another, its middle on the axis."""
    scale = pinhole.fx_px / pinhole.fy_px

    def side(centre: float, n: int, factor: float) -> int:
        return 2 * math.ceil(factor * max(centre, n - 1 - centre) - 1e-6) + 1

    width = side(pinhole.cx_px, pinhole.width_px, 1.0)
    height = side(pinhole.cy_px, pinhole.height_px, scale)
    return Pinhole(
        width_px=width,
        height_px=height,
        fx_px=pinhole.fx_px,
        fy_px=pinhole.fx_px,
        cx_px=(width - 1) / 2,
        cy_px=(height - 1) / 2,
    )
