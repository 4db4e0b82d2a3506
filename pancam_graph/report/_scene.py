"""The 3D scene: masts, the circles on which their eyes run, camera frustums and landmarks."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray, pose_arrays
from pancam_graph.data import Solution
from pancam_graph.report._escaped import escape
from pancam_graph.report._look import EYES, GRID, INK, RESIDUAL_SCALE, Figure, layout
from pancam_graph.report._numbers import Json, decimals_for, polyline, round_factor, rounded, short, thinned
from pancam_graph.report._shown_terrain import ShownTerrain
from pancam_graph.rigs import Rig

__all__ = ["Masts", "eye_circles", "frustums", "label_stops", "make_masts", "near_spacing", "scene_figure"]

_MAX_LANDMARKS = 20_000
_MAX_FRUSTUMS = 1_000
_CIRCLE_STEPS = 48
_DASHES = ("solid", "dash", "dot")
_TILT_STEP_RAD = np.deg2rad(2.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Masts:
    """Circles and frustums of all masts, in the world and at true size."""

    circles: FloatArray
    """(circles, steps, 3) closed circles of eye centres."""
    circle_eye: IntArray
    """(circles,) index of the eye of each."""
    circle_stop: IntArray
    """(circles,) row of the stop of each."""
    frustums: FloatArray
    """(frustums, 12, 3) strips with gaps (NaN) inside."""
    frustum_image: IntArray
    """(frustums,) row of the image of each."""
    reach_m: float
    """Largest distance of a circle or frustum from its mast's origin."""


def eye_circles(solution: Solution) -> tuple[FloatArray, IntArray, IntArray]:
    """Circles on which the eyes' centres run (thesis eq. 4.8), as adjusted.

    One circle per stop, eye and group of tilts within two degrees: about the pan axis of the adjusted mast,
    with the mean radius and height of the adjusted centres. So there is a circle for every model; with models
    that bind the centres to the mast, the centres lie on it. Returns outlines (n, steps, 3) in the world,
    stops (n,) and eyes (n,).
    """
    traverse, state = solution.traverse, solution.final
    stops_R, stops_t = pose_arrays(state.world_T_mast)
    stop = traverse.image_stop
    mast_t_camera = np.einsum("nji,nj->ni", stops_R[stop], state.world_t_camera - stops_t[stop])
    tilt = np.round(state.pan_tilt_rad[traverse.image_frame, 1] / _TILT_STEP_RAD)
    finite = np.isfinite(mast_t_camera).all(axis=1) & np.isfinite(tilt)
    keys = np.column_stack([stop, traverse.image_eye, tilt])[finite].astype(np.int64)
    angle = np.linspace(0, 2 * np.pi, _CIRCLE_STEPS + 1)
    outlines, groups = [], np.unique(keys, axis=0)
    for s, eye, t in groups:
        members = mast_t_camera[(stop == s) & (traverse.image_eye == eye) & (tilt == t)]
        radius, height = np.nanmean(np.hypot(members[:, 0], members[:, 1])), np.nanmean(members[:, 2])
        in_mast = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle + height])
        outlines.append(in_mast @ stops_R[s].T + stops_t[s])
    return np.array(outlines).reshape(-1, _CIRCLE_STEPS + 1, 3), groups[:, 0], groups[:, 1]


def frustums(
    rig: Rig, eye: IntArray, world_R_camera: FloatArray, world_t_camera: FloatArray, depth_m: float
) -> FloatArray:
    """Frustum of each image as a strip (n, 12, 3): far side, apex and edges, with gaps of NaN."""
    corners = []
    for one in rig.eyes:
        width, height = one.camera.width_px - 0.5, one.camera.height_px - 0.5
        corner_px = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
        rays = one.camera.pinhole.unproject(corner_px).direction
        corners.append(rays / np.maximum(rays[:, 2:], 0.2) * depth_m)
    nan, apex = np.full(3, np.nan), np.zeros(3)
    in_camera = np.array([[*c, c[0], apex, c[1], nan, c[2], apex, c[3], nan] for c in corners])
    return np.asarray(np.einsum("nij,nkj->nki", world_R_camera, in_camera[eye]) + world_t_camera[:, None])


