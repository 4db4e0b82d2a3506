"""Figures over the image of each eye: what the refined camera changes, and what residuals are left."""

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, skew, so3_exp
from pancam_graph.cameras import Camera, FieldCamera
from pancam_graph.data import Solution
from pancam_graph.report._look import AFTER, BEFORE, INK, REJECTED, Figure, axis, layout
from pancam_graph.report._numbers import Json, round_factor, rounded, short

__all__ = ["displacement_px", "lens_figures", "mean_residuals"]

_ACROSS = 13
"""Arrows along the longer side of an image."""
_CELLS = 8
"""Cells of mean residuals along the longer side."""
_FEWEST = 6
"""Observations of a cell that has a mean."""
_FAR_M = 1e3
"""Distance of the points that cameras are compared by, where they have no single centre."""
_MOST_EYES = 6
_BARB = 0.28
"""Length of an arrow's head as a share of the arrow."""


def lens_figures(solution: Solution, held_px: FloatArray | None) -> list[tuple[str, list[Figure]]]:
    """For each eye with images its name, and figures: displacements, and mean residuals before and after.

    `held_px` (observations, 2) are residuals with the rig held as told; None: not known.
    """
    traverse, out = solution.traverse, []
    eyes = sorted(set(traverse.image_eye.tolist()))[:_MOST_EYES]
    for number in eyes:
        told, refined = traverse.rig.eyes[number].camera, solution.rig.eyes[number].camera
        grid, _ = _grid(told, _ACROSS)
        figures = []
        whole, valid = displacement_px(told, refined, grid)
        if valid.any() and np.abs(whole[valid]).max() > 1e-9:
            bent, bent_valid = displacement_px(told, refined, grid, turned=True)
            figures.append(_arrows(f"lens-{number}", told, grid[valid], whole[valid], _MOVED))
            keep = valid & bent_valid
            figures.append(_arrows(f"bent-{number}", told, grid[keep], bent[keep], _BENT))
        if isinstance(refined, FieldCamera):
            figures.append(_arrows(f"field-{number}", told, grid, refined.at(grid)[0], _FIELD))
        figures += _residual_figures(solution, number, held_px)
        if figures:
            out.append((traverse.rig.eyes[number].name, figures))
    return out


_MOVED = "The refined camera shows a line of sight displaced by so much against the camera as told"
_FIELD = "Of that the smooth field beside the lens, which no number of the table describes"
_BENT = "The same less what a turn of the camera would do, which pan, tilt and mount can take up"


def displacement_px(
    told: Camera, refined: Camera, uv_px: FloatArray, *, turned: bool = False
) -> tuple[FloatArray, BoolArray]:
    """Displacement (n, 2) of lines of sight of pixels (n, 2) in a refined camera, and validity (n,).

    Both cameras have one frame. With `turned` the refined camera is first turned to where the displacements
    are least: what is left no turn can make.
    """
    rays = told.unproject(uv_px)
    points = rays.origin_m + _FAR_M * rays.direction
    turn = np.eye(3)
    for _ in range(4 if turned else 0):
        uv, d_uv, valid = refined.project_with_jacobian(points @ turn.T)
        use = valid & rays.valid
        if use.sum() < 3:
            break
        x = (points @ turn.T)[use]
        # A small turn w moves a point by w x point.
        d_turn = np.einsum("nij,njk->nik", d_uv[use], -skew(x))
        step, *_ = np.linalg.lstsq(d_turn.reshape(-1, 3), (uv_px - uv)[use].ravel(), rcond=None)
        turn = so3_exp(step) @ turn
    uv, valid = refined.project(points @ turn.T)
    return uv - uv_px, valid & rays.valid


def _grid(camera: Camera, across: int) -> tuple[FloatArray, float]:
    """Pixels (n, 2) in the middle of square cells, and the side of a cell."""
    width, height = camera.width_px, camera.height_px
    side = max(width, height) / across
    columns, rows = (max(1, round(n / side)) for n in (width, height))
    u = (np.arange(columns) + 0.5) * width / columns - 0.5
    v = (np.arange(rows) + 0.5) * height / rows - 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return uv, side


