"""Tables of all results, with sigmas: CSV or Parquet, a table a kind of thing."""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pancam_graph.base.extras import needed
from pancam_graph.base.geometry import FloatArray, wxyz_from_rotation
from pancam_graph.base.text import table_cell
from pancam_graph.data import rms_px
from pancam_graph.results._exported import write_export_json
from pancam_graph.results.formats._source import Source

__all__ = ["write_parquet", "write_tables"]

_POSE = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
_PLACE = ("latitude_deg", "longitude_deg", "height_m")
_TANGENT = ("rx_rad", "ry_rad", "rz_rad", "x_m", "y_m", "z_m")


def write_tables(source: Source, folder: Path) -> None:
    """Write `stops.csv`, `frames.csv`, `images.csv`, `points.csv`, `observations.csv` and `rig.csv`.

    Numbers have all digits, a cell is empty where one is not known. Poses are of the mast and of the camera
    in the world; sigmas of a stop are of its tangent, in mast axes.
    """
    for name, table in _tables(source):
        (folder / f"{name}.csv").write_bytes(_csv(*table))
    write_export_json(folder, "tables", {"frame": "world"})


def write_parquet(source: Source, folder: Path) -> None:
    """Write the tables of `write_tables` as Parquet: text, whole numbers and doubles, null where not known.

    Raises InputError without the package of the extra `parquet`.
    """
    arrow, parquet = needed("pyarrow", "parquet"), needed("pyarrow.parquet", "parquet")
    for name, (header, rows) in _tables(source):
        columns = zip(*rows, strict=True)
        cells = [list(column) for column in columns] or [[] for _ in header]
        table = {title: _arrow(arrow, column) for title, column in zip(header, cells, strict=True)}
        parquet.write_table(arrow.table(table), folder / f"{name}.parquet")
    write_export_json(folder, "parquet", {"frame": "world"})


def _arrow(arrow: Any, column: list[object]) -> Any:
    """A column as Parquet has it; of no rows one of doubles."""
    if any(isinstance(value, str) for value in column):
        return arrow.array([str(value) or None for value in column], type=arrow.string())
    if column and all(isinstance(value, int | np.integer) for value in column):
        return arrow.array(column, type=arrow.int64())
    return arrow.array(column, type=arrow.float64(), from_pandas=True)


_Table = tuple[Sequence[str], Iterable[Sequence[object]]]


def _tables(source: Source) -> Iterator[tuple[str, _Table]]:
    yield "stops", _stops(source)
    yield "frames", _frames(source)
    yield "images", _images(source)
    yield "points", _points(source)
    yield "observations", _observations(source)
    yield "rig", _rig(source)


def _stops(source: Source) -> _Table:
    solution = source.solution
    site = solution.traverse.site
    rows = []
    for stop, pose, covariance in zip(
        solution.traverse.stops, solution.final.world_T_mast, solution.stop_covariance, strict=True
    ):
        place = [] if site is None else site.geographic(pose.translation()[None])[0].tolist()
        sigmas = np.sqrt(np.diag(covariance)).tolist()
        rows.append([stop.id, *_pose(pose.rotation().matrix(), pose.translation()), *sigmas, *place])
    header = ["stop", *_POSE, *(f"sigma_{name}" for name in _TANGENT), *(() if site is None else _PLACE)]
    return header, rows


def _frames(source: Source) -> _Table:
    solution = source.solution
    header = [
        "frame",
        "stop",
        "pan_rad",
        "tilt_rad",
        "sigma_pan_rad",
        "sigma_tilt_rad",
        "told_pan_rad",
        "told_tilt_rad",
    ]
    return header, [
        [frame.id, frame.stop, *angles.tolist(), *sigmas.tolist(), frame.pan_rad, frame.tilt_rad]
        for frame, angles, sigmas in zip(
            solution.traverse.frames, solution.final.pan_tilt_rad, solution.angle_sigma_rad, strict=True
        )
    ]


