"""Plain diagrams: the residuals' histogram, and the corrections of pan and tilt."""

import numpy as np

from pancam_graph.base.geometry import FloatArray, wrap_angle
from pancam_graph.data import Solution
from pancam_graph.report._escaped import escape
from pancam_graph.report._look import AFTER, BEFORE, GRID, INK, MUTED, Figure, axis, layout, logarithmic
from pancam_graph.report._numbers import Json, fixed, lengths, rounded, short

__all__ = ["histogram_edges", "make_corrections", "make_histogram"]

_BINS = 48
_LOG_RATIO = 6.0
"""Ratio of the two medians from which the axis is logarithmic; a linear one would squeeze one histogram into
a bar."""
_MAX_STOP_NAMES = 10


def histogram_edges(before_px: FloatArray, after_px: FloatArray) -> tuple[FloatArray, bool]:
    """Common bin edges (49,) of two sets of lengths, and whether they grow geometrically.

    Equal steps up to the larger 99th percentile; geometric steps where their medians are far apart.
    The caller counts the few lengths outside into the outermost bins.
    """
    both = np.concatenate([before_px, after_px])
    top = max((float(np.quantile(s, 0.99)) for s in (before_px, after_px) if len(s)), default=1.0)
    if top <= 0:
        return np.linspace(0.0, 1.0, _BINS + 1), False
    if len(before_px) and len(after_px):
        medians = np.array([np.median(before_px), np.median(after_px)])
        if medians.max() > _LOG_RATIO * medians.min():
            floor = max(float(np.quantile(both, 0.002)), 1e-6 * top)
            if floor < top:
                return np.geomspace(floor, top, _BINS + 1), True
    return np.linspace(0.0, top, _BINS + 1), False


def make_histogram(solution: Solution) -> Figure:
    """Histogram of the lengths of residuals of the used observations, before and after."""
    before = lengths(solution.residual_initial_px[solution.used])
    after = lengths(solution.residual_final_px[solution.used])
    edges, geometric = histogram_edges(before, after)
    traces: list[Json] = []
    for name, values, colour, fill in (
        ("before", before, BEFORE, "rgba(139,152,165,0.35)"),
        ("after", after, AFTER, "rgba(0,114,178,0.30)"),
    ):
        counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
        steps = [0, *np.repeat(counts, 2).tolist(), 0]
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": [float(f"{e:.6g}") for e in np.repeat(edges, 2)],
                "y": steps,
                "fill": "tozeroy",
                "fillcolor": fill,
                "line": {"color": colour, "width": 2},
                "name": name,
                "hovertemplate": f"{name}: %{{y}} around %{{x:.3g}} px<extra></extra>",
            }
        )
    scale: Json = logarithmic(edges) if geometric else {"rangemode": "tozero"}
    caption = "Nothing was used, so there is nothing to show."
    if len(after):
        beyond = np.mean(before > edges[-1]) if len(before) else 0.0
        caption = (
            f"Lengths of the residual vectors of the {len(after):,} used observations, in the same bins. "
            f"Median {short(_median(before))} px before, {short(_median(after))} px after. "
            f"The last bin also holds all that is longer ({100 * beyond:.1f} % of before)."
        )
        if geometric:
            caption += " The horizontal axis is logarithmic; the first bin also holds all that is shorter."
    return Figure(
        id="histogram",
        traces=tuple(traces),
        layout=layout(
            xaxis=axis("residual length (px)", **scale),
            yaxis=axis("observations", rangemode="tozero"),
            margin={"l": 60, "r": 20, "t": 60, "b": 50},
            legend={"orientation": "h", "x": 0, "y": 1.01, "yanchor": "bottom"},
        ),
        caption=caption,
    )


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def make_corrections(solution: Solution) -> Figure:
    """How far pan and tilt of each frame moved, with its formal sigma and the sigma of the telemetry."""
    traverse = solution.traverse
    correction = 1e3 * wrap_angle(solution.correction_rad)
    sigma = 1e3 * solution.angle_sigma_rad
    prior = 1e3 * traverse.pan_tilt_sigmas_rad
    number = np.arange(len(traverse.frames))
    names = [f"{escape(f.id)} at {escape(f.stop)}" for f in traverse.frames]
    traces: list[Json] = []
    axes: Json = {}
    sentences = []
    for row, angle in enumerate(("pan", "tilt")):
        suffix = "" if row == 0 else "2"
        top = _top(correction[:, row], sigma[:, row], prior[:, row])
        band = np.minimum(
            prior[:, row], 10 * top
        )  # bars that leave the figure are cut off a little beyond it
        edge = np.repeat(band, 2)
        corner = np.column_stack([number - 0.5, number + 0.5]).ravel()
        at = {"xaxis": "x", "yaxis": f"y{suffix}"}
        traces.append(
            {
                **at,
                "type": "scatter",
                "mode": "lines",
                "x": [*corner.tolist(), *corner[::-1].tolist()],
                "y": [*rounded(edge, 5), *rounded(-edge[::-1], 5)],
                "fill": "toself",
                "fillcolor": "rgba(139,152,165,0.22)",
                "line": {"width": 0},
                "hoverinfo": "skip",
                "name": "±1 sigma of the telemetry",
                "showlegend": row == 0,
            }
        )
        spread = [
            f"formal sigma {short(s)} mrad, telemetry {short(p)} mrad"
            for s, p in zip(sigma[:, row].tolist(), prior[:, row].tolist(), strict=True)
        ]
        traces.append(
            {
                **at,
                "type": "scatter",
                "mode": "markers",
                "x": number.tolist(),
                "y": rounded(correction[:, row], 5),
                "error_y": {
                    "type": "data",
                    "array": rounded(sigma[:, row], 5),
                    "color": AFTER,
                    "thickness": 1.5,
                    "width": 3,
                },
                "marker": {"color": AFTER, "size": 5 if len(number) <= 200 else 3.5},
                "text": [f"{n}<br>{s}" for n, s in zip(names, spread, strict=True)],
                "hovertemplate": "%{text}<br>" + angle + " %{y} mrad<extra></extra>",
                "name": "correction, ±1 formal sigma",
                "showlegend": row == 0,
            }
        )
        axes[f"yaxis{suffix}"] = axis(
            f"{angle} (mrad)",
            range=[-top, top],
            domain=[0.53, 1.0] if row == 0 else [0.0, 0.47],
            zerolinecolor=BEFORE,
        )
        sentences.append(_summary(angle, correction[:, row], sigma[:, row], prior[:, row]))
        if (prior[:, row] > top).any():
            sentences.append(f"The band of the telemetry reaches beyond the diagram of {angle}.")
    shapes, labels = _stop_borders(solution)
    return Figure(
        id="corrections",
        traces=tuple(traces),
        layout=layout(
            **axes,
            xaxis=axis(
                "frame, counted from 0",
                range=[-0.6, len(number) - 0.4],
                anchor="y2",
                tickformat="d",
                nticks=20,
                zeroline=False,
                **({"dtick": 1} if len(number) <= 20 else {}),
            ),
            shapes=shapes,
            annotations=labels,
            margin={"l": 70, "r": 20, "t": 60, "b": 50},
            legend={"orientation": "h", "x": 0, "y": 1.06, "yanchor": "bottom"},
        ),
        caption=" ".join(sentences),
    )


