"""Two frames in section, with telemetry's and with the refined pointing: drawn as SVG, without a script."""

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.report._escaped import escape
from pancam_graph.terrain import Section

__all__ = ["section_figures"]

_WIDE, _HIGH = 620, 280
_LEFT, _RIGHT, _TOP, _BOTTOM = 74, _WIDE - 14, 40, _HIGH - 52
_NAMES = "first", "second"
_MOST_POINTS = 400


def section_figures(section: Section, frame_ids: tuple[str, ...]) -> str:
    """The surfaces of two frames along a line, before and after, side by side, with a caption."""
    heights = np.stack([section.telemetry_m, section.refined_m])
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    margin = max(0.06 * (high - low), 0.005)
    span = low - margin, high + margin
    names = [frame_ids[f] for f in section.frames]
    panels = "\n".join(
        f"<div>{_panel(section.along_m, of_both, span, f'{pointing} pointing', names)}</div>"
        for pointing, of_both in zip(("telemetry's", "refined"), heights, strict=True)
    )
    (ax, ay), (bx, by) = section.ends_m
    caption = (
        f"What the frames {names[0]} and {names[1]} see of the same ground, in section from "
        f"({ax:.1f}, {ay:.1f}) to ({bx:.1f}, {by:.1f}) m: of the pairs that telemetry puts farther apart "
        "than most, the one that shares most ground. Heights are enlarged against lengths; gaps are ground "
        "that the frame does not see."
    )
    return (
        f'<h3>Two frames in section</h3>\n<div class="pair">{panels}</div>\n'
        f'<p class="caption">{escape(caption)}</p>\n'
    )


def _panel(
    along_m: FloatArray,
    heights_m: NDArray[np.float32],
    span_m: tuple[float, float],
    title: str,
    names: list[str],
) -> str:
    length = max(float(along_m[-1]), 1e-9)
    x = _LEFT + along_m / length * (_RIGHT - _LEFT)
    y = _BOTTOM - (heights_m - span_m[0]) / (span_m[1] - span_m[0]) * (_BOTTOM - _TOP)
    step = max(1, len(x) // _MOST_POINTS)
    parts = [f'<text x="{_LEFT}" y="20">{escape(title)}</text>']
    for value, decimals in _ticks(0.0, length):
        at = _LEFT + value / length * (_RIGHT - _LEFT)
        parts.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP}" y2="{_BOTTOM}"/>')
        parts.append(_text(at, _BOTTOM + 20, "middle", f"{value:.{decimals}f}"))
    for value, decimals in _ticks(*span_m):
        at = _BOTTOM - (value - span_m[0]) / (span_m[1] - span_m[0]) * (_BOTTOM - _TOP)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(_text(_LEFT - 8, at + 5, "end", f"{value:.{decimals}f}"))
    parts.append(_text((_LEFT + _RIGHT) / 2, _HIGH - 8, "middle", "along the line, m"))
    middle = (_TOP + _BOTTOM) / 2
    parts.append(
        f'<text x="18" y="{middle}" text-anchor="middle" transform="rotate(-90 18 {middle})">height, m</text>'
    )
    for own, name in zip(y, _NAMES, strict=True):
        parts.append(f'<path class="{name}" d="{_path(x[::step], own[::step])}"/>')
    for k, name in enumerate(_NAMES):
        at = _RIGHT - 250 + 130 * k
        parts.append(f'<path class="{name}" d="M{at} 15h22"/>')
        parts.append(_text(at + 28, 20, "start", names[k][-11:]))
    label = f"Heights of two frames, {title}"
    return (
        f'<svg class="section" viewBox="0 0 {_WIDE} {_HIGH}" role="img" aria-label="{escape(label)}">'
        f"{''.join(parts)}</svg>"
    )


def _text(x: float, y: float, anchor: str, text: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _path(x: FloatArray, y: FloatArray) -> str:
    """A line through the points that are known, with gaps."""
    parts, pen = [], "M"
    for px, py in zip(x.tolist(), y.tolist(), strict=True):
        if not np.isfinite(py):
            pen = "M"
            continue
        parts.append(f"{pen}{px:.1f} {py:.1f}")
        pen = "L"
    return "".join(parts)


def _ticks(low: float, high: float, wanted: int = 5) -> list[tuple[float, int]]:
    """Round values within a span, and with how many decimals they are written."""
    raw = (high - low) / wanted
    power = int(np.floor(np.log10(raw)))
    step = next(s for s in (1.0, 2.0, 5.0, 10.0) if s * 10.0**power >= raw * 0.999) * 10.0**power
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return [(k * step, decimals) for k in range(first, last + 1)]
