"""A COLMAP workspace: undistorted images, and a text model with rigs and frames (COLMAP 3.12 or later).

The text format is that of COLMAP's documentation, "Output Format". COLMAP has the centre of the first pixel
at (0.5, 0.5), and poses that take points of the world to the camera.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pancam_graph.base.geometry import FloatArray, wxyz_from_rotation
from pancam_graph.cameras import lens_of, without_field
from pancam_graph.data import Solution, rms_px
from pancam_graph.results._brightness import Brightness, brightness_of
from pancam_graph.results._colmap_scene import (
    Placed,
    RigGroup,
    Straight,
    place_observations,
    rigs_and_heads,
    straight_cameras,
)
from pancam_graph.results._exported import file_names, whole_export, write_export_json
from pancam_graph.results._output import OutputWriter, Written
from pancam_graph.results._straight_images import write_straight_images

__all__ = ["COLMAP", "fill_colmap", "write_colmap"]

_LOG = logging.getLogger(__name__)
_FIRST_PIXEL = 0.5
_SOURCE_IMAGES = 20
"""How many other images COLMAP's stereo chooses for each; its own default."""


@dataclass(frozen=True, kw_only=True)
class _Numbers:
    """COLMAP's ids. Those of images, frames and landmarks are their rows, counted from 1."""

    camera: dict[tuple[int, int], int]
    """Camera id by rig and eye."""
    of_image: dict[int, int]
    """Camera id of each image row."""
    name: dict[int, str]
    """Name of each image row."""


def write_colmap(solution: Solution, folder: Path | str) -> None:
    """Write a COLMAP workspace of a solution into the folder `folder`, for dense reconstruction.

    `sparse/` is a text model with cameras, rigs, frames, images and points; every camera is a PINHOLE.
    `images/CAMERA/FRAME.png` are the images, in 8 bits, resampled where the camera is not a pinhole without
    skew: lens and smooth field are taken out of them. `stereo/` is what `colmap patch_match_stereo` starts
    from, and `export.json` says what was done.

    Observations are those used, each carried along its line of sight to the pinhole, so that COLMAP's
    residuals are those of the solution times the enlargement of the image. Points that fit best beyond
    infinity have no place in such a model and are left out. Images whose file is missing have a pose and
    observations too. Whole or not at all: an older export is replaced at the end.

    Raises InputError for a camera of which a pinhole shows nothing, for a folder with anything else in it,
    and where writing fails.
    """
    with whole_export(Path(folder)) as partial:
        fill_colmap(solution, partial, brightness_of(solution))


def fill_colmap(solution: Solution, folder: Path, brightness: Brightness) -> None:
    """Write the files of `write_colmap` into an empty folder."""
    straight = straight_cameras(solution)
    placed = place_observations(solution, straight)
    rigs, heads = rigs_and_heads(solution)
    numbers = _numbers(solution, rigs, heads)
    sparse = folder / "sparse"
    sparse.mkdir()
    for name, lines in (
        ("cameras", _cameras(straight, numbers)),
        ("rigs", _rigs(rigs, numbers)),
        ("frames", _frames(solution, rigs, heads, numbers)),
        ("images", _images(solution, placed, numbers)),
        ("points3D", _points(solution, placed, brightness)),
    ):
        text = "\n".join([f"# {name} of pancam_graph, as COLMAP 3.12 and later read them", *lines, ""])
        (sparse / f"{name}.txt").write_text(text, encoding="utf-8", newline="\n")
    written = write_straight_images(solution, folder / "images", straight, numbers.name, brightness)
    _write_stereo(folder / "stereo", [numbers.name[i] for i in written])
    about = _about(solution, straight, placed, numbers, written, brightness)
    _LOG.info(
        "colmap: %d images, %d of them with pictures, %d points; %d points left out, %d of them because they "
        "fit best beyond infinity",
        len(numbers.of_image),
        len(written),
        about["points"],
        about["points_left_out"],
        about["points_beyond_infinity"],
    )
    write_export_json(folder, "colmap", about)


