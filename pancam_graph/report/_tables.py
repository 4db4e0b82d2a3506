"""Tables of images and stops, as HTML that is read without any script."""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.ellipses import translation_covariance_in_world
from pancam_graph.base.geometry import pose_arrays
from pancam_graph.data import Solution
from pancam_graph.report._escaped import escape
from pancam_graph.report._images import ImageResiduals
from pancam_graph.report._numbers import fixed

__all__ = ["image_table", "observation_table", "stop_table", "table"]

_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"


def table(
    name: str,
    columns: Sequence[tuple[str, str]],
    rows: Sequence[Sequence[str]],
    texts: int,
    *,
    marks: Sequence[str] | None = None,
) -> str:
    """A scrollable table whose columns are sorted when their heads are pressed.

    `columns` are heads and their explanations; the first `texts` columns hold text, the others numbers.
    `marks` are classes of the rows, "" for none. Everything is escaped here.
    """
    kinds = ["text" if i < texts else "number" for i in range(len(columns))]
    heads = "".join(
        f'<th scope="col" class="{kind}">'
        f'<button type="button" title="{escape(why)}">{escape(head)}</button></th>'
        for (head, why), kind in zip(columns, kinds, strict=True)
    )
    body = "\n".join(
        (f'<tr class="{mark}">' if mark else "<tr>")
        + "".join(f'<td class="{k}">{escape(c)}</td>' for c, k in zip(row, kinds, strict=True))
        + "</tr>"
        for row, mark in zip(rows, marks or [""] * len(rows), strict=True)
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(name)}">\n'
        f'<table class="sortable">\n'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>\n</div>"
    )


def image_table(solution: Solution, residuals: Sequence[ImageResiduals]) -> str:
    """One row per image: its observations and residuals."""
    traverse = solution.traverse
    columns = (
        ("image", "id of the image"),
        ("stop", "id of its stop"),
        ("camera", "name of the eye"),
        ("used", "observations that took part"),
        ("rejected", "observations left out: outliers, points seen once, points behind a camera"),
        ("RMS before (px)", "root mean square length of the residuals of the used observations at the start"),
        ("RMS after (px)", "the same at the end"),
        ("median after (px)", "median length of the residuals of the used observations at the end"),
    )
    rows = [
        (
            image.id,
            traverse.stops[int(stop)].id,
            image.camera,
            str(entry.used),
            str(entry.rejected),
            fixed(entry.before_px, 3),
            fixed(entry.after_px, 3),
            fixed(entry.median_px, 3),
        )
        for image, stop, entry in zip(traverse.images, traverse.image_stop, residuals, strict=True)
    ]
    return table("Images", columns, rows, texts=3)


def observation_table(solution: Solution) -> str:
    """Observations of points that one stop sees and that several see: how many were used, and why not."""
    columns = (
        ("points seen by", "whether a point was matched in images of one stop only, or of several"),
        ("points", "terrain points"),
        ("observations", "found in the images, or given"),
        ("used", "observations that took part"),
        ("inliers (%)", "share of the observations that took part"),
        ("outliers", "contradict the other observations of their point by more than noise explains"),
        ("single", "of points that no other image sees"),
        ("behind", "of points that came to lie behind the camera"),
        ("outside", "beyond what the camera's model describes"),
        ("came back", "of those used: set aside in between, and let in again when they fitted"),
    )
    traverse, observations = solution.traverse, solution.traverse.observations
    if observations is None or not len(observations):
        return table("Observations", columns, [], texts=1)
    _, track = np.unique(observations.track, return_inverse=True)
    stop = traverse.image_stop[observations.image]
    lowest, highest = np.full(track.max() + 1, len(traverse.stops)), np.full(track.max() + 1, -1)
    np.minimum.at(lowest, track, stop)
    np.maximum.at(highest, track, stop)
    several, reason = lowest != highest, np.array(solution.reason)
    came_back = np.zeros(len(observations), dtype=bool) if solution.came_back is None else solution.came_back
    rows = []
    for name, which in (
        ("one stop", ~several),
        ("several stops", several),
        ("all", np.full_like(several, True)),
    ):
        of_tracks = which[track]
        used, total = int(np.sum(solution.used & of_tracks)), int(of_tracks.sum())
        counts = [
            int(np.sum(of_tracks & (reason == why))) for why in ("outlier", "single", "behind", "outside")
        ]
        share = fixed(100 * used / total, 1) if total else ""
        counts.append(int(np.sum(came_back & of_tracks)))
        numbers = [str(int(which.sum())), str(total), str(used), share, *(str(c) for c in counts)]
        rows.append((name, *numbers))
    return table("Observations", columns, rows, texts=1)


