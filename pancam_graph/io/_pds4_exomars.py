"""One PDS4 label of the PanCam of ExoMars (Rosalind Franklin), which has pan and tilt but no camera model.

Source: two labels of ground tests, in which pan and tilt are 0 and the rover has no pose. So the senses of
both are assumptions: pan anticlockwise seen from above, tilt upwards.
"""

from functools import partial

import gtsam

from pancam_graph.base.errors import InputError
from pancam_graph.cameras import as_cahv
from pancam_graph.io._clock import plain_clock
from pancam_graph.io._labelled_image import LabelledImage
from pancam_graph.io._pds4_image import motion_counter
from pancam_graph.io._pds4_samples import described_picture
from pancam_graph.io._template_cameras import subframed
from pancam_graph.io._xml import XmlElement
from pancam_graph.rigs import EXOMARS_MAST, Rig, RigUncertainty, exomars_pancam

__all__ = ["exomars_image", "is_exomars"]

_EYES = {"WACL": "wac-left", "WACR": "wac-right", "HRC": "hrc"}
"""Eyes of the template, by the identifier of the sub-instrument."""
_REMARK = (
    "ExoMars: the labels have no camera model, the template's stands in; pan is taken anticlockwise, tilt "
    "upwards, and a subframe where it is in the picture as stored"
)


def is_exomars(root: XmlElement) -> bool:
    """Whether a label is of the rover of ExoMars."""
    investigation = root.first("Investigation_Area")
    return investigation is not None and investigation.said("name", "").upper().startswith("EXOMARS")


def exomars_image(root: XmlElement) -> LabelledImage:
    """The image that a label describes: the template's camera at its size, binning, subframe, pan and tilt.

    Raises InputError naming file and entry for what is missing, malformed or not of PanCam, and ImageError
    for a picture
    that is missing, too short or of another size than its label says.
    """
    unit = root.required("Sub-Instrument").required("identifier")
    name = _EYES.get(unit.text.upper())
    if name is None:
        unit.refuse(f"a camera of PanCam ({', '.join(_EYES)})", repr(unit.text[:60]))
    rig = exomars_pancam()
    file, width_px, height_px, bits = described_picture(root)
    binned, left_px, top_px = _part(root, rig, width_px, height_px)
    eye = rig.eyes[rig.eye_index(name)]
    head_model = as_cahv(eye.camera).transformed(eye.head_T_camera)
    pan, tilt = _angles_rad(root)
    rover_T_head = EXOMARS_MAST.rover_T_head(-pan, tilt)
    counter = motion_counter(root)
    part = subframed(head_model, width_px, height_px, binned=binned, left_px=left_px, top_px=top_px)
    return LabelledImage(
        file=file,
        label_file=root.file,
        host="EXOMARS",
        instrument=name.upper(),
        serial="",
        stop=(counter["SITE"], counter["DRIVE"]),
        mast=EXOMARS_MAST,
        uncertainty_of=partial(_uncertainty, rig.uncertainty),
        mast_counter=counter.get("MAST/PTU"),
        clock_start=plain_clock(root.said("spacecraft_clock_start_count", "")),
        first_line_sample=(1 + int(top_px), 1 + int(left_px)),
        sample_bits=bits,
        pan_tilt_rad=EXOMARS_MAST.pan_tilt_rad(-pan, tilt),
        world_T_rover=gtsam.Pose3(),
        model=part.transformed(rover_T_head),
        levelled=False,
        placed=False,
        remark=_REMARK,
    )


def _uncertainty(uncertainty: RigUncertainty, side_px: int) -> RigUncertainty:
    return uncertainty


def _angles_rad(root: XmlElement) -> tuple[float, float]:
    """Pan and tilt of the mast's pan-tilt unit."""
    for device in root.every("Articulation_Device_Parameters"):
        if "PTU" not in device.said("device_name", "").upper():
            continue
        found = {
            entry.said("index_name", entry.said("index_id", "")).lower(): entry.required("index_value_angle")
            for entry in device.every("Device_Angle_Index")
        }
        if {"pan", "tilt"} <= found.keys():
            return found["pan"].angle_rad(), found["tilt"].angle_rad()
    raise InputError(
        f"{root.file}: Articulation_Device_Parameters: expected pan and tilt of the Mast PTU, found none"
    )


def _part(root: XmlElement, rig: Rig, width_px: int, height_px: int) -> tuple[int, int, int]:
    """Detector pixels along a side of a pixel, and how many pixels are left of the part and above it."""
    full_px = rig.longest_side_px
    averaging = root.first("Pixel_Averaging_Dimensions")
    binned = 1 if averaging is None else averaging.whole("width_pixels", 1, least=1)
    if averaging is not None and averaging.whole("height_pixels", 1, least=1) != binned:
        averaging.refuse(f"height_pixels as width_pixels, {binned}", averaging.said("height_pixels"))
    subframe = root.first("Subframe")
    if subframe is None:
        left_px = top_px = 0
    else:
        top_px, left_px = (subframe.whole(entry, 1, least=1) - 1 for entry in ("first_line", "first_sample"))
        told = subframe.whole("samples", width_px), subframe.whole("lines", height_px)
        if told == (width_px * binned, height_px * binned) and binned > 1:  # it counts pixels of the detector
            top_px, left_px = top_px // binned, left_px // binned
        elif told != (width_px, height_px):
            subframe.refuse(
                f"lines and samples as of the image, {height_px} and {width_px}", f"{told[1]} and {told[0]}"
            )
    if max(left_px + width_px, top_px + height_px) * binned > full_px:
        raise InputError(
            f"{root.file}: expected a part of {full_px} x {full_px} pixels, found {width_px} x {height_px} "
            f"of {binned} x {binned} each from {left_px + 1}, {top_px + 1} on"
        )
    return binned, left_px, top_px
