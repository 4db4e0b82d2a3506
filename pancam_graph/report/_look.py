"""The look of all figures: one set of colours that colour-blind readers can tell apart, one layout."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.report._numbers import Json

__all__ = [
    "AFTER",
    "BEFORE",
    "EYES",
    "GRID",
    "INK",
    "MUTED",
    "REJECTED",
    "RESIDUAL_SCALE",
    "Figure",
    "axis",
    "layout",
    "logarithmic",
]

_MANY_DECADES = 2.5
"""Decades above which an axis has a tick at each power of ten only."""

INK = "#1f2933"
MUTED = "#667380"
GRID = "#e3e8ec"
BEFORE = "#8b98a5"
AFTER = "#0072b2"
REJECTED = "#d55e00"
EYES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's colours, one per eye; the seventh eye has the first colour again."""
RESIDUAL_SCALE = ((0.0, "#0d0887"), (0.3, "#6a00a8"), (0.6, "#b12a90"), (0.8, "#e16462"), (1.0, "#fca636"))
"""The colour scale Plasma without its pale end, which cannot be seen on a white page."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A Plotly figure and its caption."""

    id: str
    """Id of the page element it is drawn in."""
    traces: tuple[Json, ...]
    layout: Json
    caption: str
    """Plain text; the page escapes it."""

    def json(self) -> Json:
        """The figure in the form that the script of the page takes."""
        return {"id": self.id, "data": list(self.traces), "layout": self.layout}


def axis(title: str, **more: object) -> Json:
    """A two-dimensional axis with title and unit."""
    return {
        "title": {"text": title, "standoff": 8},
        "gridcolor": GRID,
        "zerolinecolor": GRID,
        "linecolor": BEFORE,
        "showline": True,
        "ticks": "outside",
        "tickcolor": BEFORE,
        "automargin": True,
        **more,
    }


def logarithmic(values: ArrayLike) -> Json:
    """What makes an axis logarithmic, with ticks at 1, 2 and 5 of each decade that some values (n,) span.

    Plotly's own ticks between decades are single digits, which readers take for values.
    """
    positive = np.asarray(values, dtype=float)
    positive = positive[np.isfinite(positive) & (positive > 0)]
    low, high = np.log10([positive.min(), positive.max()]) if len(positive) else (-1.0, 1.0)
    steps = (1,) if high - low > _MANY_DECADES else (1, 2, 5)
    decades = range(int(np.floor(low)) - 1, int(np.ceil(high)) + 2)
    ticks = [float(f"{step}e{decade}") for decade in decades for step in steps]
    return {"type": "log", "tickmode": "array", "tickvals": ticks, "ticktext": [f"{t:g}" for t in ticks]}


def layout(**more: object) -> Json:
    """A layout with the page's font and quiet margins."""
    return {
        "autosize": True,
        "font": {"family": "system-ui, 'Segoe UI', 'DejaVu Sans', sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 60, "r": 20, "t": 20, "b": 50},
        "hoverlabel": {"align": "left"},
        **more,
    }
