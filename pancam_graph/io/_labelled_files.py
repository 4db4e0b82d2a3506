"""The labelled images of a folder: which file is read by which label, and what became of the others."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import gtsam

from pancam_graph.base.errors import InputError
from pancam_graph.io._feed import feed_image, feed_records, picture_of_record
from pancam_graph.io._labelled_image import LabelledImage
from pancam_graph.io._pds4_exomars import exomars_image, is_exomars
from pancam_graph.io._pds4_image import rover_image_of_xml
from pancam_graph.io._pds_image import read_labelled_image
from pancam_graph.io._pds_label import may_have_label
from pancam_graph.io._picture_size import looks_like_picture
from pancam_graph.io._places import is_places
from pancam_graph.io._site_files import SITE_FILE, site_poses
from pancam_graph.io._xml import read_xml

__all__ = ["LABEL_SUFFIXES", "LabelledFiles", "labelled_files"]

LABEL_SUFFIXES = frozenset({".img", ".vic", ".lbl", ".xml", ".json"})
"""How files with labels end, in small letters."""
_PRODUCT = "Product_Observational"


@dataclass(kw_only=True, eq=False)
class LabelledFiles:
    """What became of the files of one or more folders."""

    images: list[LabelledImage] = field(default_factory=list)
    """By the names of their pictures."""
    unusable: dict[str, InputError] = field(default_factory=dict)
    """Why images cannot be used, by the names of their files without the ending."""
    warnings: list[str] = field(default_factory=list)
    """What is said of files with many records."""
    site_poses: dict[int, gtsam.Pose3] = field(default_factory=dict)
    """`before_T_site`, z up, by site, of .svf files."""
    places: Path | None = None
    """The table of localisation, where there is one."""
    unread: list[Path] = field(default_factory=list)
    """Files that have no label, and are none."""

    @staticmethod
    def joined(parts: "Sequence[LabelledFiles]") -> "LabelledFiles":
        """What became of the files of several folders; the first table of localisation counts."""
        joined = LabelledFiles()
        for part in parts:
            joined.images += part.images
            joined.unusable |= part.unusable
            joined.warnings += part.warnings
            joined.site_poses |= part.site_poses
            joined.places = joined.places or part.places
            joined.unread += part.unread
        return joined


class _NoLabelError(InputError):
    """A file of another kind than a label."""


def labelled_files(folder: Path) -> LabelledFiles:
    """The images of a folder that have a label: PDS4, PDS3, or a record of the feed.

    Of an image with both, the PDS4 label is read, and the other one where that cannot be used.
    """
    found = LabelledFiles()
    files = sorted(file for file in folder.iterdir())
    by_suffix = {suffix: [f for f in files if f.suffix.lower() == suffix] for suffix in LABEL_SUFFIXES}
    foreign: dict[str, InputError] = {}  # XML of other kinds, which is of no interest where there are images
    for label in by_suffix[".xml"]:
        try:
            found.images.append(_of_xml(label))
        except _NoLabelError as error:
            foreign[label.stem] = error
        except InputError as error:
            found.unusable[label.stem] = error
    labelled = {image.file for image in found.images}
    for file in sorted(by_suffix[".img"] + by_suffix[".vic"]):
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
    _add_feed(found, by_suffix[".json"], files)
    for file in (f for f in files if f.suffix.lower() == SITE_FILE):
        try:
            found.site_poses |= site_poses([file])
        except InputError as error:
            found.unusable[file.name] = error
    found.places = next((file for file in files if is_places(file)), None)
    found.images.sort(key=lambda image: image.file.name)
    if not found.images:
        found.unusable = {**foreign, **found.unusable}
    used = {image.file for image in found.images} | {image.label_file for image in found.images}
    used |= {file for image in found.images for file in files if _labels(file, image.file)}
    said = set(found.unusable)
    found.unread = [
        f
        for f in files
        if f not in used and not {f.stem, f.name} & said and f.suffix.lower() != SITE_FILE
        if f != found.places and f.is_file()
    ]
    return found


def _add(found: LabelledFiles, file: Path, read: Callable[[Path], LabelledImage]) -> None:
    try:
        found.images.append(read(file))
    except InputError as error:
        found.unusable.setdefault(file.stem, error)


def _labels(file: Path, picture: Path) -> bool:
    """Whether a file has the name of a label of a picture, which may have another one besides."""
    return file.stem == picture.stem and file.suffix.lower() in LABEL_SUFFIXES


def _add_feed(found: LabelledFiles, jsons: list[Path], files: list[Path]) -> None:
    """Add the pictures that records of the feed describe."""
    taken = {image.file for image in found.images}
    pictures = {f.name.lower(): f for f in files if looks_like_picture(f) and f not in taken}
    for file in jsons:
        try:
            records = feed_records(file)
        except InputError as error:
            found.unusable[file.name] = error
            continue
        alone = 0
        for record in records:
            picture = picture_of_record(record, pictures)
            if picture is None:
                alone += 1
            elif picture in taken:
                found.warnings.append(f"{record.where}: {picture.name} is described twice; the first counts")
            else:
                taken.add(picture)
                _add(found, picture, partial(feed_image, record))
        if alone and alone == len(records):
            expected = f"{file}: expected a picture of a record beside it"
            found.unusable[file.name] = InputError(f"{expected}, found none for {alone} of {alone}")
        elif alone:
            found.warnings.append(f"{file.name}: {alone} of its {len(records)} records have no picture here")


def _of_xml(label: Path) -> LabelledImage:
    root = read_xml(label)
    if root.name != _PRODUCT:
        raise _NoLabelError(f"{label}: expected a PDS4 label ({_PRODUCT}), found {root.name[:60]!r}")
    return exomars_image(root) if is_exomars(root) else rover_image_of_xml(root)


def _without_image(label: Path) -> LabelledImage:
    raise InputError(f"{label}: expected its image {label.stem}.IMG beside it, found none")
