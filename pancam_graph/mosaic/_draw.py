"""Mosaics with axes, and a figure that compares the refined pointing with telemetry."""

from collections.abc import Sequence

import cv2
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.charts import STEPS, Axis, Picture, framed, write, write_over
from pancam_graph.mosaic._make import Mosaic, StopMosaics
from pancam_graph.mosaic._placed import POINTINGS, Pointing
from pancam_graph.mosaic._projections import Cylinder, Ground
from pancam_graph.mosaic._seam_error import Case

__all__ = ["EMPTY", "around_axes", "close_ups", "comparison", "draw_compass", "shrunk", "with_axes"]

PAPER, EMPTY = (255, 255, 255), 228
_CYLINDER_WIDTH_PX, _GROUND_WIDTH_PX = 2400, 1200
_MAGNIFIED = 4
_LINE_ROOM_PX = 45


def shrunk(picture: Picture, width_px: int) -> Picture:
    """A picture no wider than `width_px`, its empty part light grey, not black on a white page."""
    filled = picture > 0
    factor = min(1.0, width_px / picture.shape[1])
    size = (max(1, round(picture.shape[1] * factor)), max(1, round(picture.shape[0] * factor)))
    grey = np.where(filled, picture, np.uint8(EMPTY)).astype(np.uint8)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def with_axes(
    mosaic: Mosaic,
    pointing: Pointing,
    title: str,
    width_px: int | None = None,
    *,
    north_deg: float | None = None,
) -> Picture:
    """A mosaic in colour (blue, green, red) with its axes, made smaller where it is wider than a screen.

    Around the horizon the axes are azimuth and elevation. From above they are world x and y; circles about
    the mast and lines of azimuth are drawn over it. Azimuths count clockwise from north, where `north_deg`,
    the direction of north anticlockwise from the world's x axis, is known; else anticlockwise from that axis.
    """
    projection = mosaic.projection
    widest = _CYLINDER_WIDTH_PX if isinstance(projection, Cylinder) else _GROUND_WIDTH_PX
    grey = shrunk(mosaic.pictures[pointing], width_px or widest)
    scale = grey.shape[1] / projection.width_px
    picture: Picture = np.repeat(grey[..., None], 3, axis=-1)
    if isinstance(projection, Cylinder):
        across, down, names = around_axes(projection, scale, north_deg)
    else:
        x, y = projection.origin_m[0] + projection.left_m, projection.origin_m[1] + projection.top_m
        side = (projection.width_px - 1) * projection.m_per_px
        across = Axis.of(np.array([x, x + side]), scale, projection.width_px)
        down = Axis.of(np.array([y, y - side]), scale, projection.height_px)
        names = "world x, metres", "world y, metres"
        _draw_circles(picture, projection, scale, north_deg)
        way = "" if north_deg is None else " from north"
        title = f"{title}; circles: distance, lines: azimuth in degrees{way}" if title else ""
    return framed(picture, across, down, names, title)


def around_axes(
    cylinder: Cylinder, scale: float, north_deg: float | None
) -> tuple[Axis, Axis, tuple[str, str]]:
    """Axes of azimuth and of elevation, with their names, of a panorama drawn `scale` times its size."""
    ends_deg = cylinder.azimuth_deg(np.array([0.0, cylinder.width_px - 1.0]))
    azimuth = ends_deg if north_deg is None else north_deg - ends_deg
    across = Axis.of(azimuth, scale, cylinder.width_px, wrap=True)
    elevation = cylinder.elevation_deg(np.array([0.0, cylinder.height_px - 1.0]))
    down = Axis.of(elevation, scale, cylinder.height_px, room_px=_LINE_ROOM_PX)
    way = "anticlockwise from the world's x axis" if north_deg is None else "clockwise from north"
    return across, down, (f"azimuth, degrees {way}", "elevation, degrees")


def _draw_circles(picture: Picture, projection: Ground, scale: float, north_deg: float | None) -> None:
    """Circles of equal distance from the mast, and lines of equal azimuth; see `with_axes`."""
    per_m = scale / projection.m_per_px
    centre = [((c / projection.m_per_px + 0.5) * scale - 0.5) for c in (-projection.left_m, projection.top_m)]
    radius_m = 0.5 * projection.width_px * projection.m_per_px
    step = next((s for s in STEPS if s >= radius_m / 5.5), STEPS[-1])
    rings = [(r * per_m, f"{r:g} m") for r in (step * np.arange(1, int(radius_m / step) + 1)).tolist()]
    draw_compass(picture, np.array(centre), rings or [(radius_m * per_m, "")], north_deg)