def _numbers(
    solution: Solution, rigs: list[RigGroup], heads: dict[int, tuple[int, FloatArray, FloatArray]]
) -> _Numbers:
    traverse = solution.traverse
    camera = {
        key: n for n, key in enumerate(((r, e) for r, g in enumerate(rigs) for e in sorted(g.cameras)), 1)
    }
    eyes, frames = (
        file_names([e.name for e in traverse.rig.eyes]),
        file_names([f.id for f in traverse.frames]),
    )
    of_image, name = {}, {}
    for i, (f, e) in enumerate(zip(traverse.image_frame.tolist(), traverse.image_eye.tolist(), strict=True)):
        if f in heads and (heads[f][0], e) in camera and np.isfinite(solution.final.world_t_camera[i]).all():
            of_image[i] = camera[heads[f][0], e]
            name[i] = f"{eyes[e]}/{frames[f]}.png"
    return _Numbers(camera=camera, of_image=of_image, name=name)


# --- the model ---


def _cameras(straight: list[Straight | None], numbers: _Numbers) -> Iterable[str]:
    """CAMERA_ID MODEL WIDTH HEIGHT fx fy cx cy."""
    of_camera = {camera: straight[i] for i, camera in numbers.of_image.items()}
    for number, s in sorted(of_camera.items()):
        assert s is not None  # the image is numbered, so its pose is finite
        p = s.pinhole
        first = np.array([p.fx_px, p.fy_px, p.cx_px + _FIRST_PIXEL, p.cy_px + _FIRST_PIXEL])
        yield f"{number} PINHOLE {p.width_px} {p.height_px} {_row(first)}"


def _rigs(rigs: list[RigGroup], numbers: _Numbers) -> Iterable[str]:
    """RIG_ID NUM_SENSORS REF_TYPE REF_ID, then of each other sensor TYPE ID HAS_POSE sensor_from_rig."""
    for r, rig in enumerate(rigs):
        reference, *others = sorted(rig.cameras)
        words = [f"{r + 1} {len(rig.cameras)} CAMERA {numbers.camera[r, reference]}"]
        head_R_rig, head_t_rig = rig.head_T_camera[reference]
        for eye in others:
            R, t = rig.head_T_camera[eye]
            sensor_from_rig = _pose(R.T @ head_R_rig, R.T @ (head_t_rig - t))
            words.append(f"CAMERA {numbers.camera[r, eye]} 1 {sensor_from_rig}")
        yield " ".join(words)


def _frames(
    solution: Solution,
    rigs: list[RigGroup],
    heads: dict[int, tuple[int, FloatArray, FloatArray]],
    numbers: _Numbers,
) -> Iterable[str]:
    """FRAME_ID RIG_ID rig_from_world NUM_DATA, then of each image TYPE SENSOR_ID IMAGE_ID."""
    of_frame: dict[int, list[int]] = {}
    for i in numbers.of_image:
        of_frame.setdefault(int(solution.traverse.image_frame[i]), []).append(i)
    for f, (r, head_R, head_t) in heads.items():
        mount_R, mount_t = rigs[r].head_T_camera[min(rigs[r].cameras)]
        rig_from_world = _inverse(head_R @ mount_R, head_R @ mount_t + head_t)
        data = " ".join(f"CAMERA {numbers.of_image[i]} {i + 1}" for i in of_frame[f])
        yield f"{f + 1} {r + 1} {rig_from_world} {len(of_frame[f])} {data}"


def _images(solution: Solution, placed: Placed, numbers: _Numbers) -> Iterable[str]:
    """IMAGE_ID cam_from_world CAMERA_ID NAME, and a line of X Y POINT3D_ID of each observation."""
    final = solution.final
    limits = np.searchsorted(placed.image, np.arange(len(solution.traverse.images) + 1))
    for i, camera in numbers.of_image.items():
        rows = slice(limits[i], limits[i + 1])
        pose = _inverse(final.world_R_camera[i], final.world_t_camera[i])
        yield f"{i + 1} {pose} {camera} {numbers.name[i]}"
        pixels = (placed.uv_px[rows] + _FIRST_PIXEL).tolist()
        yield " ".join(
            f"{u!r} {v!r} {j + 1}" for (u, v), j in zip(pixels, placed.landmark[rows].tolist(), strict=True)
        )