def make_masts(solution: Solution) -> Masts:
    """Circles and frustums of a solution at true size; frustums of evenly chosen images if very many."""
    traverse, state = solution.traverse, solution.final
    circles, circle_stop, circle_eye = eye_circles(solution)
    _, stops_t = pose_arrays(state.world_T_mast)
    offset = np.linalg.norm(state.world_t_camera - stops_t[traverse.image_stop], axis=1)
    finite = np.isfinite(state.world_R_camera).all(axis=(1, 2)) & np.isfinite(offset)
    size_m = max(float(np.quantile(offset[finite], 0.9)) if finite.any() else 0.0, 0.1)
    rows = np.flatnonzero(finite)
    rows = rows[thinned(len(rows), _MAX_FRUSTUMS)]
    return Masts(
        circles=circles,
        circle_eye=circle_eye,
        circle_stop=circle_stop,
        frustums=frustums(
            traverse.rig,
            traverse.image_eye[rows],
            state.world_R_camera[rows],
            state.world_t_camera[rows],
            1.5 * size_m,
        ),
        frustum_image=rows,
        reach_m=2.7 * size_m,
    )


def near_spacing(stops_m: FloatArray) -> float:
    """Least distance between two stops (n, 3) that are not in one place; infinite for a single stop."""
    best = np.inf
    for i in range(len(stops_m) - 1):
        distance = np.linalg.norm(stops_m[i + 1 :] - stops_m[i], axis=1)
        best = min([best, *distance[distance > 1e-3].tolist()])
    return float(best)


def label_stops(stops_m: FloatArray, apart_m: float) -> list[int]:
    """Rows of stops that get a label: each is at the least distance or farther from those labelled before."""
    labelled: list[int] = []
    for row, stop in enumerate(stops_m):
        if all(np.linalg.norm((stops_m[other] - stop)[:2]) >= apart_m for other in labelled):
            labelled.append(row)
    return labelled


def _mast_traces(
    solution: Solution, masts: Masts, terrain: ShownTerrain, enlarged: float, *, near: bool
) -> list[Json]:
    """Circles and frustums, one trace of each per eye, enlarged about their masts' origins."""
    traverse = solution.traverse
    _, stops_m = pose_arrays(solution.final.world_T_mast)
    decimals = decimals_for(masts.reach_m * enlarged)

    def drawn(strips: FloatArray, stop: IntArray) -> FloatArray:
        centre = stops_m[stop][:, None]
        return centre + enlarged * (strips - centre) - terrain.origin_m

    image = masts.frustum_image
    pale = 0.6 if near or len(image) <= 12 * len(traverse.stops) else 0.3
    traces: list[Json] = []
    for index, eye in enumerate(traverse.rig.eyes):
        colour, name, dash = EYES[index % len(EYES)], escape(eye.name), _DASHES[index % len(_DASHES)]
        of_circle, of_frustum = masts.circle_eye == index, traverse.image_eye[image] == index
        kinds = (
            ("camera", drawn(masts.frustums[of_frustum], traverse.image_stop[image[of_frustum]]), 1.5, pale),
            ("circle", drawn(masts.circles[of_circle], masts.circle_stop[of_circle]), 4, 1.0),
        )
        for kind, strips, width, opacity in kinds:
            if not len(strips):
                continue
            x, y, z = polyline(strips, decimals)
            traces.append(
                {
                    "type": "scatter3d",
                    "mode": "lines",
                    "x": x,
                    "y": y,
                    "z": z,
                    # Circles of eyes at one height and radius coincide: between dashes the first can be seen.
                    "line": {"color": colour, "width": width, "dash": dash if kind == "circle" else "solid"},
                    "opacity": opacity,
                    "name": f"{name}: images" if kind == "camera" else f"{name}: circle of its centre",
                    "hoverinfo": "skip",
                    "visible": not near,
                }
            )
    return traces


