"""A COLMAP model as text or binary: cameras and images; points are not read.

Source: COLMAP's documentation, "Output Format". Its pixels count from the corner of the first, ours from the
centre.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import gtsam

from pancam_graph.base.errors import CameraError, InputError
from pancam_graph.cameras import Brown, Camera
from pancam_graph.io._json import read_bytes, short
from pancam_graph.io._told_numbers import told_number
from pancam_graph.io.posed._posed_camera import PosedCamera, world_T_camera_of

__all__ = ["is_colmap_model", "read_colmap_model"]

_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)
"""Models by their numbers in binary files."""
_COUNTS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12)
_READ: Mapping[
    str, Callable[..., tuple[tuple[float, float, float, float], tuple[float, float, float, float]]]
] = {
    "SIMPLE_PINHOLE": lambda f, cx, cy: ((f, f, cx, cy), (0.0, 0.0, 0.0, 0.0)),
    "PINHOLE": lambda fx, fy, cx, cy: ((fx, fy, cx, cy), (0.0, 0.0, 0.0, 0.0)),
    "SIMPLE_RADIAL": lambda f, cx, cy, k: ((f, f, cx, cy), (k, 0.0, 0.0, 0.0)),
    "RADIAL": lambda f, cx, cy, k1, k2: ((f, f, cx, cy), (k1, k2, 0.0, 0.0)),
    "OPENCV": lambda fx, fy, cx, cy, k1, k2, p1, p2: ((fx, fy, cx, cy), (k1, k2, p1, p2)),
}
_LARGEST_SIDE = 1 << 20
_POINT_BYTES = 24
"""Of a point in a picture in binary files: column, row, number of its point."""


def is_colmap_model(path: Path) -> bool:
    """Whether a folder has a COLMAP model."""
    return any((path / f"images{ending}").is_file() for ending in (".bin", ".txt"))


def read_colmap_model(path: Path) -> list[PosedCamera]:
    """The cameras of a folder with `cameras` and `images`, both `.bin`, or else both `.txt`.

    Raises InputError naming file and entry for what is missing, cut off or malformed, and for a camera model
    with another distortion than OpenCV's with k1, k2, p1, p2.
    """
    binary = (path / "images.bin").is_file()
    ending = ".bin" if binary else ".txt"
    cameras_file, images_file = path / f"cameras{ending}", path / f"images{ending}"
    if not cameras_file.is_file():
        raise InputError(f"{cameras_file}: expected the cameras of {images_file.name}, found no file")
    if binary:
        return _images_of_bytes(images_file, _cameras_of_bytes(cameras_file))
    return _images_of_text(images_file, _cameras_of_text(cameras_file))


def _camera(where: str, model: str, width: float, height: float, numbers: list[float]) -> Camera:
    """A camera by the name of its model. Raises InputError beginning with `where`."""
    if model not in _READ:
        raise InputError(f"{where}: model: expected one of {', '.join(_READ)}, found {short(model)}")
    count = _COUNTS[_MODELS.index(model)]
    if len(numbers) != count:
        raise InputError(f"{where}: expected {count} numbers of a {model}, found {len(numbers)}")
    if not all(1 <= side <= _LARGEST_SIDE and side == int(side) for side in (width, height)):
        raise InputError(f"{where}: expected width and height in pixels, found {width:g} and {height:g}")
    (fx, fy, cx, cy), (k1, k2, p1, p2) = _READ[model](*numbers)
    try:
        return Brown(
            width_px=int(width),
            height_px=int(height),
            fx_px=fx,
            fy_px=fy,
            cx_px=cx - 0.5,
            cy_px=cy - 0.5,
            distortion=(k1, k2, p1, p2, 0.0),
        )
    except CameraError as error:
        raise InputError(f"{where}: {error}") from error


def _of_camera(where: str, cameras: Mapping[int, Camera], number: int) -> Camera:
    if number not in cameras:
        raise InputError(f"{where}: expected the number of a camera of the model, found {number}")
    return cameras[number]


# --- text ---


def _lines(file: Path) -> list[tuple[int, str]]:
    """Lines that are no comments, with their numbers."""
    try:
        text = read_bytes(file).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: expected text in UTF-8, found other bytes at {error.start}") from error
    return [(n, line) for n, line in enumerate(text.split("\n"), 1) if not line.startswith("#")]


def _numbers(where: str, words: list[str]) -> list[float]:
    numbers = [told_number(word) for word in words]
    wrong = [word for word, number in zip(words, numbers, strict=True) if number is None]
    if wrong:
        raise InputError(f"{where}: expected numbers, found {short(wrong[0])}")
    return [number for number in numbers if number is not None]


def _cameras_of_text(file: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for n, line in _lines(file):
        words = line.split()
        if not words:
            continue
        where = f"{file}: line {n}"
        if len(words) < 5:
            raise InputError(
                f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT and numbers, found {short(line)}"
            )
        number, *rest = _numbers(where, [words[0], *words[2:]])
        cameras[int(number)] = _camera(where, words[1], rest[0], rest[1], rest[2:])
    return cameras


def _images_of_text(file: Path, cameras: Mapping[int, Camera]) -> list[PosedCamera]:
    found: list[PosedCamera] = []
    for n, line in _lines(file)[::2]:  # points of the picture stand in each second line
        if not line.strip():
            continue
        where, words = f"{file}: line {n}", line.split(maxsplit=9)
        if len(words) < 10:
            raise InputError(
                f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, found {short(line)}"
            )
        _, *numbers, camera = _numbers(where, words[:9])
        found.append(
            PosedCamera(
                name=words[9].strip(),
                world_T_camera=world_T_camera_of(numbers[:4], numbers[4:], where),
                camera=_of_camera(where, cameras, int(camera)),
            )
        )
    return found


# --- binary ---


@dataclass(eq=False)
class _Bytes:
    """A file that is read from its beginning on."""

    file: Path
    data: bytes
    at: int = 0

    def take(self, form: str) -> tuple[float, ...]:
        """Numbers of a form of `struct`. Raises InputError where the file ends before."""
        size = struct.calcsize(f"<{form}")
        if self.at + size > len(self.data):
            self.refuse("more bytes", "its end")
        numbers: tuple[float, ...] = struct.unpack_from(f"<{form}", self.data, self.at)
        self.at += size
        return numbers

    def count(self, least_bytes: int) -> int:
        """How many entries follow, each of so many bytes or more."""
        (number,) = self.take("Q")
        if number * least_bytes > len(self.data) - self.at:
            self.refuse(f"{int(number)} entries", f"{len(self.data) - self.at} bytes")
        return int(number)

    def name(self) -> str:
        """Text up to a zero."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self.refuse("a name that ends", "its end")
        text, self.at = self.data[self.at : end], end + 1
        return text.decode("utf-8", errors="replace")

    def refuse(self, expected: str, found: str) -> None:
        """Raise InputError with the place in the file."""
        raise InputError(f"{self.file}: byte {self.at}: expected {expected}, found {found}")