def mean_residuals(
    camera: Camera, uv_px: FloatArray, residual_px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means of residuals (n, 2) in cells of an image: middles (k, 2), means (k, 2), standard errors (k,).

    The error is of the length of a mean, from the spread within its cell. Cells with few observations are
    left out.
    """
    middle, side = _grid(camera, _CELLS)
    size = np.array([camera.width_px, camera.height_px])
    count = np.array([max(1, round(n / side)) for n in size.tolist()])
    known = np.isfinite(residual_px).all(axis=1)
    uv_px, residual_px = uv_px[known], residual_px[known]
    place = np.clip(((uv_px + 0.5) * count / size).astype(np.int64), 0, count - 1)
    cell = place[:, 1] * count[0] + place[:, 0]
    n = np.bincount(cell, minlength=len(middle))
    total = np.stack([np.bincount(cell, residual_px[:, i], len(middle)) for i in (0, 1)], axis=1)
    squares = np.bincount(cell, np.sum(residual_px**2, axis=1), len(middle))
    full = n >= _FEWEST
    mean = total[full] / n[full, None]
    variance = np.maximum(squares[full] / n[full] - np.sum(mean**2, axis=1), 0.0)
    return middle[full], mean, np.sqrt(variance / (n[full] - 1))


def _residual_figures(solution: Solution, eye: int, held_px: FloatArray | None) -> list[Figure]:
    traverse, observations = solution.traverse, solution.traverse.observations
    if observations is None:
        return []
    rows = np.flatnonzero(solution.used & (traverse.image_eye[observations.image] == eye))
    camera, uv_px = traverse.rig.eyes[eye].camera, observations.uv_px[rows]
    after = mean_residuals(camera, uv_px, solution.residual_final_px[rows])
    before = None if held_px is None else mean_residuals(camera, uv_px, held_px[rows])
    if not len(after[0]):
        return []
    # Both at one scale, so that they can be compared.
    shown = [cells for cells in (before, after) if cells is not None and len(cells[0])]
    longest = max(_long(mean) for _, mean, _ in shown)
    out = []
    for name, cells, when in (
        ("before", before, "with the rig held as told"),
        ("after", after, "as refined"),
    ):
        if cells is None or not len(cells[0]):
            continue
        middle, mean, error = cells
        chance = short(float(np.sqrt(np.mean(error**2))))
        caption = (
            f"Mean residual in {len(mean)} cells {when}: {short(_rms(mean))} px RMS, where noise alone would "
            f"make {chance} px"
        )
        colour = BEFORE if name == "before" else AFTER
        out.append(
            _arrows(f"mean-{name}-{eye}", camera, middle, mean, caption, longest=longest, colour=colour)
        )
    return out


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _long(vectors: FloatArray) -> float:
    """A long one: few are longer, and may leave their cell."""
    return float(np.quantile(np.linalg.norm(vectors, axis=1), 0.9))


def _arrows(
    identity: str,
    camera: Camera,
    feet_px: FloatArray,
    arrows_px: FloatArray,
    says: str,
    *,
    longest: float | None = None,
    colour: str = REJECTED,
) -> Figure:
    """Arrows over the image of a camera, enlarged by a round factor that is said."""
    length = np.linalg.norm(arrows_px, axis=1)
    side = max(camera.width_px, camera.height_px)
    room_px = 1.1 * side / (_ACROSS if longest is None else _CELLS)
    wanted = room_px / max(_long(arrows_px) if longest is None else longest, 1e-12)
    factor = round_factor(wanted) if wanted >= 1 else 1 / np.ceil(1 / wanted)
    tip = feet_px + factor * arrows_px
    back = -_BARB * factor * arrows_px
    left, right = (tip + back @ np.array([[1.0, s], [-s, 1.0]]) * 0.9 for s in (0.55, -0.55))
    gap = np.full_like(tip, np.nan)
    path = np.stack([feet_px, tip, left, tip, right, gap], axis=1).reshape(-1, 2)
    text = [f"{short(n)} px ({short(u)}, {short(v)})" for n, (u, v) in zip(length, arrows_px, strict=True)]
    shared: Json = {"type": "scatter", "showlegend": False}
    line: Json = {"mode": "lines", "line": {"color": colour, "width": 1.6}, "hoverinfo": "skip"}
    feet: Json = {"mode": "markers", "marker": {"color": colour, "size": 3.5}, "text": text}
    traces: tuple[Json, ...] = (
        {**shared, **line, "x": rounded(path[:, 0], 2), "y": rounded(path[:, 1], 2)},
        {
            **shared,
            **feet,
            "x": rounded(feet_px[:, 0], 1),
            "y": rounded(feet_px[:, 1], 1),
            "hovertemplate": "pixel (%{x}, %{y})<br>%{text}<extra></extra>",
        },
    )
    enlarged = "at true length" if factor == 1 else f"{factor:,.{0 if factor >= 1 else 3}f} times enlarged"
    longest_px = short(float(length.max()) if len(length) else float("nan"))
    frame: Json = {
        "type": "rect",
        "x0": -0.5,
        "x1": camera.width_px - 0.5,
        "y0": -0.5,
        "y1": camera.height_px - 0.5,
        "line": {"color": INK, "width": 1},
        "layer": "below",
    }
    across: Json = {"zeroline": False, "showgrid": False, "constrain": "domain", "nticks": 4}
    room = 0.03 * side
    reach = np.concatenate([tip, [[0.0, 0.0], [camera.width_px, camera.height_px]]])
    low, high = (reach.min(axis=0) - room).tolist(), (reach.max(axis=0) + room).tolist()
    return Figure(
        id=identity,
        traces=traces,
        layout=layout(
            xaxis=axis("u (px)", range=[low[0], high[0]], **across),
            yaxis=axis(
                "v (px)",
                range=[high[1], low[1]],
                scaleanchor="x",
                constraintoward="top",
                **across,
            ),
            shapes=[frame],
            margin={"l": 50, "r": 8, "t": 8, "b": 42},
        ),
        caption=f"{says}. Arrows {enlarged}, the longest {longest_px} px.",
    )
