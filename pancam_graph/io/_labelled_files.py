"""The labelled images of a folder: which file is read by which label, and what became of the others."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.io._labelled_image import LabelledImage
from pancam_graph.io._pds4_image import rover_image_of_xml
from pancam_graph.io._pds_image import read_labelled_image
from pancam_graph.io._pds_label import may_have_label
from pancam_graph.io._xml import read_xml

__all__ = ["LABEL_SUFFIXES", "LabelledFiles", "labelled_files"]

LABEL_SUFFIXES = frozenset({".img", ".lbl", ".xml"})
"""How files with labels end, in small letters."""
_PRODUCT = "Product_Observational"


@dataclass(kw_only=True, eq=False)
class LabelledFiles:
    """What became of the files of a folder."""

    images: list[LabelledImage] = field(default_factory=list)
    """By the names of their pictures."""
    unusable: dict[str, InputError] = field(default_factory=dict)
    """Why images cannot be used, by the names of their files without the ending."""
    unread: list[Path] = field(default_factory=list)
    """Files that have no label, and are none."""


def labelled_files(folder: Path) -> LabelledFiles:
    """The images of a folder that have a label: PDS4 beside them, PDS3 in them or beside them.

    Of an image with both, the PDS4 label is read, and the other one where that cannot be used.
    """
    found = LabelledFiles()
    files = sorted(file for file in folder.iterdir())
    by_suffix = {suffix: [f for f in files if f.suffix.lower() == suffix] for suffix in LABEL_SUFFIXES}
    for label in by_suffix[".xml"]:
        _add(found, label, _of_xml)
    labelled = {image.file for image in found.images}
    for file in by_suffix[".img"]:
        if file in labelled:
            continue
        failed = found.unusable.pop(file.stem, None)
        if failed is not None and not may_have_label(file):
            found.unusable[file.stem] = failed
            continue
        _add(found, file, read_labelled_image)
    known = {file.stem for file in by_suffix[".img"]}
    for label in by_suffix[".lbl"]:
        if label.stem not in known:
            _add(found, label, _without_image)
    found.images.sort(key=lambda image: image.file.name)
    found.unread = [file for file in files if file.suffix.lower() not in LABEL_SUFFIXES and file.is_file()]
    return found


def _add(found: LabelledFiles, file: Path, read: Callable[[Path], LabelledImage]) -> None:
    try:
        found.images.append(read(file))
    except InputError as error:
        found.unusable.setdefault(file.stem, error)


def _of_xml(label: Path) -> LabelledImage:
    root = read_xml(label)
    if root.name != _PRODUCT:
        raise InputError(f"{label}: expected a PDS4 label ({_PRODUCT}), found {root.name[:60]!r}")
    return rover_image_of_xml(root)


def _without_image(label: Path) -> LabelledImage:
    raise InputError(f"{label}: expected its image {label.stem}.IMG beside it, found none")
