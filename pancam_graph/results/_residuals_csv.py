"""Residuals as a table: `residuals.csv`, a row per observation."""

import csv
import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.text import table_cell
from pancam_graph.data import Solution
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["COLUMNS", "COVARIANCE_COLUMNS", "RESIDUALS", "residuals_csv"]

COLUMNS = (
    "image",
    "track",
    "u_px",
    "v_px",
    "sigma_px",
    "initial_du_px",
    "initial_dv_px",
    "final_du_px",
    "final_dv_px",
    "used",
    "reason",
)
"""`image` is the image's id as `table_cell` writes it; du and dv are projected minus measured, empty where
undefined; `used` is 1 or 0; `reason` says why an observation was not used."""


COVARIANCE_COLUMNS = ("cov_uu_px2", "cov_uv_px2", "cov_vv_px2")
"""The last columns, only where observations have covariances: those of the final weights."""


def residuals_csv(solution: Solution) -> bytes:
    """The residuals of a solution as a CSV file with `COLUMNS`, in the order of the observations."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    covariance = solution.covariance_px2
    writer.writerow(COLUMNS if covariance is None else COLUMNS + COVARIANCE_COLUMNS)
    observations = solution.traverse.observations
    if observations is not None:
        ids = [table_cell(i.id) for i in solution.traverse.images]
        columns: list[Iterable[object]] = [
            [ids[row] for row in observations.image.tolist()],
            observations.track.tolist(),
            *(_cells(c) for c in observations.uv_px.T),
            _cells(solution.sigma_px),
            *(_cells(c) for c in solution.residual_initial_px.T),
            *(_cells(c) for c in solution.residual_final_px.T),
            solution.used.astype(int).tolist(),
            solution.reason,
        ]
        if covariance is not None:
            columns += [_cells(covariance[:, i, j]) for i, j in ((0, 0), (0, 1), (1, 1))]
        writer.writerows(zip(*columns, strict=True))
    return text.getvalue().encode()


def _cells(column: FloatArray) -> list[str]:
    """Numbers with ten significant digits (a micropixel on any image); empty where not finite."""
    finite = np.isfinite(column)
    return [f"{x:.10g}" if ok else "" for x, ok in zip(column.tolist(), finite.tolist(), strict=True)]


def _write(written: Written, path: Path) -> Written:
    path.write_bytes(residuals_csv(written.solution))
    return written


RESIDUALS = OutputWriter(write=_write)