def _points(solution: Solution, placed: Placed, brightness: Brightness) -> Iterable[str]:
    """POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX of each observation."""
    points, grey = solution.final.landmarks_m, brightness.grey
    first = np.searchsorted(
        placed.image, placed.image
    )  # first row of the image: the difference counts within the image
    within = np.arange(len(placed.image)) - first
    order = np.argsort(placed.landmark, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(placed.landmark[order])) + 1):
        if len(rows) == 0:  # there is no observation
            return
        j = int(placed.landmark[rows[0]])
        shade = 128 if grey is None else int(grey[j])
        error = float(np.mean(np.linalg.norm(placed.residual_px[rows], axis=1)))
        track = " ".join(f"{placed.image[k] + 1} {within[k]}" for k in rows)
        yield f"{j + 1} {_row(points[j])} {shade} {shade} {shade} {error!r} {track}"


def _row(values: FloatArray) -> str:
    """Numbers with all their digits."""
    return " ".join(map(repr, values.tolist()))


def _pose(rotation: FloatArray, translation: FloatArray) -> str:
    return f"{_row(wxyz_from_rotation(rotation))} {_row(translation)}"


def _inverse(rotation: FloatArray, translation: FloatArray) -> str:
    return _pose(rotation.T, -rotation.T @ translation)


def _write_stereo(folder: Path, names: list[str]) -> None:
    """Write the folders and lists that COLMAP's dense stereo expects beside images and model."""
    for maps in ("depth_maps", "normal_maps", "consistency_graphs"):
        for parent in {Path(name).parent for name in names} or {Path()}:
            (folder / maps / parent).mkdir(parents=True)
    sources = "".join(f"{name}\n__auto__, {_SOURCE_IMAGES}\n" for name in names)
    (folder / "patch-match.cfg").write_text(sources, encoding="utf-8", newline="\n")
    (folder / "fusion.cfg").write_text("".join(f"{n}\n" for n in names), encoding="utf-8", newline="\n")


def _about(
    solution: Solution,
    straight: list[Straight | None],
    placed: Placed,
    numbers: _Numbers,
    written: list[int],
    brightness: Brightness,
) -> dict[str, object]:
    """The content of `export.json`."""
    length = np.linalg.norm(placed.residual_px, axis=1)
    landmarks = len(solution.landmark_track)
    views = np.bincount(placed.landmark, minlength=landmarks)
    of_point = np.bincount(placed.landmark, weights=length, minlength=landmarks)[views > 0] / views[views > 0]
    first = {camera: i for i, camera in sorted(numbers.of_image.items(), reverse=True)}
    cameras = []
    for number, i in sorted(first.items()):
        s = straight[i]
        assert s is not None  # the image is numbered, so its pose is finite
        of_camera = np.isin(placed.image, [j for j, c in numbers.of_image.items() if c == number])
        moving = s.camera.pupil_moves
        cameras.append(
            {
                "camera_id": number,
                "camera": solution.traverse.images[i].camera,
                "model": lens_of(without_field(s.camera)).name,
                "range_m": s.range_m if moving else None,
                "largest_shift_px": float(placed.shift_px[of_camera].max(initial=0.0)) if moving else 0.0,
            }
        )
    images, kept = solution.traverse.images, set(written)
    return {
        "observations": len(placed.row),
        "points": len(of_point),
        "points_left_out": int(np.isfinite(solution.final.landmarks_m).all(axis=1).sum()) - len(of_point),
        "points_beyond_infinity": placed.beyond,
        "mean_reprojection_error_px": float(np.mean(of_point)) if len(of_point) else None,
        "rms_px": rms_px(placed.residual_px),
        "rms_raw_px": rms_px(solution.residual_final_px[placed.row]),
        "white": brightness.white,
        "cameras": cameras,
        "images": [
            {"id": images[i].id, "image_id": i + 1, "name": name, "written": i in kept}
            for i, name in numbers.name.items()
        ],
    }


def _write(written: Written, folder: Path) -> Written:
    fill_colmap(written.solution, folder, written.brightness)
    return written


COLMAP = OutputWriter(write=_write)