def _stop_traces(solution: Solution, terrain: ShownTerrain) -> list[Json]:
    """Poles down to the ground, and a mark with its name on each mast's origin."""
    stops_R, stops_m = pose_arrays(solution.final.world_T_mast)
    at = stops_m - terrain.origin_m
    decimals = decimals_for(terrain.extent_m) + 1
    feet = at - solution.traverse.rig.mast_height_m * stops_R[:, :, 2]
    x, y, z = polyline(np.stack([at, feet], axis=1), decimals)
    names = [escape(s.id) for s in solution.traverse.stops]
    pole: Json = {
        "type": "scatter3d",
        "mode": "lines",
        "x": x,
        "y": y,
        "z": z,
        "line": {"color": INK, "width": 4},
        "name": "mast",
        "hoverinfo": "skip",
        "showlegend": False,
    }
    mark: Json = {
        "type": "scatter3d",
        "mode": "markers",
        "x": rounded(at[:, 0], decimals),
        "y": rounded(at[:, 1], decimals),
        "z": rounded(at[:, 2], decimals),
        "text": names,
        "hovertemplate": "stop %{text}<br>x %{x} m, y %{y} m, z %{z} m<extra></extra>",
        "marker": {"size": 3.5, "color": INK},
        "name": "stop (mast)",
    }
    return [pole, mark]


def _stop_labels(solution: Solution, terrain: ShownTerrain) -> list[Json]:
    """Names above the masts, each on a background that hides what is behind it."""
    _, stops_m = pose_arrays(solution.final.world_T_mast)
    at = (stops_m - terrain.origin_m).round(4).tolist()
    return [
        {
            "x": at[row][0],
            "y": at[row][1],
            "z": at[row][2],
            "text": escape(solution.traverse.stops[row].id),
            "ax": 0,
            "ay": -52,
            "arrowcolor": INK,
            "arrowwidth": 1,
            "arrowhead": 0,
            "bgcolor": "rgba(255,255,255,0.85)",
            "borderpad": 1,
        }
        for row in label_stops(stops_m, 0.1 * terrain.extent_m)
    ]


def _landmark_trace(solution: Solution, terrain: ShownTerrain) -> Json:
    """Landmarks coloured by their residual."""
    keep = thinned(len(terrain.points_m), _MAX_LANDMARKS)
    decimals = decimals_for(terrain.extent_m)
    points, residual = terrain.points_m[keep], terrain.residual_px[keep]
    return {
        "type": "scatter3d",
        "mode": "markers",
        "x": rounded(points[:, 0], decimals),
        "y": rounded(points[:, 1], decimals),
        "z": rounded(points[:, 2], decimals),
        "customdata": solution.landmark_track[terrain.rows[keep]].tolist(),
        "hovertemplate": "track %{customdata}: %{marker.color} px<extra></extra>",
        "name": "landmark",
        "marker": {
            "size": 2.2,
            "color": rounded(residual, decimals_for(terrain.residual_limit_px)),
            "colorscale": RESIDUAL_SCALE,
            "cmin": 0,
            "cmax": terrain.residual_limit_px,
            "colorbar": {
                "title": {"text": "residual (px)", "side": "right"},
                "thickness": 14,
                "len": 0.8,
                "x": 1.0,
                "outlinewidth": 0,
                "exponentformat": "power",
            },
        },
    }


def _view(name: str, low: FloatArray, high: FloatArray, *, true_size: bool) -> Json:
    """Ranges and shape of a view, all axes to one scale."""
    side = high - low
    # A long and narrow scene is looked at across its length and can be drawn larger.
    wide = 0.8 if true_size else 1.25 + 0.4 * (1 - side[:2].min() / side[:2].max())
    ratio = wide * side / side.max()
    return {
        "name": name,
        "true_size": true_size,
        "range": [[float(f"{a:.6g}"), float(f"{b:.6g}")] for a, b in zip(low, high, strict=True)],
        "ticks": np.maximum(4, np.round(9 * side / side.max())).astype(int).tolist(),
        "ratio": dict(zip("xyz", np.round(ratio, 4).tolist(), strict=True)),
    }


def _camera(side: FloatArray) -> Json:
    """Where the reader looks from at first: from above, across the longer horizontal side (3,)."""
    across = np.array([side[1], side[0]]) + 0.25 * side[:2].max()
    x, y = -1.32 * across / np.linalg.norm(across)
    lower = -0.21 * side[:2].min() / side[:2].max()
    return {
        "eye": {"x": round(float(x), 3), "y": round(float(y), 3), "z": 0.6},
        "center": {"x": 0.0, "y": 0.0, "z": round(float(lower), 3)},
    }