def draw_compass(
    picture: Picture, centre_px: FloatArray, rings: Sequence[tuple[float, str]], north_deg: float | None
) -> None:
    """Circles about the mast, each a radius in pixels with its label, and lines of azimuth, every 30 degrees.

    `north_deg` as in `with_axes`; the world's x axis is to the right, or, in a picture that has north up, the
    caller gives 90 as the direction of north.
    """

    def along(azimuth: float) -> FloatArray:
        anticlockwise = np.deg2rad(azimuth if north_deg is None else north_deg - azimuth)
        return np.array([np.cos(anticlockwise), -np.sin(anticlockwise)])

    inner, outer = rings[0][0] if len(rings) > 1 else 0.0, rings[-1][0]
    middle = round(float(centre_px[0])), round(float(centre_px[1]))
    layer = picture.copy()
    for radius, _ in rings:
        cv2.circle(layer, middle, round(radius), (60, 190, 255), 1, cv2.LINE_AA)
    for azimuth in range(0, 360, 30):
        d = along(azimuth)
        ends = [tuple(np.rint(centre_px + d * r).astype(int).tolist()) for r in (inner, outer)]
        cv2.line(layer, ends[0], ends[1], (60, 190, 255), 1, cv2.LINE_AA)
    cv2.addWeighted(layer, 0.6, picture, 0.4, 0, dst=picture)
    cv2.drawMarker(picture, middle, (0, 94, 213), cv2.MARKER_CROSS, 18, 2)
    for radius, label in rings:  # between two lines of azimuth, where no other label is
        if label:
            write_over(picture, label, centre_px + along(-15) * (radius - 22))
    for azimuth in range(0, 360, 30):
        write_over(picture, f"{azimuth}", centre_px + along(azimuth) * (outer - 24))


def close_ups(mosaics: StopMosaics, most: int) -> list[tuple[int, dict[Pointing, Picture]]]:
    """Overlaps, by number, with a magnified piece of each (blue, green, red): those with most windows."""
    order = sorted(
        (k for k, o in enumerate(mosaics.seams.overlaps) if o.close_up),
        key=lambda k: -len(mosaics.seams.overlaps[k].azimuth_deg),
    )
    magnified = []
    for k in sorted(order[:most]):
        pieces = mosaics.seams.overlaps[k].close_up
        magnified.append((k, {p: _magnified(pieces[p][..., ::-1]) for p in POINTINGS}))
    return magnified


def _magnified(piece: Picture) -> Picture:
    size = (piece.shape[1] * _MAGNIFIED, piece.shape[0] * _MAGNIFIED)
    return np.asarray(cv2.resize(np.ascontiguousarray(piece), size, interpolation=cv2.INTER_CUBIC), np.uint8)


def comparison(mosaics: StopMosaics, title: str, north_deg: float | None) -> Picture:
    """The refined panorama over pieces of its overlaps with telemetry's and with refined pointing."""
    width = 1800
    panorama = with_axes(
        mosaics.cylinder, "refined", f"{title}: refined pointing", width - 142, north_deg=north_deg
    )
    rows: list[Picture] = [panorama]
    pieces = close_ups(mosaics, 3)
    if pieces:
        column = (width - 108 - 20 * (len(pieces) - 1) - 34) // len(pieces)
        column = min(column, _MAGNIFIED * pieces[0][1]["refined"].shape[1])
        rows += [_row(mosaics, pieces, pointing, column, width) for pointing in POINTINGS]
        note = "Overlaps, enlarged: first image red, second image green and blue; grey where they agree."
        strip = np.full((40, width, 3), 255, dtype=np.uint8)
        write(strip, note, (108, 24))
        rows.append(strip)
    widest = max(row.shape[1] for row in rows)
    padded = [
        cv2.copyMakeBorder(row, 0, 0, 0, widest - row.shape[1], cv2.BORDER_CONSTANT, value=PAPER)
        for row in rows
    ]
    return np.asarray(np.vstack(padded), dtype=np.uint8)


def _row(
    mosaics: StopMosaics,
    pieces: Sequence[tuple[int, dict[Pointing, Picture]]],
    pointing: Pointing,
    column_px: int,
    width_px: int,
) -> Picture:
    cases: tuple[Case, ...] = (
        ("telemetry", "telemetry_own_surface") if pointing == "telemetry" else ("refined",)
    )
    shrunken = [
        cv2.resize(
            piece[pointing],
            (column_px, round(piece[pointing].shape[0] * column_px / piece[pointing].shape[1])),
            interpolation=cv2.INTER_AREA,
        )
        for _, piece in pieces
    ]
    height = max(s.shape[0] for s in shrunken)
    strip = np.full((height + 44, width_px, 3), 255, dtype=np.uint8)
    for n, ((k, _), piece) in enumerate(zip(pieces, shrunken, strict=True)):
        x = 108 + n * (column_px + 20)
        overlap = mosaics.seams.overlaps[k]
        figures = ", ".join(
            f"{overlap.median_px(c):.2f} px{' on its own surface' if c == 'telemetry_own_surface' else ''}"
            for c in cases
        )
        write(strip, f"{pointing}: {figures}", (x, 30))
        strip[44 : 44 + piece.shape[0], x : x + piece.shape[1]] = piece
    return strip
