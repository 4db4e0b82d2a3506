"""What a PDS4 label says of its image's samples: an .xml beside a file with an uncompressed array.

Source: PDS4 information model, classes Array_2D_Image, Array_3D_Image, Element_Array, Special_Constants.
"""

from pathlib import Path
from typing import Any

import numpy as np

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.regular_files import is_missing
from pancam_graph.io._image_layout import ImageLayout, Storage, require_sides
from pancam_graph.io._picture_size import WantedSize, looks_like_picture, require_size, size_of_file
from pancam_graph.io._stored_image import STORED_IMAGES, StoredImage
from pancam_graph.io._told_numbers import told_number
from pancam_graph.io._xml import XmlElement, read_xml

__all__ = ["described_picture", "pds4_host", "pds4_image", "pds4_label_of"]

_ARRAYS = ("Array_2D_Image", "Array_3D_Image", "Array_2D", "Array_3D")
_TYPES = {
    "UnsignedByte": "u1",
    "SignedByte": "i1",
    "UnsignedMSB2": ">u2",
    "UnsignedLSB2": "<u2",
    "SignedMSB2": ">i2",
    "SignedLSB2": "<i2",
    "UnsignedMSB4": ">u4",
    "UnsignedLSB4": "<u4",
    "SignedMSB4": ">i4",
    "SignedLSB4": "<i4",
    "IEEE754MSBSingle": ">f4",
    "IEEE754LSBSingle": "<f4",
    "IEEE754MSBDouble": ">f8",
    "IEEE754LSBDouble": "<f8",
}
_STORAGES: dict[tuple[str, ...], Storage] = {
    ("Line", "Sample"): "BAND_SEQUENTIAL",
    ("Band", "Line", "Sample"): "BAND_SEQUENTIAL",
    ("Line", "Band", "Sample"): "LINE_INTERLEAVED",
    ("Line", "Sample", "Band"): "SAMPLE_INTERLEAVED",
}
_ABSENT = (
    "missing_constant",
    "invalid_constant",
    "unknown_constant",
    "not_applicable_constant",
    "error_constant",
)
_PICTURES = (".img", ".dat", ".raw", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".jp2")
"""How the picture of a label that does not name it may end."""


def pds4_label_of(file: Path) -> Path | None:
    """The .xml of the name of a picture beside it; None if there is none."""
    return next(
        (label for label in (file.with_suffix(s) for s in (".xml", ".XML")) if not is_missing(label)), None
    )


def pds4_host(root: XmlElement) -> str:
    """The spacecraft that a label names, in capitals; "" for a label that names none."""
    for component in root.every("Observing_System_Component"):
        if component.said("type", "").lower() in {"host", "spacecraft", "rover", "lander"}:
            return component.said("name", "").upper()
    return ""


def pds4_image(file: Path, label: Path) -> StoredImage:
    """What a PDS4 label says of the samples of a file.

    Raises InputError for a label that cannot be read, and as for their type.
    """
    return _image_of_xml(read_xml(label), file)


def _image_of_xml(root: XmlElement, file: Path) -> StoredImage:
    """What a label says of the samples of a file; kept, so that decoding it does not parse the label again.

    Raises ImageError for a label without an image, or with samples of a type that is not read.
    """
    try:
        image = StoredImage(
            layout=_layout(root, file), no_data=_no_data(_array(root)), host=pds4_host(root) or None
        )
    except ImageError:
        raise
    except InputError as error:
        raise ImageError(str(error)) from error
    STORED_IMAGES.keep(file, image, made_from=[root.file])
    return image


