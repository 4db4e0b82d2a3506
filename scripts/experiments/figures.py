"""Figures of the results, as PNG and SVG."""

import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from experiments.conditioning import ORIGINS_M, name_of
from experiments.opportunity import NAME as OPPORTUNITY
from experiments.registry import CLUSTERS, PANORAMAS, TRAVERSES
from experiments.running import Row
from experiments.verdicts import Results
from pancam_graph.base.errors import InputError

__all__ = ["draw", "require_matplotlib"]

_COLOUR = {"mast": "#0b6e4f", "circle": "#1f6fb2", "free": "#d1852c", "projective": "#a63d57"}
_MARKER = {"mast": "o", "circle": "s", "free": "^", "projective": "D"}


def require_matplotlib() -> ModuleType:
    """matplotlib.pyplot. Raises InputError saying how to get it."""
    try:
        import matplotlib as mpl  # noqa: PLC0415  an extra, wanted by the figures alone
    except ImportError as error:
        raise InputError(
            "figures: expected matplotlib, found none; install it with pip install -e '.[thesis]'"
        ) from error
    mpl.use("Agg")
    # Text stays text, and the same figures give the same file.
    mpl.rcParams.update({"svg.hashsalt": "pancam_graph", "svg.fonttype": "none", "font.size": 9})
    import matplotlib.pyplot as plt  # noqa: PLC0415  after the backend was chosen

    return plt


def draw(results: Results, folder: Path) -> list[str]:
    """Write every figure that there are results for into a folder; their names without suffix."""
    plt = require_matplotlib()
    names = []
    for name, make in (
        ("centres", _centres),
        ("landmarks", _landmarks),
        ("localisation", _localisation),
        ("conditioning", _conditioning),
        ("opportunity", _opportunity),
    ):
        figure = make(plt, results)
        if figure is None:
            continue
        for suffix, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
            figure.savefig(folder / f"{name}.{suffix}", dpi=130, metadata=metadata)
        plt.close(figure)
        names.append(name)
    return names


def _centres(plt: ModuleType, results: Results) -> Any:
    return _against_noise(plt, results, "centre_mm", "error of camera centres, RMS (mm)")


def _landmarks(plt: ModuleType, results: Results) -> Any:
    return _against_noise(plt, results, "landmark_median_m", "error of landmarks, median (m)")


def _against_noise(plt: ModuleType, results: Results, metric: str, label: str) -> Any:
    """A panel for each cluster experiment, both axes logarithmic, with bands of 90 %.

    Where most runs of a model failed its line is broken, and a cross stands at the top.
    """
    shown = [s.name for s in CLUSTERS if len(results.noises(s.name)) > 1]
    if not shown:
        return None
    figure, axes = plt.subplots(
        1, len(shown), figsize=(3.1 * len(shown) + 0.6, 3.4), sharey=True, squeeze=False, layout="constrained"
    )
    for ax, name in zip(axes[0], shown, strict=True):
        for model in results.models(name):
            rows = [results.get(name, model, noise, metric) for noise in results.noises(name)]
            shown_rows = [r for r in rows if r is not None]
            x = np.array([r.noise_px for r in shown_rows])
            low, median, high = (
                np.array([getattr(r, q) for r in shown_rows]) for q in ("q05", "median", "q95")
            )
            failed = ~np.isfinite(median)
            median = np.where(failed, np.nan, median)  # where most runs failed the line is broken
            style = {"color": _COLOUR[model], "marker": _MARKER[model], "markersize": 4}
            ax.plot(x, median, label=model, **style)
            ax.plot(
                x[failed],
                np.full(failed.sum(), 0.97),
                "x",
                color=_COLOUR[model],
                transform=ax.get_xaxis_transform(),
            )
            high = np.where(np.isfinite(high), high, 10 * median)
            low = np.where(failed, np.nan, low)
            ax.fill_between(x, low, high, color=_COLOUR[model], alpha=0.15, lw=0)
        ax.set(xscale="log", yscale="log", title=name, xlabel="noise of an observation (px)")
        ticks = results.noises(name)
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
        ax.xaxis.set_minor_locator(plt.NullLocator())
        ax.grid(alpha=0.3)
    axes[0][0].set_ylabel(label)
    axes[0][0].legend(frameon=False)
    return figure


