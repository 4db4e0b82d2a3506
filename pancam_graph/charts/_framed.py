"""A picture with axes and words around it."""

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["INK", "STEPS", "Axis", "Picture", "framed", "width_px", "write", "write_over"]

Picture = NDArray[np.uint8]
"""(rows, columns, 3) in blue, green, red."""

INK = (41, 31, 24)
STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 45, 90, 100, 200, 500, 1000)
"""Distances of ticks, of circles, and lengths of bars."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LABEL_ROOM_PX = 90


class Axis:
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
    ) -> "Axis":
        """Ticks between the values of the first and the last pixel; `wrap`: angles from 0 to 360."""
        per_px = float(ends[1] - ends[0]) / max(length_px - 1, 1) / scale
        wanted = abs(per_px) * room_px
        step = next((s for s in STEPS if s >= wanted), STEPS[-1])
        low, high = sorted(float(e) for e in ends)
        values = step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
        decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
        # Pixels count from their centres; shrinking keeps the picture's edges where they are.
        at = [((float(v) - float(ends[0])) / per_px / scale + 0.5) * scale - 0.5 for v in values]
        shown = [float(v) % 360 if wrap else float(v) for v in values]
        return Axis(at, [f"{v + 0.0:.{decimals}f}" for v in shown])


def framed(picture: Picture, across: Axis, down: Axis, names: tuple[str, str], title: str) -> Picture:
    """The picture with ticks and words around it."""
    height, width = picture.shape[:2]
    left, top, bottom = 108, 46, 78
    # Words may be wider than a small picture.
    name_px = width_px(names[0], 0.6)
    right = max(
        34, width_px(title, 0.7) - width + 10, (name_px - width) // 2 + 10, name_px + 20 - left - width
    )
    page = np.full((height + top + bottom, width + left + right, 3), 255, dtype=np.uint8)
    page[top : top + height, left : left + width] = picture
    cv2.rectangle(page, (left - 1, top - 1), (left + width, top + height), INK, 1)
    for at, text in zip(across.at_px, across.text, strict=True):
        x = left + round(at)
        if left - 1 <= x <= left + width:
            cv2.line(page, (x, top + height), (x, top + height + 7), INK, 1)
            write(page, text, (x, top + height + 26), centred=True)
    for at, text in zip(down.at_px, down.text, strict=True):
        y = top + round(at)
        if top - 1 <= y <= top + height:
            cv2.line(page, (left - 8, y), (left - 1, y), INK, 1)
            size = cv2.getTextSize(text, _FONT, 0.6, 1)[0]
            write(page, text, (left - 14 - size[0], y + size[1] // 2))
    middle = max(left + width // 2, name_px // 2 + 10)
    write(page, names[0], (middle, top + height + 60), centred=True)
    turned = np.ascontiguousarray(np.rot90(page, -1))
    write(turned, names[1], (turned.shape[1] - top - height // 2, 24), centred=True)
    page = np.ascontiguousarray(np.rot90(turned))
    write(page, title, (left, 30), size=0.7)
    return page


def _plain(text: str) -> str:
    """The text in ASCII, which is all that OpenCV can draw."""
    return text.encode("ascii", "replace").decode("ascii")


def width_px(text: str, size: float) -> int:
    """How wide words are."""
    return int(cv2.getTextSize(_plain(text), _FONT, size, 1)[0][0])


def write(page: Picture, text: str, at: tuple[int, int], *, size: float = 0.6, centred: bool = False) -> None:
    """Draw words on a page, beginning at a place or with their middle there."""
    place = (at[0] - width_px(text, size) // 2, at[1]) if centred else at
    cv2.putText(page, _plain(text), place, _FONT, size, INK, 1, cv2.LINE_AA)


def write_over(picture: Picture, text: str, at: NDArray[np.float64]) -> None:
    """Draw words on a light ground, their middle at a place of a picture."""
    (width, height), _ = cv2.getTextSize(text, _FONT, 0.5, 1)
    x, y = round(float(at[0]) - width / 2), round(float(at[1]) + height / 2)
    cv2.rectangle(picture, (x - 3, y - height - 3), (x + width + 3, y + 4), (245, 245, 245), cv2.FILLED)
    cv2.putText(picture, text, (x, y), _FONT, 0.5, INK, 1, cv2.LINE_AA)
