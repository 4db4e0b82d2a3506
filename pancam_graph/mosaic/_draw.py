"""Mosaics with axes, and a figure that compares the refined pointing with telemetry."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.mosaic._make import Mosaic, StopMosaics
from pancam_graph.mosaic._placed import POINTINGS, Pointing
from pancam_graph.mosaic._projections import Cylinder, Ground
from pancam_graph.mosaic._seam_error import Case

__all__ = ["close_ups", "comparison", "shrunk", "with_axes"]

Picture = NDArray[np.uint8]

PAPER, INK, GRID, EMPTY = (255, 255, 255), (41, 31, 24), (150, 150, 150), 228
_CYLINDER_WIDTH_PX, _GROUND_WIDTH_PX = 2400, 1200
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 45, 90, 100, 200, 500, 1000)
_MAGNIFIED = 4
_LABEL_ROOM_PX, _LINE_ROOM_PX = 90, 45


def shrunk(picture: Picture, width_px: int) -> Picture:
    """A picture no wider than `width_px`, its empty part light grey, not black on a white page."""
    filled = picture > 0
    factor = min(1.0, width_px / picture.shape[1])
    size = (max(1, round(picture.shape[1] * factor)), max(1, round(picture.shape[0] * factor)))
    grey = np.where(filled, picture, np.uint8(EMPTY)).astype(np.uint8)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def with_axes(mosaic: Mosaic, pointing: Pointing, title: str, width_px: int | None = None) -> Picture:
    """A mosaic in colour (blue, green, red) with its axes, made smaller where it is wider than a screen.

    Around the horizon the axes are azimuth and elevation. From above they are world x and y; circles about
    the mast and lines of azimuth are drawn over it.
    """
    projection = mosaic.projection
    widest = _CYLINDER_WIDTH_PX if isinstance(projection, Cylinder) else _GROUND_WIDTH_PX
    grey = shrunk(mosaic.pictures[pointing], width_px or widest)
    scale = grey.shape[1] / projection.width_px
    picture: Picture = np.repeat(grey[..., None], 3, axis=-1)
    if isinstance(projection, Cylinder):
        across = _Axis.of(
            projection.azimuth_deg(np.array([0.0, projection.width_px - 1.0])),
            scale,
            projection.width_px,
            wrap=True,
        )
        down = _Axis.of(
            projection.elevation_deg(np.array([0.0, projection.height_px - 1.0])),
            scale,
            projection.height_px,
            room_px=_LINE_ROOM_PX,
        )
        names = "azimuth, degrees anticlockwise from the world's x axis", "elevation, degrees"
    else:
        x, y = projection.origin_m[0] + projection.left_m, projection.origin_m[1] + projection.top_m
        side = (projection.width_px - 1) * projection.m_per_px
        across = _Axis.of(np.array([x, x + side]), scale, projection.width_px)
        down = _Axis.of(np.array([y, y - side]), scale, projection.height_px)
        names = "world x, metres", "world y, metres"
        _draw_circles(picture, projection, scale)
        title = f"{title}; circles: distance, lines: azimuth in degrees" if title else ""
    return _framed(picture, across, down, names, title)


class _Axis:
    """Ticks of an axis: their places, in pixels of the drawn picture, and their labels."""

    def __init__(self, at_px: list[float], text: list[str]) -> None:
        self.at_px, self.text = at_px, text

    @staticmethod
    def of(
        ends: NDArray[np.float64],
        scale: float,
        length_px: int,
        *,
        wrap: bool = False,
        room_px: int = _LABEL_ROOM_PX,
    ) -> "_Axis":
        """Ticks between the values of the first and the last pixel; `wrap`: angles from 0 to 360."""
        per_px = float(ends[1] - ends[0]) / max(length_px - 1, 1) / scale
        wanted = abs(per_px) * room_px
        step = next((s for s in _STEPS if s >= wanted), _STEPS[-1])
        low, high = sorted(float(e) for e in ends)
        values = step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
        decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
        # Pixels count from their centres; shrinking keeps the picture's edges where they are.
        at = [((float(v) - float(ends[0])) / per_px / scale + 0.5) * scale - 0.5 for v in values]
        shown = [float(v) % 360 if wrap else float(v) for v in values]
        return _Axis(at, [f"{v + 0.0:.{decimals}f}" for v in shown])


def _framed(picture: Picture, across: _Axis, down: _Axis, names: tuple[str, str], title: str) -> Picture:
    """The picture with ticks and words around it."""
    height, width = picture.shape[:2]
    left, top, bottom = 108, 46, 78
    # Words may be wider than a small picture.
    name_px = _width_px(names[0], 0.6)
    right = max(
        34, _width_px(title, 0.7) - width + 10, (name_px - width) // 2 + 10, name_px + 20 - left - width
    )
    page = np.full((height + top + bottom, width + left + right, 3), 255, dtype=np.uint8)
    page[top : top + height, left : left + width] = picture
    cv2.rectangle(page, (left - 1, top - 1), (left + width, top + height), INK, 1)
    for at, text in zip(across.at_px, across.text, strict=True):
        x = left + round(at)
        if left - 1 <= x <= left + width:
            cv2.line(page, (x, top + height), (x, top + height + 7), INK, 1)
            _write(page, text, (x, top + height + 26), centred=True)
    for at, text in zip(down.at_px, down.text, strict=True):
        y = top + round(at)
        if top - 1 <= y <= top + height:
            cv2.line(page, (left - 8, y), (left - 1, y), INK, 1)
            size = cv2.getTextSize(text, _FONT, 0.6, 1)[0]
            _write(page, text, (left - 14 - size[0], y + size[1] // 2))
    middle = max(left + width // 2, name_px // 2 + 10)
    _write(page, names[0], (middle, top + height + 60), centred=True)
    turned = np.ascontiguousarray(np.rot90(page, -1))
    _write(turned, names[1], (turned.shape[1] - top - height // 2, 24), centred=True)
    page = np.ascontiguousarray(np.rot90(turned))
    _write(page, title, (left, 30), size=0.7)
    return page


def _draw_circles(picture: Picture, projection: Ground, scale: float) -> None:
    """Circles of equal distance from the mast, and lines of equal azimuth."""
    per_m = scale / projection.m_per_px
    centre = [((c / projection.m_per_px + 0.5) * scale - 0.5) for c in (-projection.left_m, projection.top_m)]
    radius_m = 0.5 * projection.width_px * projection.m_per_px
    step = next((s for s in _STEPS if s >= radius_m / 5.5), _STEPS[-1])
    middle = round(centre[0]), round(centre[1])
    rings = step * np.arange(1, int(radius_m / step) + 1)
    outer = float(rings[-1]) if len(rings) else radius_m
    layer = picture.copy()
    for r in rings:
        cv2.circle(layer, middle, round(float(r) * per_m), (60, 190, 255), 1, cv2.LINE_AA)
    for azimuth in range(0, 360, 30):
        d = np.array([np.cos(np.deg2rad(azimuth)), -np.sin(np.deg2rad(azimuth))])
        ends = [
            tuple(np.rint(np.array(centre) + d * m * per_m).astype(int).tolist())
            for m in (rings[0] if len(rings) else 0, outer)
        ]
        cv2.line(layer, ends[0], ends[1], (60, 190, 255), 1, cv2.LINE_AA)
    cv2.addWeighted(layer, 0.6, picture, 0.4, 0, dst=picture)
    cv2.drawMarker(picture, middle, (0, 94, 213), cv2.MARKER_CROSS, 18, 2)
    for r in rings:  # between two lines of azimuth, where no other label is
        d = np.array([np.cos(np.deg2rad(-15)), -np.sin(np.deg2rad(-15))]) * (float(r) * per_m - 22)
        _write_over(picture, f"{r:g} m", np.array(centre) + d)
    for azimuth in range(0, 360, 30):
        d = np.array([np.cos(np.deg2rad(azimuth)), -np.sin(np.deg2rad(azimuth))])
        _write_over(picture, f"{azimuth}", np.array(centre) + d * (outer * per_m - 24))


def _plain(text: str) -> str:
    """The text in ASCII, which is all that OpenCV can draw."""
    return text.encode("ascii", "replace").decode("ascii")


def _width_px(text: str, size: float) -> int:
    return int(cv2.getTextSize(_plain(text), _FONT, size, 1)[0][0])


def _write(
    page: Picture, text: str, at: tuple[int, int], *, size: float = 0.6, centred: bool = False
) -> None:
    place = (at[0] - _width_px(text, size) // 2, at[1]) if centred else at
    cv2.putText(page, _plain(text), place, _FONT, size, INK, 1, cv2.LINE_AA)


def _write_over(picture: Picture, text: str, at: NDArray[np.float64]) -> None:
    """Draw words on a light ground, their middle at a place of a picture."""
    (width, height), _ = cv2.getTextSize(text, _FONT, 0.5, 1)
    x, y = round(float(at[0]) - width / 2), round(float(at[1]) + height / 2)
    cv2.rectangle(picture, (x - 3, y - height - 3), (x + width + 3, y + 4), (245, 245, 245), cv2.FILLED)
    cv2.putText(picture, text, (x, y), _FONT, 0.5, INK, 1, cv2.LINE_AA)


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


def comparison(mosaics: StopMosaics, title: str) -> Picture:
    """The refined panorama over pieces of its overlaps with telemetry's and with refined pointing."""
    width = 1800
    panorama = with_axes(mosaics.cylinder, "refined", f"{title}: refined pointing", width - 142)
    rows: list[Picture] = [panorama]
    pieces = close_ups(mosaics, 3)
    if pieces:
        column = (width - 108 - 20 * (len(pieces) - 1) - 34) // len(pieces)
        column = min(column, _MAGNIFIED * pieces[0][1]["refined"].shape[1])
        rows += [_row(mosaics, pieces, pointing, column, width) for pointing in POINTINGS]
        note = "Overlaps, enlarged: first image red, second image green and blue; grey where they agree."
        strip = np.full((40, width, 3), 255, dtype=np.uint8)
        _write(strip, note, (108, 24))
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
        _write(strip, f"{pointing}: {figures}", (x, 30))
        strip[44 : 44 + piece.shape[0], x : x + piece.shape[1]] = piece
    return strip
