"""Which eye of a known rig took each picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.choices import expected_one_of, nearest, some_of
from pancam_graph.base.errors import InputError
from pancam_graph.io._json import prefixed
from pancam_graph.io._rig_json import read_any_rig
from pancam_graph.io.plain._pointing import Pointed
from pancam_graph.rigs import TEMPLATES, Rig, rig_template

__all__ = ["RiggedPictures", "told_rig"]

_NAMED = 5


@dataclass(frozen=True, kw_only=True, eq=False)
class RiggedPictures:
    """A rig, and which of its eyes took each picture."""

    rig: Rig
    pictures: tuple[tuple[Pointed, str], ...]
    """Pictures that are used, with the names of their eyes, in the order of the table."""
    warnings: tuple[str, ...]
    sources: tuple[str, ...]
    """Sentences about where the rig's numbers come from."""


def told_rig(pointed: Sequence[Pointed], told: str, table: Path) -> RiggedPictures:
    """The rig of a template, or of a JSON file, and its eyes that took the pictures.

    The table says the eye, else the size of the picture does; pictures of another size are left out. Raises
    InputError for a rig that is neither, for a file as `read_any_rig` does, naming file, column and line for
    a camera that the rig has not and for a picture that may be of several, and if no picture is left.
    """
    rig = _rig(told)
    kept: list[tuple[Pointed, str]] = []
    wrong: list[str] = []
    eyes = [eye.name for eye in rig.eyes]
    with prefixed(table):
        for row in pointed:
            fitting = [
                eye.name
                for eye in rig.eyes
                if (eye.camera.width_px, eye.camera.height_px) == row.picture.size_px
            ]
            if row.camera is not None and row.camera not in eyes:
                raise InputError(expected_one_of(f"camera, line {row.line}", row.camera, eyes))
            if row.camera is None and len(fitting) > 1:
                raise InputError(
                    f"line {row.line}: expected a column camera with one of {some_of(fitting)}, as all of "
                    f"them have the size of {row.picture.file}; found no such cell"
                )
            if row.camera in fitting or (row.camera is None and fitting):
                kept.append((row, row.camera or fitting[0]))
            else:
                wrong.append(_wrong_size(row, rig))
        if not kept:
            raise InputError(wrong[0])
    warnings = [f"{sentence}; left out" for sentence in wrong[:_NAMED]]
    if len(wrong) > _NAMED:
        warnings.append(f"{len(wrong) - _NAMED} more pictures of another size are left out")
    turned = [row.picture.file for row, _ in kept if row.picture.exif.orientation != 1]
    if turned:
        warnings.append(
            "EXIF says that pictures are to be turned; pixels are taken as they are stored: "
            f"{some_of(turned)}"
        )
    return RiggedPictures(
        rig=rig,
        pictures=tuple(kept),
        warnings=tuple(warnings),
        sources=(f"rig: {rig.name}, as told by --rig {told}",),
    )


def _rig(told: str) -> Rig:
    if told in TEMPLATES:
        return rig_template(told)
    if not Path(told).exists():
        raise InputError(
            f"--rig: expected a JSON file, or one of {', '.join(TEMPLATES)}; found {told!r}"
            f"{nearest(told, TEMPLATES)}"
        )
    return read_any_rig(told)


def _wrong_size(row: Pointed, rig: Rig) -> str:
    sizes = {
        f"{eye.camera.width_px} x {eye.camera.height_px}": None
        for eye in rig.eyes
        if row.camera in {None, eye.name}
    }
    width_px, height_px = row.picture.size_px
    turned = f"{height_px} x {width_px}" in sizes
    return (
        f"{row.picture.file}: expected {some_of(list(sizes))} pixels as of the rig {rig.name}, found "
        f"{width_px} x {height_px}{', a picture that was turned' if turned else ''}"
    )
