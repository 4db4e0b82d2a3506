"""The map: stops with their uncertainty ellipses, viewing directions and landmarks from above."""

import numpy as np

from pancam_graph.base.ellipses import RADIUS_95, ellipse_outlines, translation_covariance_in_world
from pancam_graph.base.geometry import FloatArray, pose_arrays
from pancam_graph.data import Site, Solution
from pancam_graph.report._escaped import escape
from pancam_graph.report._look import AFTER, BEFORE, INK, RESIDUAL_SCALE, Figure, axis, layout
from pancam_graph.report._numbers import Json, decimals_for, polyline, round_factor, rounded, short, thinned
from pancam_graph.report._scene import near_spacing
from pancam_graph.report._shown_terrain import ShownTerrain

__all__ = ["make_map", "place_labels"]

_MAX_LANDMARKS = 4_000
_WIDTH_PX = 480
"""Least width of the map's drawing area at laptop size, for the room that labels need."""


def place_labels(at_m: FloatArray, sizes_m: list[FloatArray], *, clear_m: float) -> dict[int, FloatArray]:
    """Centres of the labels of stops (n, 2), by row, so that none covers a stop or another label.

    A label of size (width, height) goes below, above, right or left of its stop, `clear_m` away; one
    that would cover something on every side is left out.
    """
    placed: dict[int, FloatArray] = {}
    for row, (stop, size) in enumerate(zip(at_m, sizes_m, strict=True)):
        up, right = np.array([0.0, clear_m + size[1] / 2]), np.array([clear_m + size[0] / 2, 0.0])
        for centre in (stop - up, stop + up, stop + right, stop - right):
            covers_stop = np.any(np.all(np.abs(at_m - centre) < size / 2 + 0.25 * clear_m, axis=1))
            covers_label = any(
                np.all(np.abs(other - centre) < (size + sizes_m[i]) / 2) for i, other in placed.items()
            )
            if not covers_stop and not covers_label:
                placed[row] = centre
                break
    return placed


def _north_up(solution: Solution) -> FloatArray:
    """(2, 2) turn from the world's x and y to east and north; nothing is turned without a site."""
    site = solution.traverse.site
    return np.eye(2) if site is None else site.level_R_world[:2, :2]


def _landmark_trace(terrain: ShownTerrain, turn: FloatArray) -> Json:
    points = terrain.points_m[:, :2] @ turn.T
    keep = thinned(len(terrain.points_m), _MAX_LANDMARKS)
    decimals = decimals_for(terrain.extent_m)
    return {
        "type": "scatter",
        "mode": "markers",
        "x": rounded(points[keep, 0], decimals),
        "y": rounded(points[keep, 1], decimals),
        "marker": {
            "size": 3,
            "opacity": 0.7,
            "color": rounded(terrain.residual_px[keep], decimals_for(terrain.residual_limit_px)),
            "colorscale": RESIDUAL_SCALE,
            "cmin": 0,
            "cmax": terrain.residual_limit_px,
        },
        "hoverinfo": "skip",
        "name": "landmark",
    }


def _direction_trace(solution: Solution, terrain: ShownTerrain, length_m: float, turn: FloatArray) -> Json:
    """A line from the mast along each frame's mean line of sight."""
    traverse = solution.traverse
    sight = np.zeros((len(traverse.frames), 2))
    np.add.at(sight, traverse.image_frame, solution.final.world_R_camera[:, :2, 2])
    norm = np.linalg.norm(sight, axis=1)
    seen = norm > 1e-6  # this is False for NaN too
    _, stops_m = pose_arrays(solution.final.world_T_mast)
    start = (stops_m - terrain.origin_m)[traverse.frame_stop[seen], :2]
    end = start + length_m * sight[seen] / norm[seen, None]
    x, y = polyline(np.stack([start, end], axis=1) @ turn.T, decimals_for(terrain.extent_m) + 1)
    line = {"color": BEFORE, "width": 1}
    name = "frame: viewing direction"
    return {
        "type": "scatter",
        "mode": "lines",
        "x": x,
        "y": y,
        "line": line,
        "hoverinfo": "skip",
        "name": name,
    }