def _top(correction: FloatArray, sigma: FloatArray, prior: FloatArray) -> float:
    """Half height of a diagram of corrections: all of them, and the prior unless it dwarfs them."""
    finite = np.nan_to_num(np.abs(correction)) + np.nan_to_num(sigma)
    reach, band = float(finite.max()), float(prior.max())
    top = max(reach, band) if band <= 6 * reach else 3 * reach
    return 1.15 * top if top > 0 else max(1.15 * band, 1e-3)


def _summary(angle: str, correction: FloatArray, sigma: FloatArray, prior: FloatArray) -> str:
    """Corrections of one angle against both sigmas, in a sentence."""
    moved = correction[np.isfinite(correction)]
    known = sigma[np.isfinite(sigma) & (sigma > 0)]
    rms = float(np.sqrt(np.mean(moved**2))) if len(moved) else float("nan")
    text = f"{angle.capitalize()} moved by {short(rms)} mrad ({fixed(np.rad2deg(rms / 1e3), 3)}°) RMS"
    if (prior > 0).any():
        text += f", where the telemetry claims {short(_median(prior[prior > 0]))} mrad"
    if len(known):
        text += f"; the median formal sigma is now {short(_median(known))} mrad"
    return text + "."


def _stop_borders(solution: Solution) -> tuple[list[Json], list[Json]]:
    """Lines between the frames of different stops, and the stops' names where there is room."""
    stop = solution.traverse.frame_stop
    starts = [0, *(np.flatnonzero(np.diff(stop)) + 1).tolist()]
    shapes: list[Json] = [
        {
            "type": "line",
            "x0": start - 0.5,
            "x1": start - 0.5,
            "y0": 0,
            "y1": 1,
            "yref": "paper",
            "line": {"color": GRID if len(starts) > 60 else MUTED, "width": 1, "dash": "dot"},
        }
        for start in starts[1:]
    ]
    if len(starts) > _MAX_STOP_NAMES or len(starts) == 1:
        return shapes, []
    ends = [*starts[1:], len(stop)]
    labels: list[Json] = [
        {
            "x": (start + end - 1) / 2,
            "y": 1.0,
            "yref": "paper",
            "yanchor": "bottom",
            "text": escape(solution.traverse.stops[stop[start]].id[:16]),
            "showarrow": False,
            "font": {"color": INK, "size": 12},
        }
        for start, end in zip(starts, ends, strict=True)
        if (end - start) * _MAX_STOP_NAMES >= len(stop)
    ]
    return shapes, labels
