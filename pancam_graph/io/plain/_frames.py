"""Frames and images of plain pictures: which of them show one pointing."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from pancam_graph.base.errors import InputError
from pancam_graph.data import UNKNOWN_RAD, Frame, Image
from pancam_graph.io.plain._pointing import Pointed
from pancam_graph.rigs import PointingSigma

__all__ = ["frames_of"]


def frames_of(
    pictures: Sequence[tuple[Pointed, str]], usual: PointingSigma, table: Path
) -> tuple[tuple[Frame, ...], tuple[Image, ...]]:
    """Frames and images of pictures with the names of their eyes, in the order of the table.

    Pictures are of one frame where the table says so, else where stop, pan and tilt are told and equal and
    the eyes differ. Raises InputError naming lines for a frame that has one eye twice, or two pointings.
    """
    frames: list[list[tuple[Pointed, str]]] = []
    of_key: dict[tuple[object, ...], list[list[tuple[Pointed, str]]]] = {}
    for row, eye in pictures:
        key: tuple[object, ...] = (row.stop, row.pan_rad, row.tilt_rad)
        if row.frame is not None:
            key = (row.stop, row.frame)
        elif row.pan_rad is None:
            key = (row.stop, row.line, None)
        same = of_key.setdefault((row.frame is None, *key), [])
        free = [frame for frame in same if eye not in {other for _, other in frame}]
        if same and row.frame is not None:
            _require_one_pointing(row, eye, same[0], table)
        if free:
            free[0].append((row, eye))
        else:
            frames.append([(row, eye)])
            same.append(frames[-1])
    ids = _frame_ids([frame[0][0] for frame in frames])
    names = _image_ids([row.picture.file for row, _ in pictures])
    found = tuple(
        _frame(name, [row for row, _ in rows], usual) for name, rows in zip(ids, frames, strict=True)
    )
    frame_of = {row.line: name for name, rows in zip(ids, frames, strict=True) for row, _ in rows}
    images = tuple(
        Image(id=name, frame=frame_of[row.line], camera=eye, file=row.picture.file)
        for name, (row, eye) in zip(names, pictures, strict=True)
    )
    return found, images


def _require_one_pointing(row: Pointed, eye: str, frame: list[tuple[Pointed, str]], table: Path) -> None:
    first = frame[0][0]
    if (row.pan_rad, row.tilt_rad) != (first.pan_rad, first.tilt_rad):
        raise InputError(
            f"{table}: frame, line {row.line}: expected pan and tilt of frame {row.frame!r} as in line "
            f"{first.line}, found others"
        )
    doubled = next((other.line for other, taken in frame if taken == eye), None)
    if doubled is not None:
        raise InputError(
            f"{table}: frame, line {row.line}: expected one picture of camera {eye!r} in frame "
            f"{row.frame!r}, found another in line {doubled}"
        )


def _frame(id: str, rows: Sequence[Pointed], usual: PointingSigma) -> Frame:  # noqa: A002  as Frame has it
    """A frame; of sigmas that its pictures have the first counts. What is not known is 0."""
    if rows[0].pan_rad is None or rows[0].tilt_rad is None:
        return Frame(
            id=id,
            stop=rows[0].stop,
            pan_rad=0.0,
            tilt_rad=0.0,
            sigma_pan_rad=UNKNOWN_RAD,
            sigma_tilt_rad=UNKNOWN_RAD,
        )
    pan = next((r.sigma_pan_rad for r in rows if r.sigma_pan_rad is not None), usual.pan_rad)
    tilt = next((r.sigma_tilt_rad for r in rows if r.sigma_tilt_rad is not None), usual.tilt_rad)
    return Frame(
        id=id,
        stop=rows[0].stop,
        pan_rad=rows[0].pan_rad,
        tilt_rad=rows[0].tilt_rad,
        sigma_pan_rad=pan,
        sigma_tilt_rad=tilt,
    )


def _frame_ids(firsts: Sequence[Pointed]) -> list[str]:
    """Names of frames: as told where they differ, else with the stop before; numbers where none is told."""
    told = [row.frame for row in firsts]
    if all(name is not None for name in told):
        names = [str(name) for name in told]
        if len(set(names)) == len(names):
            return names
    digits = max(3, len(str(len(firsts) - 1)))
    names = [
        f"frame{number:0{digits}d}" if row.frame is None else f"{row.stop}_{row.frame}"
        for number, row in enumerate(firsts)
    ]
    return names if len(set(names)) == len(names) else _numbered(names)


def _image_ids(files: Sequence[str]) -> list[str]:
    """Names of images: those of their files, with folders and ending where they are needed to differ.

    Masks and exports are files of these names: case alone does not make two of them differ.
    """
    paths = [PurePosixPath(file) for file in files]
    for names in (
        [path.stem for path in paths],
        ["_".join(path.with_suffix("").parts) for path in paths],
        ["_".join(path.parts) for path in paths],
    ):
        if len({name.casefold() for name in names}) == len(names):
            return names
    return _numbered(["_".join(path.parts) for path in paths])


def _numbered(names: Sequence[str]) -> list[str]:
    return [f"{number:03d}_{name}" for number, name in enumerate(names)]