def described_picture(root: XmlElement, picture: Path | None = None) -> tuple[Path, int, int, int]:
    """The picture of a label, its width and height in pixels, and the bits of its samples as they are read.

    The picture is the one given, else the one that the label names beside itself, else one of its own name.
    The size of a PNG or JPEG is that of its header; an array of the label must be of the same size.
    Raises ImageError for a picture that is missing, too short or of another size.
    """
    file = _picture_of_xml(root) if picture is None else picture
    if looks_like_picture(file):
        width_px, height_px = size_of_file(file)
        if _first_array(root) is not None:
            layout = _layout(root, file)
            told = f"{layout.width_px} x {layout.height_px} pixels as of {root.file.name}"
            require_size(
                file,
                (width_px, height_px),
                WantedSize(width_px=layout.width_px, height_px=layout.height_px, words=told),
            )
        return file, width_px, height_px, 8
    layout = _image_of_xml(root, file).layout
    layout.require_complete()
    return file, layout.width_px, layout.height_px, layout.sample_bits


def _picture_of_xml(root: XmlElement) -> Path:
    """The picture that a label is of: the file that it names beside itself, else one of its own name.

    Raises ImageError where the name leads elsewhere, and where there is none.
    """
    area = root.required("File_Area_Observational")
    told = area.said("file_name", "")
    if told:
        if Path(told).name != told or told in {".", ".."}:
            raise ImageError(f"{root.file}: file_name: expected a file beside the label, found {told[:80]!r}")
        file = root.file.with_name(told)
        if is_missing(file):  # archives disagree about the case of names
            file = next((f for f in root.file.parent.iterdir() if f.name.lower() == told.lower()), file)
        if is_missing(file):
            raise ImageError(
                f"{root.file}: file_name: expected the image {told} beside the label, found none"
            )
        return file
    for other in sorted(root.file.parent.glob(f"{_escaped(root.file.stem)}.*")):
        if other.suffix.lower() in _PICTURES:
            return other
    raise ImageError(f"{root.file}: expected an image of the label's name beside it, found none")


def _escaped(name: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def _first_array(root: XmlElement) -> XmlElement | None:
    area = root.required("File_Area_Observational")
    return next((array for name in _ARRAYS for array in area.every(name)), None)


def _array(root: XmlElement) -> XmlElement:
    found = _first_array(root)
    if found is None:
        raise ImageError(f"{root.file}: expected an Array_2D_Image or Array_3D_Image, found none")
    return found


def _layout(root: XmlElement, file: Path) -> ImageLayout:
    array = _array(root)
    axes = sorted(
        (axis.whole("sequence_number"), axis.said("axis_name").title(), axis.whole("elements"))
        for axis in array.every("Axis_Array")
    )
    names = tuple(name for _, name, _ in axes)
    storage = _STORAGES.get(names)
    if storage is None or array.said("axis_index_order", "Last Index Fastest") != "Last Index Fastest":
        array.refuse(
            "axes Line and Sample, and Band where there are colours, last index fastest", ", ".join(names)
        )
    size = {name: elements for _, name, elements in axes}
    require_sides(
        f"{root.file}: {array.name}",
        "Line, Sample, Band",
        size["Line"],
        size["Sample"],
        size.get("Band", 1),
    )
    elements = array.required("Element_Array")
    kind = elements.said("data_type")
    if kind not in _TYPES:
        elements.refuse(f"a data_type of {', '.join(_TYPES)}", repr(kind[:60]))
    return ImageLayout(
        file=file,
        entry=array.name,
        offset_bytes=array.whole("offset"),
        width_px=size["Sample"],
        height_px=size["Line"],
        bands=size.get("Band", 1),
        dtype=np.dtype(_TYPES[kind]),
        storage=storage,
        factor=_scale(elements, "scaling_factor", 1.0),
        shift=_scale(elements, "value_offset", 0.0),
    )


def _scale(elements: XmlElement, name: str, default: float) -> float:
    found = elements.first(name)
    number: Any = default if found is None else told_number(found.text)
    if number is None:
        raise ImageError(f"{elements.file}: {name}: expected a number, found another text")
    return float(number)


def _no_data(array: XmlElement) -> tuple[float, ...]:
    """Constants of samples without a value; those written otherwise (16#...#) are reals beyond all."""
    constants = array.first("Special_Constants")
    if constants is None:
        return ()
    told = [told_number(e.text) for name in _ABSENT for e in constants.every(name)]
    return tuple(number for number in told if number is not None)