def _localisation(plt: ModuleType, results: Results) -> Any:
    """Last stop's error in % of the way, with 90 % intervals."""
    shown = [s.name for s in (*PANORAMAS, *TRAVERSES) if results.models(s.name)]
    if not shown:
        return None
    figure, ax = plt.subplots(figsize=(7.2, 0.6 * len(shown) + 1.2), layout="constrained")
    models = results.models(shown[0])
    for i, model in enumerate(models):
        for row, name in enumerate(shown):
            entry = results.get(name, model, results.noises(name)[0], "localisation_percent")
            if entry is None:
                continue
            _interval(ax, entry, row + 0.17 * (i - (len(models) - 1) / 2), model, label=row == 0)
    ax.set_yticks(range(len(shown)), shown)
    ax.invert_yaxis()
    ax.set(
        xscale="log",
        xlabel="error of the last stop at 0.5 px (% of the way), median and 90 % interval",
    )
    ax.grid(alpha=0.3, axis="x")
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _interval(ax: Any, row: Row, y: float, model: str, *, label: bool) -> None:
    """A median with its interval; one that lies among failed runs ends in an arrow."""
    if not math.isfinite(row.median):
        return
    open_end = not math.isfinite(row.q95)
    high = row.median * 3 if open_end else row.q95
    colour = _COLOUR[model]
    ax.plot([row.q05, high], [y, y], color=colour, lw=1.5)
    if open_end:
        ax.plot([high], [y], marker=">", color=colour, markersize=5)
    ax.plot(
        [row.median],
        [y],
        marker=_MARKER[model],
        color=colour,
        markersize=5,
        lw=0,
        label=model if label else None,
    )


def _conditioning(plt: ModuleType, results: Results) -> Any:
    """Iterations by the distance of the origin, with and without conditioning."""
    shown = [m for m in ORIGINS_M if results.get(name_of(m), "projective", 0.5, "iterations") is not None]
    if not shown:
        return None
    figure, ax = plt.subplots(figsize=(6.6, 3.2), layout="constrained")
    for i, (model, label, colour) in enumerate(
        (("projective", "conditioned", "#0b6e4f"), ("projective, as it is", "as it is", "#a63d57"))
    ):
        for k, origin_m in enumerate(shown):
            row = results.get(name_of(origin_m), model, 0.5, "iterations")
            if row is None:
                continue
            x = k + 0.16 * (i - 0.5)
            finite = [v for v in (row.q05, row.median, row.q95) if math.isfinite(v)]
            if finite:
                ax.plot([x, x], [finite[0], finite[-1]], color=colour, lw=1.5)
            if math.isfinite(row.median):
                ax.plot([x], [row.median], marker="os"[i], color=colour)
            if row.failed:
                ax.annotate(
                    f"{row.failed} of {row.seeds}\nfail",
                    (x, 0.97),
                    xycoords=("data", "axes fraction"),
                    ha="center",
                    va="top",
                    color=colour,
                    fontsize=8,
                )
        ax.plot([], [], marker="os"[i], color=colour, lw=1.5, label=label)
    ax.set_xticks(range(len(shown)), [f"{m:g}" for m in shown])
    ax.set(xlabel="distance of the world's origin (m)", ylabel="iterations, median and 90 %")
    ax.set_xlim(-0.5, len(shown) - 0.5)
    ax.set_ylim(0, 1.3 * ax.get_ylim()[1])  # room for what failed
    ax.grid(alpha=0.3, axis="y")
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _opportunity(plt: ModuleType, results: Results) -> Any:
    """Formal and honest sigmas of relative pan, pair by pair."""
    models = results.models(OPPORTUNITY)
    if not models:
        return None
    pairs = [
        r.metric.removeprefix("relative_pan_formal_").removesuffix("_mrad")
        for r in results.rows
        if r.experiment == OPPORTUNITY
        and r.model == models[0]
        and r.metric.startswith("relative_pan_formal_")
    ]
    figure, ax = plt.subplots(figsize=(6.0, 3.4), layout="constrained")
    for i, model in enumerate(models):
        for kind, filled in (("formal", False), ("honest", True)):
            rows = [
                results.get(OPPORTUNITY, model, None, f"relative_pan_{kind}_{pair}_mrad") for pair in pairs
            ]
            known = [(k, r.median) for k, r in enumerate(rows) if r is not None and math.isfinite(r.median)]
            ax.plot(
                [k + 0.18 * (i - (len(models) - 1) / 2) for k, _ in known],
                [v for _, v in known],
                marker=_MARKER[model],
                color=_COLOUR[model],
                markerfacecolor=_COLOUR[model] if filled else "none",
                markersize=4 if filled else 10,
                lw=0,
                label=f"{model}, {kind}",
            )
    ax.set_xticks(range(len(pairs)), [f"frames {pair.replace('_', ' and ')}" for pair in pairs])
    ax.set(yscale="log", ylabel="sigma of relative pan (mrad)", xlim=(-0.6, len(pairs) - 0.4))
    ax.grid(alpha=0.3, axis="y")
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
