"""Camera models as text: `.cahvor` files, as JPL's camera tools write and read them.

The layout is that of the tools' own writer (cmod_cahvore_write of the VICAR open source release): keys in a
fixed order, some of which older readers look for even where they do not need them. Numbers have all the
digits of a double, so that a file reads back bit for bit.
"""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import CameraError, InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHV, CAHVOR, CAHVORE, cahv_of_vectors
from pancam_graph.io._json import read_bytes, short

__all__ = ["cahvor_text", "read_cahvor"]

_KINDS: dict[type[CAHV], str] = {
    CAHV: "CAHV = perspective, linear",
    CAHVOR: "CAHVOR = perspective, distortion",
}
_LINEARITY = {1.0: "CAHVORE1 = perspective, distortion, pupil", 0.0: "CAHVORE2 = fish-eye"}
_MODEL = re.compile(r"(CAHVORE|CAHVOR|CAHV)([123]?)(?:\s*,\s*([^\s=]+))?\s*(?:=.*)?$")


def cahvor_text(model: CAHV, comments: Iterable[str] = ()) -> str:
    """A camera model as the content of a `.cahvor` file, in the frame of its vectors.

    `comments` are lines to stand in front; they must hold no equals sign, as JPL's readers take lines with
    one for entries. Hs, Hc, Vs, Vc are focal lengths and principal point in pixels, Theta the angle from the
    row axis to the column axis. The covariances S are zeros, by which the tools know that they are unknown.
    """
    letters = type(model).__name__
    lines = [f"# {comment}" for comment in comments]
    lines += ["", f"Model = {_kind(model)}", "", f"Dimensions = {model.width_px} {model.height_px}", ""]
    lines += [f"{name} = {_row(getattr(model, name))}" for name in letters]
    lines += ["", "S =", *_zeros(3 * len(letters)), ""]
    across = np.cross(model.A, model.V), np.cross(model.A, model.H)
    theta = float(np.arctan2(np.cross(model.V, model.H) @ model.A, across[0] @ across[1]))
    internal = {"Hs": model.fx_px, "Hc": model.cx_px, "Vs": model.fy_px, "Vc": model.cy_px}
    lines += [f"{name}    = {value!r}" for name, value in internal.items()]
    lines += [
        f"Theta = {theta!r} ({np.rad2deg(theta):.6f} deg)",
        "",
        "S internal =",
        *_zeros(5),
    ]
    return "\n".join([*lines, ""])


def read_cahvor(path: Path | str) -> CAHV:
    """Read a `.cahvor` file (.cahv, .cahvore): a CAHV, CAHVOR or CAHVORE, in whatever frame the file is in.

    Raises InputError naming file and key for what is missing or malformed, and for numbers that make no
    camera.
    """
    path = Path(path)
    try:
        text = read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text in UTF-8, found other bytes at {error.start}") from error
    lines = (line.partition("=") for line in text.splitlines() if not line.lstrip().startswith("#"))
    entries = {key.strip(): value.strip() for key, sign, value in lines if sign}
    model = _entry(path, entries, "Model")
    match = _MODEL.match(model)
    if match is None or (match[1] == "CAHVORE") != bool(match[2]):
        raise InputError(
            f"{path}: Model: expected CAHV, CAHVOR, CAHVORE1, CAHVORE2 or CAHVORE3,LINEARITY, "
            f"found {short(model)}"
        )
    kind = match[1]
    width_px, height_px = (int(n) for n in _numbers(path, entries, "Dimensions", 2))
    vectors = {letter: _numbers(path, entries, letter, 3) for letter in kind}
    linearity = _linearity(path, match[2], match[3], model) if kind == "CAHVORE" else 1.0
    try:
        return cahv_of_vectors(width_px, height_px, vectors, linearity)
    except CameraError as error:
        raise InputError(f"{path}: {error}") from error


def _kind(model: CAHV) -> str:
    if isinstance(model, CAHVORE):
        return _LINEARITY.get(model.linearity, f"CAHVORE3,{model.linearity!r} = general")
    return _KINDS[type(model)]


def _linearity(path: Path, kind: str, number: str | None, model: str) -> float:
    if kind != "3":
        return {"1": 1.0, "2": 0.0}[kind]
    try:
        return float(number or "")
    except ValueError as error:
        raise InputError(
            f"{path}: Model: expected CAHVORE3 with its linearity after a comma, found {short(model)}"
        ) from error


def _row(values: FloatArray) -> str:
    return " ".join(f"{value!r:>23}" for value in values.tolist())


def _zeros(n: int) -> list[str]:
    return [" ".join(["0.0"] * n)] * n


def _entry(path: Path, entries: dict[str, str], name: str) -> str:
    if name not in entries:
        raise InputError(f"{path}: {name}: expected a line of this name, found none")
    return entries[name]


def _numbers(path: Path, entries: dict[str, str], name: str, n: int) -> FloatArray:
    text = _entry(path, entries, name)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != n or not np.isfinite(values).all():
        raise InputError(f"{path}: {name}: expected {n} numbers, found {short(text)}")
    return values