def stop_table(solution: Solution) -> str:
    """One row per stop: its pose, its change from the prior, and their sigmas."""
    traverse = solution.traverse
    stops_R, stops_m = pose_arrays(solution.final.world_T_mast)
    in_world = translation_covariance_in_world(stops_R, solution.stop_covariance)
    sigma_mm = 1e3 * np.sqrt(np.maximum(np.diagonal(in_world, axis1=1, axis2=2), 0))
    turn = np.sqrt(np.maximum(np.diagonal(solution.stop_covariance[:, :3, :3], axis1=1, axis2=2), 0))
    columns: tuple[tuple[str, str], ...] = (
        ("stop", "id of the stop"),
        ("x (m)", "position of the mast in the world"),
        ("y (m)", "position of the mast in the world"),
        ("z (m)", "position of the mast in the world"),
        ("shift (mm)", "distance from the position that the input gave"),
        (f"{_SIGMA} x (mm)", "formal standard deviation along the world's x"),
        (f"{_SIGMA} y (mm)", "formal standard deviation along the world's y"),
        (f"{_SIGMA} z (mm)", "formal standard deviation along the world's z"),
        ("turn (°)", "angle between the orientation that the input gave and the adjusted one"),
        (f"{_SIGMA} roll (°)", "formal standard deviation of a turn about the mast's x axis"),
        (f"{_SIGMA} pitch (°)", "formal standard deviation of a turn about the mast's y axis"),
        (f"{_SIGMA} heading (°)", "formal standard deviation of a turn about the mast's z axis"),
    )
    rows = []
    for row, (stop, pose) in enumerate(zip(traverse.stops, solution.final.world_T_mast, strict=True)):
        change = stop.world_T_mast.between(pose)
        angle_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(change.rotation())))
        held = not np.any(solution.stop_covariance[row])
        sigmas = ["held"] * 3 if held else [fixed(s, 2) for s in sigma_mm[row]]
        turns = ["held"] * 3 if held else [fixed(np.rad2deg(s), 4) for s in turn[row]]
        rows.append(
            (
                stop.id,
                *(fixed(c, 4) for c in stops_m[row]),
                fixed(1e3 * float(np.linalg.norm(change.translation())), 2),
                *sigmas,
                fixed(np.rad2deg(angle_rad), 4),
                *turns,
            )
        )
    if (site := traverse.site) is not None:
        placed = (
            ("latitude (°)", "planetocentric on Mars and Moon, geodetic on Earth"),
            ("longitude (°)", "east"),
            ("height (m)", "as of the site's"),
            ("azimuth (°)", "of the mast's x axis, clockwise from north"),
        )
        columns = (*columns, *placed)
        forward = np.arctan2(stops_R[:, 1, 0], stops_R[:, 0, 0])
        for i, (place, heading) in enumerate(zip(site.geographic(stops_m), forward.tolist(), strict=True)):
            degrees = fixed(place[0], 7), fixed(place[1], 7), fixed(place[2], 2)
            rows[i] = (*rows[i], *degrees, fixed(site.azimuth_deg(heading), 3))
    return table("Stops", columns, rows, texts=1)
