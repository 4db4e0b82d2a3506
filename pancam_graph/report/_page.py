"""The page: introduction, headline figures, and all sections put together in one file."""

import json

import numpy as np

from pancam_graph.base.geometry import FloatArray, wrap_angle
from pancam_graph.data import Solution
from pancam_graph.mosaic import WrittenMosaics
from pancam_graph.report._cross_validation import cross_validation_section
from pancam_graph.report._escaped import escape
from pancam_graph.report._figures import make_corrections, make_histogram
from pancam_graph.report._images import image_residuals, vector_panels
from pancam_graph.report._look import AFTER, BEFORE, REJECTED, Figure, axis, layout
from pancam_graph.report._map import make_map
from pancam_graph.report._matching import matching_section
from pancam_graph.report._mosaics import mosaic_section
from pancam_graph.report._numbers import Json, fixed, short
from pancam_graph.report._packed import packed, packed_plotly
from pancam_graph.report._rig import rig_section
from pancam_graph.report._scene import make_masts, scene_figure
from pancam_graph.report._script import SCRIPT
from pancam_graph.report._shown_terrain import shown_terrain
from pancam_graph.report._style import STYLE
from pancam_graph.report._tables import image_table, observation_table, stop_table
from pancam_graph.report._template import NO_VECTORS, PAGE, SCENE_CONTROLS, VECTOR_CONTROLS
from pancam_graph.report._terrain import terrain_section
from pancam_graph.report._verdict import verdict_section
from pancam_graph.terrain import WrittenTerrain

__all__ = ["headline", "lead", "make_page"]

_MODELS = {
    "mast": "The cameras are taken to sit firmly on a head that pans and tilts on the mast",
    "circle": "The centre of each camera is taken to run on a circle about the mast",
    "free": "Each image has its own camera position and orientation",
    "projective": "Each image has its own projection matrix",
}
_REASONS = {
    "outlier": "as outliers",
    "single": "of points seen only once",
    "behind": "of points behind a camera",
    "outside": "outside the domain of a camera model",
}


def make_page(
    solution: Solution, mosaics: WrittenMosaics | None = None, terrain: WrittenTerrain | None = None
) -> str:
    """The whole page of a solution as HTML, with its mosaics and its terrain where there are any."""
    table, rows_of = image_residuals(solution)
    points = shown_terrain(solution)
    scene, views = scene_figure(solution, points, make_masts(solution))
    map_figure, histogram = make_map(solution, points), make_histogram(solution)
    corrections = make_corrections(solution)
    panels = vector_panels(solution, table, rows_of)
    vectors = _vector_figure(len(panels), seen=sum(e.used + e.rejected > 0 for e in table))
    rig, rig_figures = rig_section(solution)
    figures = [scene, map_figure, histogram, corrections, *rig_figures, *([vectors] if panels else [])]
    data = {
        "figures": [figure.json() for figure in figures],
        "views": views,
        "vectors": panels,
        "colours": {"used": AFTER, "rejected": REJECTED, "frame": BEFORE},
    }
    title = f"Adjustment of {solution.traverse.name}"
    return PAGE.format(
        title=escape(title),
        style=STYLE,
        lead=escape(lead(solution)),
        verdict=verdict_section(solution.verdict),
        warnings=_warnings(solution),
        headline=_headline_list(solution),
        scene=_section("Scene", scene, SCENE_CONTROLS),
        map=_section("Map", map_figure),
        histogram=_section("Residuals before and after", histogram),
        vectors=_section("Residuals in single images", vectors, VECTOR_CONTROLS) if panels else NO_VECTORS,
        mosaics=mosaic_section(mosaics),
        terrain=terrain_section(terrain, "terrain/") if terrain is not None else "",
        corrections=_section("Corrections of pan and tilt", corrections),
        cross_validation=cross_validation_section(solution.cross_validation, solution.traverse),
        observations=observation_table(solution),
        matching=matching_section(solution.traverse),
        images=image_table(solution, table),
        stops=stop_table(solution),
        rig=rig,
        plotly=packed_plotly(),
        figures=packed(json.dumps(data, separators=(",", ":"), allow_nan=False)),
        script=SCRIPT,
    )