def _images(source: Source) -> _Table:
    solution = source.solution
    traverse, final = solution.traverse, solution.final
    of_image = None if traverse.observations is None else traverse.observations.image
    rows = []
    for row, image in enumerate(traverse.images):
        seen = (
            np.zeros(0, dtype=int) if of_image is None else np.flatnonzero(solution.used & (of_image == row))
        )
        residual = solution.residual_final_px[seen]
        rows.append(
            [
                image.id,
                image.file or "",
                image.frame,
                image.camera,
                source.identities[row].unique_id,
                *_pose(final.world_R_camera[row], final.world_t_camera[row]),
                len(seen),
                rms_px(residual) if len(seen) else np.nan,
            ]
        )
    return ["image", "file", "frame", "camera", "unique_id", *_POSE, "observations", "rms_px"], rows


def _points(source: Source) -> _Table:
    solution = source.solution
    site = solution.traverse.site
    header = [
        "track",
        "x_m",
        "y_m",
        "z_m",
        "sigma_m",
        "observations",
        "rms_px",
        *(() if site is None else _PLACE),
    ]
    n, row = len(solution.landmark_track), solution.landmark_row
    use = np.flatnonzero(solution.used & (row >= 0)) if n else np.zeros(0, dtype=int)
    count = np.bincount(row[use], minlength=n)
    total = np.bincount(row[use], weights=np.sum(solution.residual_final_px[use] ** 2, axis=1), minlength=n)
    places = None if site is None or not n else site.geographic(solution.final.landmarks_m)
    rows = [
        [
            int(solution.landmark_track[i]),
            *solution.final.landmarks_m[i].tolist(),
            float(source.point_sigma_m[i]),
            int(count[i]),
            float(np.sqrt(total[i] / count[i])) if count[i] else np.nan,
            *([] if places is None else places[i].tolist()),
        ]
        for i in np.flatnonzero(np.isfinite(solution.final.landmarks_m).all(axis=1)).tolist()
    ]
    return header, rows


def _observations(source: Source) -> _Table:
    solution = source.solution
    observations = solution.traverse.observations
    header = ["image", "track", "u_px", "v_px", "sigma_px", "used", "du_px", "dv_px"]
    if observations is None:
        return header, []
    ids = [image.id for image in solution.traverse.images]
    return header, (
        [ids[image], track, *uv, sigma, int(used), *residual]
        for image, track, uv, sigma, used, residual in zip(
            observations.image.tolist(),
            observations.track.tolist(),
            observations.uv_px.tolist(),
            solution.sigma_px.tolist(),
            solution.used.tolist(),
            solution.residual_final_px.tolist(),
            strict=True,
        )
    )


def _rig(source: Source) -> _Table:
    """The cameras as adjusted: pinhole of each eye and its mount on the head; sigmas of what was free."""
    header = ["camera", "entry", "value", "sigma", "prior_sigma", "stop", "image"]
    rows: list[list[object]] = []
    for eye in source.solution.rig.eyes:
        p, mount = eye.camera.pinhole, eye.head_T_camera
        values = {
            "fx_px": p.fx_px,
            "fy_px": p.fy_px,
            "skew_px": p.skew_px,
            "cx_px": p.cx_px,
            "cy_px": p.cy_px,
        }
        values |= dict(zip(_POSE, _pose(mount.rotation().matrix(), mount.translation()), strict=True))
        rows += [[eye.name, name, value, np.nan, np.nan, "", ""] for name, value in values.items()]
    for r in source.solution.refined:
        value = r.change if r.nominal is None else r.nominal + r.change
        rows.append(
            [
                r.camera or "",
                f"{r.quantity} {r.entry}",
                value,
                r.sigma,
                r.prior_sigma,
                r.stop or "",
                r.image or "",
            ]
        )
    return header, rows


def _pose(rotation: FloatArray, translation: FloatArray) -> list[float]:
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return [np.nan] * 7
    return [*translation.tolist(), *wxyz_from_rotation(rotation).tolist()]


def _csv(header: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue().encode()


def _cell(value: object) -> str:
    if isinstance(value, str):
        return table_cell(value)
    if isinstance(value, float):
        return repr(float(value)) if np.isfinite(value) else ""
    return str(value)
