"""Residuals as a table, a row per observation: `residuals.npz`, and `residuals.csv` where it is asked for."""

from pathlib import Path
from typing import Any

import numpy as np

from pancam_graph.data import Solution
from pancam_graph.results._output import OutputWriter, Written
from pancam_graph.results.table import Column, Names, csv_blocks

__all__ = ["RESIDUALS", "RESIDUALS_CSV", "residual_columns"]


def residual_columns(solution: Solution) -> dict[str, Column]:
    """The columns of the table, in the order of the observations; none without observations.

    `image` and `track` say which point was seen where; `u_px`, `v_px` and `sigma_px` are the measurement and
    its noise as used in the end; `initial_du_px` to `final_dv_px` are projected minus measured before and
    after, NaN where undefined; `used` is 1 or 0; `reason` says why an observation was not used. Where
    observations have covariances, the last three columns are those of the final weights.
    """
    observations = solution.traverse.observations
    if observations is None:
        return {}
    reasons = sorted(set(solution.reason))
    place = {reason: row for row, reason in enumerate(reasons)}
    u, v = observations.uv_px.T
    columns: dict[str, Column] = {
        "image": Names(row=observations.image, names=[i.id for i in solution.traverse.images]),
        "track": observations.track,
        "u_px": u,
        "v_px": v,
        "sigma_px": solution.sigma_px,
    }
    for when, residual in (("initial", solution.residual_initial_px), ("final", solution.residual_final_px)):
        columns[f"{when}_du_px"], columns[f"{when}_dv_px"] = residual.T
    columns["used"] = solution.used.astype(np.int64)
    columns["reason"] = Names(
        row=np.fromiter((place[r] for r in solution.reason), np.int64, len(solution.reason)), names=reasons
    )
    covariance = solution.covariance_px2
    if covariance is not None:
        for entry, i, j in (("uu", 0, 0), ("uv", 0, 1), ("vv", 1, 1)):
            columns[f"cov_{entry}_px2"] = covariance[:, i, j]
    return columns


def _write(written: Written, path: Path) -> Written:
    """Names are kept once: `image` has rows of `image_names`, `reason` of `reason_names`."""
    arrays: dict[str, Any] = {}
    for name, column in residual_columns(written.solution).items():
        if isinstance(column, Names):
            arrays[name] = column.row.astype(np.int32)
            arrays[f"{name}_names"] = np.array(column.names, dtype=str)
        else:
            arrays[name] = column.astype(bool) if name == "used" else column
    np.savez(path, **arrays)
    return written


def _write_csv(written: Written, path: Path) -> Written:
    columns = residual_columns(written.solution)
    with path.open("wb") as file:
        for block in csv_blocks(list(columns), list(columns.values())) if columns else ():
            file.write(block)
    return written


RESIDUALS, RESIDUALS_CSV = OutputWriter(write=_write), OutputWriter(write=_write_csv)