def _counted(n: int, noun: str) -> str:
    return f"{n:,} {noun}" if n == 1 else f"{n:,} {noun}s"


def lead(solution: Solution) -> str:
    """What was adjusted, for a reader who has never seen the program."""
    traverse = solution.traverse
    eyes = len(set(traverse.image_eye.tolist()))
    used = int(solution.used.sum())
    freed = "stands, how it points" if solution.model == "mast" else "stands, where its cameras are and look"
    text = (
        f"{_counted(len(traverse.images), 'image')} that {_counted(eyes, 'camera')} of the mast rig "
        f"“{traverse.rig.name}” took at {_counted(len(traverse.stops), 'stop')} were adjusted together "
        f"(a bundle adjustment): estimates of where the mast {freed} and where "
        f"{_counted(len(solution.landmark_track), 'terrain point')} lie were refined until the points, "
        f"seen through the cameras, fell as closely as possible on the {used:,} pixels measured."
    )
    if solution.model in _MODELS:
        text += f" {_MODELS[solution.model]} (model “{solution.model}”)."
    return text


def headline(solution: Solution) -> list[tuple[str, str, str, bool]]:
    """Headline figures: name, value, remark, and whether it is bad news."""
    used = int(solution.used.sum())
    rejected = len(solution.used) - used
    whys = [why for ok, why in zip(solution.used.tolist(), solution.reason, strict=True) if not ok]
    kinds = sorted({why for why in whys if why})
    remark = ", ".join(f"{whys.count(why):,} {_REASONS.get(why, why)}" for why in kinds)
    if len(kinds) == 1:
        remark = _REASONS.get(kinds[0], kinds[0])
    seconds = solution.seconds
    parts = (("reading", seconds.read), ("start", seconds.initialise), ("solving", seconds.solve))
    share = 100 * rejected / max(len(solution.used), 1)
    return [
        *_pointing(solution),
        (
            "residual, RMS",
            f"{short(solution.rms_initial_px)} → {short(solution.rms_final_px)} px",
            "length of the residual vectors of the observations used",
            False,
        ),
        (
            "cost",
            f"{short(solution.cost_initial)} → {short(solution.cost_final)}",
            "half the sum of squares in units of sigma, priors included",
            False,
        ),
        (
            "observations",
            f"{used:,} used",
            f"{rejected:,} rejected ({share:.1f} %){': ' + remark if remark else ''}",
            used == 0,
        ),
        (
            "outcome",
            _outcome(solution),
            f"{solution.stop_reason}; {_counted(solution.iterations, 'iteration')}",
            not solution.passed,
        ),
        (
            "time",
            f"{fixed(sum(s for _, s in parts), 1)} s",
            ", ".join(f"{name} {fixed(s, 1)} s" for name, s in parts),
            False,
        ),
    ]


def _pointing(solution: Solution) -> list[tuple[str, str, str, bool]]:
    """How far pan and tilt moved; nothing where no frame has both.

    A turn that all frames of a stop share is mostly an error of the rover's heading, or of the encoders'
    zero: what a panorama gains is the movement between neighbouring frames.
    """
    moved_mrad = 1e3 * wrap_angle(solution.correction_rad)
    if not np.isfinite(moved_mrad).all(axis=1).any():
        return []
    same_stop = np.diff(solution.traverse.frame_stop) == 0
    pan, tilt = (short(v) for v in _rms(moved_mrad))
    remark = "RMS of all frames; "
    if same_stop.any():
        pan_apart, tilt_apart = (short(v) for v in _rms(np.diff(moved_mrad, axis=0)[same_stop]))
        remark += f"between neighbouring frames of a stop {pan_apart} and {tilt_apart} mrad; "
    known = [s for s in solution.angle_sigma_rad.T if (np.isfinite(s) & (s > 0)).any()]
    sigmas = " and ".join(short(1e3 * float(np.median(s[np.isfinite(s) & (s > 0)]))) for s in known)
    remark += f"formal sigma now {sigmas} mrad (median)" if known else "held by the telemetry"
    return [("pan and tilt moved by", f"{pan} and {tilt} mrad", remark, False)]