def scene_figure(solution: Solution, terrain: ShownTerrain, masts: Masts) -> tuple[Figure, list[Json]]:
    """The scene, and its views: everything, and each mast at true size.

    Masts are centimetres in a scene of tens of metres, so in the view of everything circles and frustums
    are enlarged about their mast's origin by a stated factor. A view that shows the masts at true size
    takes the traces marked `near`, the other those marked `far`.
    """
    traverse = solution.traverse
    _, stops_m = pose_arrays(solution.final.world_T_mast)
    room_m = min(0.07 * terrain.extent_m, 0.4 * near_spacing(stops_m))
    enlarged = round_factor(room_m / masts.reach_m)
    always = [_landmark_trace(solution, terrain), *_stop_traces(solution, terrain)]
    far = _mast_traces(solution, masts, terrain, enlarged, near=False)
    near = _mast_traces(solution, masts, terrain, 1.0, near=True)
    roles = ["always"] * len(always) + ["far"] * len(far) + ["near"] * len(near)
    traces = [{**t, "meta": role} for t, role in zip([*always, *far, *near], roles, strict=True)]
    views = [_view("All stops", terrain.low_m, terrain.high_m, true_size=False)]
    for stop, centre in zip(traverse.stops, stops_m - terrain.origin_m, strict=True):
        reach = masts.reach_m
        views.append(_view(f"Mast at {stop.id}", centre - reach, centre + reach, true_size=True))
    first = views[0]
    axes = {
        f"{name}axis": {
            "title": {"text": f"{name} (m)"},
            "range": bounds,
            "gridcolor": GRID,
            "zerolinecolor": GRID,
            "showbackground": False,
            "nticks": ticks,
            "showspikes": False,
        }
        for name, bounds, ticks in zip("xyz", first["range"], first["ticks"], strict=True)
    }
    figure = Figure(
        id="scene",
        traces=tuple(traces),
        layout=layout(
            margin={"l": 0, "r": 0, "t": 0, "b": 0},
            scene={
                **axes,
                "aspectmode": "manual",
                "aspectratio": first["ratio"],
                "camera": _camera(terrain.high_m - terrain.low_m),
                "annotations": _stop_labels(solution, terrain),
            },
            legend={"x": 0.01, "y": 0.99, "itemsizing": "constant", "bgcolor": "rgba(255,255,255,0.8)"},
        ),
        caption=_caption(solution, terrain, masts, enlarged),
    )
    return figure, views


def _caption(solution: Solution, terrain: ShownTerrain, masts: Masts, enlarged: float) -> str:
    """The caption: what the scene shows and leaves out."""
    shown = min(len(terrain.points_m), _MAX_LANDMARKS)
    parts = [
        f"{shown:,} landmarks, coloured by the RMS residual of their observations after the adjustment "
        f"(colours end at {short(terrain.residual_limit_px)} px)."
    ]
    if len(terrain.points_m) > _MAX_LANDMARKS:
        parts.append(f"They are an even choice among {len(terrain.points_m):,}.")
    if terrain.outside:
        parts.append(f"{terrain.outside:,} more lie outside the box, most of them farther away.")
    if terrain.unusable:
        parts.append(f"{terrain.unusable:,} have no usable point and are not drawn.")
    parts.append(
        "Each circle is the one on which the centre of an eye runs as the mast pans; pyramids are images."
    )
    if enlarged > 1:
        parts.append(
            f"In the view of all stops both are drawn {enlarged:,.0f} times larger than they are; "
            "the view of one mast shows them at true size."
        )
    if len(solution.traverse.images) > len(masts.frustum_image):
        parts.append(f"Pyramids of {len(masts.frustum_image):,} images are drawn.")
    if terrain.origin_m.any():
        x, y, z = terrain.origin_m
        parts.append(f"Coordinates count from ({x:,.0f}, {y:,.0f}, {z:,.0f}) m in the world.")
    return " ".join(parts)