def _cameras_of_bytes(file: Path) -> dict[int, Camera]:
    source = _Bytes(file=file, data=read_bytes(file))
    cameras: dict[int, Camera] = {}
    for _ in range(source.count(24)):
        where = f"{file}: byte {source.at}"
        number, model, width, height = source.take("IiQQ")
        if not 0 <= model < len(_MODELS):
            raise InputError(f"{where}: model: expected a number below {len(_MODELS)}, found {int(model)}")
        numbers = list(source.take(f"{_COUNTS[int(model)]}d"))
        cameras[int(number)] = _camera(where, _MODELS[int(model)], width, height, numbers)
    return cameras


def _images_of_bytes(file: Path, cameras: Mapping[int, Camera]) -> list[PosedCamera]:
    source = _Bytes(file=file, data=read_bytes(file))
    found: list[PosedCamera] = []
    for _ in range(source.count(73)):
        where = f"{file}: byte {source.at}"
        _, *numbers, camera = source.take("I7dI")
        pose: gtsam.Pose3 = world_T_camera_of(numbers[:4], numbers[4:], where)
        name = source.name()
        points = source.count(_POINT_BYTES)
        source.at += points * _POINT_BYTES
        found.append(
            PosedCamera(name=name, world_T_camera=pose, camera=_of_camera(where, cameras, int(camera)))
        )
    return found