def _rms(values: FloatArray) -> FloatArray:
    """Root mean squares of the finite numbers in each column (n, k); NaN where none is."""
    finite = np.isfinite(values)
    squares = np.where(finite, values, 0.0) ** 2
    counted = finite.sum(axis=0)
    return np.asarray(np.sqrt(np.where(counted > 0, squares.sum(axis=0) / np.maximum(counted, 1), np.nan)))


def _outcome(solution: Solution) -> str:
    if not solution.converged:
        return "not converged"
    return "converged" if solution.passed else "converged, failed its tests"


def _headline_list(solution: Solution) -> str:
    entries = [
        f'<div><dt>{escape(name)}</dt><dd class="value{" bad" if bad else ""}">{escape(value)}</dd>'
        f'<dd class="note">{escape(remark)}</dd></div>'
        for name, value, remark, bad in headline(solution)
    ]
    return "\n".join(entries)


def _warnings(solution: Solution) -> str:
    if not solution.warnings:
        return ""
    items = "\n".join(f"<li>{escape(w)}</li>" for w in solution.warnings)
    return (
        f'<div class="warnings" role="note">\n<h2>{_counted(len(solution.warnings), "warning")}</h2>\n'
        f"<ul>\n{items}\n</ul>\n</div>"
    )


def _section(head: str, figure: Figure, controls: str = "") -> str:
    return (
        f"<section>\n<h2>{escape(head)}</h2>\n{controls}"
        f'<div class="plot" id="{figure.id}" role="group" aria-label="{escape(head)}"></div>\n'
        f'<p class="caption">{escape(figure.caption)}</p>\n</section>'
    )


def _vector_figure(shown: int, *, seen: int) -> Figure:
    """The empty panels; the page's script fills them with the image that the reader chooses."""
    axes: Json = {}
    for suffix, domain in (("", [0.0, 0.485]), ("2", [0.515, 1.0])):
        axes[f"xaxis{suffix}"] = axis("u (px)", domain=domain, zeroline=False, showgrid=False)
        axes[f"yaxis{suffix}"] = axis("v (px)", zeroline=False, showgrid=False)
        axes[f"xaxis{suffix}"]["constrain"] = axes[f"yaxis{suffix}"]["constrain"] = "domain"
        axes[f"yaxis{suffix}"]["constraintoward"] = "top"
        axes[f"yaxis{suffix}"]["anchor"] = f"x{suffix}"
        axes[f"xaxis{suffix}"]["anchor"] = f"y{suffix}"
    axes["yaxis"]["scaleanchor"] = "x"
    axes["xaxis2"]["matches"], axes["yaxis2"]["matches"] = "x", "y"
    axes["yaxis2"] |= {"showticklabels": False, "title": {"text": ""}}
    caption = (
        "Each line leads from the measured pixel (dot) towards where the point projects, enlarged as stated. "
        "What is left should look random; a common direction or a swirl hints at a wrong calibration or pose."
    )
    if shown < seen:
        caption += f" Of {seen:,} images, the {shown:,} with the largest residuals can be chosen."
    return Figure(
        id="vectors",
        traces=(),
        layout=layout(
            **axes,
            margin={"l": 60, "r": 15, "t": 45, "b": 85},
            legend={
                "orientation": "h",
                "x": 0,
                "y": 0,
                "yref": "container",
                "yanchor": "bottom",
                "itemsizing": "constant",
            },
        ),
        caption=caption,
    )