def make_map(solution: Solution, terrain: ShownTerrain) -> Figure:
    """The map of a solution, over the ground plan of the scene's box.

    Ellipses hold 95 % of the formal uncertainty, body covariances turned to the world; where they are too
    small to be seen they are enlarged by a factor that the caption states. A held stop has none. North is up
    where the traverse has a site.
    """
    traverse, turn = solution.traverse, _north_up(solution)
    stops_R, stops_m = pose_arrays(solution.final.world_T_mast)
    at = (stops_m[:, :2] - terrain.origin_m[:2]) @ turn.T
    decimals = decimals_for(terrain.extent_m) + 1
    covariance = translation_covariance_in_world(stops_R, solution.stop_covariance)[:, :2, :2]
    covariance = turn @ covariance @ turn.T
    uncertain = np.isfinite(covariance).all(axis=(1, 2)) & (np.trace(covariance, axis1=1, axis2=2) > 0)
    outlines = ellipse_outlines(covariance[uncertain], RADIUS_95)
    largest_m = float(np.linalg.norm(outlines, axis=2).max()) if len(outlines) else 0.0
    room_m = min(0.05 * terrain.extent_m, 0.45 * near_spacing(stops_m))
    enlarged = round_factor(room_m / largest_m) if 0 < largest_m < 0.2 * room_m else 1.0
    traces = [_landmark_trace(terrain, turn), _direction_trace(solution, terrain, 0.9 * room_m, turn)]
    if len(outlines):
        x, y = polyline(at[uncertain][:, None] + enlarged * outlines, decimals)
        times = f", {enlarged:,.0f} times enlarged" if enlarged > 1 else ""
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": x,
                "y": y,
                "fill": "toself",
                "fillcolor": "rgba(0,114,178,0.22)",
                "line": {"color": AFTER, "width": 2},
                "hoverinfo": "skip",
                "name": f"95 % ellipse{times}",
            }
        )
    east, north = ("x", "y") if traverse.site is None else ("east", "north")
    names = [escape(s.id) for s in traverse.stops]
    for name, chosen, symbol in (("stop", uncertain, "circle"), ("stop, held", ~uncertain, "square-open")):
        rows = np.flatnonzero(chosen).tolist()
        if rows:
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "x": rounded(at[rows, 0], decimals),
                    "y": rounded(at[rows, 1], decimals),
                    "marker": {"size": 8, "color": INK, "symbol": symbol, "line": {"width": 2, "color": INK}},
                    "text": [names[row] for row in rows],
                    "hovertemplate": f"stop %{{text}}<br>{east} %{{x}} m, {north} %{{y}} m<extra></extra>",
                    "name": name,
                }
            )
    px_m = _WIDTH_PX / terrain.extent_m
    sizes = [np.array([7.5 * len(s.id) + 6, 19.0]) / px_m for s in traverse.stops]
    labels = [
        {
            "x": round(float(x), 4),
            "y": round(float(y), 4),
            "text": names[row],
            "showarrow": False,
            "bgcolor": "rgba(255,255,255,0.85)",
            "borderpad": 1,
        }
        for row, (x, y) in place_labels(at, sizes, clear_m=1.1 * room_m).items()
    ]
    ends = np.array([terrain.low_m[:2], terrain.high_m[:2]])
    corners = ends[[[0, 0], [0, 1], [1, 0], [1, 1]], [0, 1]] @ turn.T
    caption = _caption(terrain, enlarged, largest_m, held=int(np.sum(~uncertain)))
    low, high = corners.min(axis=0).round(6).tolist(), corners.max(axis=0).round(6).tolist()
    return Figure(
        id="map",
        traces=tuple(traces),
        layout=layout(
            xaxis=axis(f"{east} (m)", range=[low[0], high[0]], zeroline=False),
            yaxis=axis(f"{north} (m)", range=[low[1], high[1]], zeroline=False, scaleanchor="x"),
            annotations=labels,
            margin={"l": 60, "r": 15, "t": 32, "b": 110},
            legend={"orientation": "h", "x": 0, "y": -0.15, "yanchor": "top", "itemsizing": "constant"},
        ),
        caption=f"{caption} {_where(traverse.site)}",
    )


def _where(site: Site | None) -> str:
    """What is up, and where the place is."""
    if site is None:
        return "Axes are those of the local frame; where north is, is not told (site)."
    latitude = f"{abs(site.latitude_deg):.5f}\N{DEGREE SIGN} {'N' if site.latitude_deg >= 0 else 'S'}"
    longitude = f"{site.longitude_deg % 360:.5f}\N{DEGREE SIGN} E"
    kind = "" if site.shape.is_geodetic else ", planetocentric"
    return f"North is up. The world's origin is on {site.body} at {latitude}, {longitude}{kind}."


def _caption(terrain: ShownTerrain, enlarged: float, largest_m: float, *, held: int) -> str:
    parts = ["Seen from above; landmarks in the colours of the scene."]
    if largest_m > 0:
        size = f"{short(largest_m * 1000)} mm" if largest_m < 1 else f"{short(largest_m)} m"
        parts.append(f"Ellipses hold 95 % of a stop's formal uncertainty; the longest half axis is {size}.")
    if enlarged > 1:
        parts.append(f"They are drawn {enlarged:,.0f} times larger than they are.")
    if held:
        parts.append(
            "An open square is a stop that is held, or whose uncertainty is not known: it has no ellipse."
        )
    if len(terrain.points_m) > _MAX_LANDMARKS:
        parts.append(f"{_MAX_LANDMARKS:,} landmarks are drawn, evenly chosen.")
    return " ".join(parts)
