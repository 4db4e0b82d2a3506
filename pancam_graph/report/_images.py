"""Residual vectors of single images, over the picture where there is a file."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import Solution, Traverse, rms_px
from pancam_graph.io import readable_picture
from pancam_graph.report._numbers import Json, fixed, lengths, round_factor, rounded, thinned

__all__ = ["ImageResiduals", "choose_images", "image_residuals", "magnification", "picture", "vector_panels"]

_MAX_IMAGES = 40
_MAX_VECTORS = 1_000
_PICTURE_SIDE_PX = 640
_PICTURE_BUDGET = 2_500_000
"""Characters that all pictures of a page may take together."""


@dataclass(frozen=True, kw_only=True)
class ImageResiduals:
    """Residuals of one image, as its row in the table says."""

    used: int
    """Observations that took part."""
    rejected: int
    """Observations left out."""
    before_px: float
    """RMS length of the used ones at the start; NaN for none."""
    after_px: float
    """RMS length of the used ones at the end; NaN for none."""
    median_px: float
    """Median length of the used ones at the end; NaN for none."""


def image_residuals(solution: Solution) -> tuple[list[ImageResiduals], list[IntArray]]:
    """Residuals of each image, and the rows of its observations."""
    observations = solution.traverse.observations
    n = len(solution.traverse.images)
    image = observations.image if observations is not None else np.zeros(0, dtype=np.int64)
    order = np.argsort(image, kind="stable")
    rows_of = np.split(order, np.searchsorted(image[order], np.arange(1, n)))
    table = []
    for rows in rows_of:
        used = rows[solution.used[rows]]
        before, after = solution.residual_initial_px[used], solution.residual_final_px[used]
        final = lengths(after)
        table.append(
            ImageResiduals(
                used=len(used),
                rejected=len(rows) - len(used),
                before_px=_rms_of_finite(before),
                after_px=_rms_of_finite(after),
                median_px=float(np.median(final)) if len(final) else float("nan"),
            )
        )
    return table, rows_of


def _rms_of_finite(residuals_px: FloatArray) -> float:
    finite = residuals_px[np.isfinite(residuals_px).all(axis=1)]
    return rms_px(finite) if len(finite) else float("nan")


def choose_images(table: list[ImageResiduals]) -> list[int]:
    """Rows of the images to draw: the largest residuals first, at most 40, none without observations."""
    rows = [row for row, entry in enumerate(table) if entry.used + entry.rejected > 0]
    rows.sort(key=lambda row: (-np.nan_to_num(table[row].after_px, nan=-1.0), row))
    return rows[:_MAX_IMAGES]


def magnification(residuals_px: FloatArray, width_px: int) -> float:
    """Round factor that makes a long residual (the 90th percentile) a twentieth of the image's width."""
    length = lengths(residuals_px)
    long = float(np.quantile(length, 0.9)) if len(length) else 0.0
    # Below a ten-thousandth of a pixel residuals are round-off and arrows would show only noise.
    return round_factor(0.05 * width_px / long) if long > 1e-4 else 1.0


def picture(traverse: Traverse, row: int) -> str | None:
    """A small contrast-stretched JPEG of an image as a data URI; None if its file cannot be read."""
    samples = readable_picture(traverse, row)
    if samples is None:
        return None
    grey = np.asarray(samples, dtype=np.float32)
    shrink = min(1.0, _PICTURE_SIDE_PX / max(grey.shape))
    if shrink < 1:
        size = (max(1, round(grey.shape[1] * shrink)), max(1, round(grey.shape[0] * shrink)))
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))
    lit = grey[grey > 0]  # borders of linearised products are zero
    low, high = np.quantile(lit, [0.005, 0.995]) if len(lit) else (0.0, 1.0)
    stretched = np.clip((grey - low) / max(high - low, 1e-6), 0, 1)
    # Kept pale, so that vectors stand out.
    done, data = cv2.imencode(
        ".jpg", (100 + 155 * stretched).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 65]
    )
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii") if done else None


def vector_panels(solution: Solution, table: list[ImageResiduals], rows_of: list[IntArray]) -> list[Json]:
    """What the page's script draws for each chosen image: size, picture, pixels, vectors, factors."""
    traverse, observations = solution.traverse, solution.traverse.observations
    if observations is None:
        return []
    panels: list[Json] = []
    spent = 0
    for row in choose_images(table):
        image, entry, rows = traverse.images[row], table[row], rows_of[row]
        camera = traverse.rig.eyes[int(traverse.image_eye[row])].camera
        source = None
        if spent < _PICTURE_BUDGET:
            source = picture(traverse, row)
            spent += len(source or "")
        rows = rows[thinned(len(rows), _MAX_VECTORS)]
        used = solution.used[rows]
        before, after = solution.residual_initial_px[rows], solution.residual_final_px[rows]
        decimals_before, decimals_after = (
            3 if rms_px(np.nan_to_num(r)) > 0.01 else 6 for r in (before, after)
        )
        panels.append(
            {
                "label": f"{image.id}: {fixed(entry.before_px, 2)} to {fixed(entry.after_px, 2)} px",
                "width": camera.width_px,
                "height": camera.height_px,
                "picture": source,
                "shown": len(rows),
                "total": entry.used + entry.rejected,
                "u": rounded(observations.uv_px[rows, 0], 1),
                "v": rounded(observations.uv_px[rows, 1], 1),
                "used": used.astype(int).tolist(),
                "before": [rounded(before[:, axis], decimals_before) for axis in (0, 1)],
                "after": [rounded(after[:, axis], decimals_after) for axis in (0, 1)],
                "factor": [
                    magnification(before[used], camera.width_px),
                    magnification(after[used], camera.width_px),
                ],
            }
        )
    return panels
