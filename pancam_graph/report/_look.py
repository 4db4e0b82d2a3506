"""The look of all figures: one set of colours that colour-blind readers can tell apart, one layout."""

from dataclasses import dataclass

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
]

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
