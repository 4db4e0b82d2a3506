"""PDS4 labels of Perseverance: a real one with its fields changed.

What they do not prove: that other labels of the archive name their fields as this one does.
"""

import re
from pathlib import Path

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHVORE
from support.rover_labels import Mast, Shot, turned

REAL = "NLF_0629_0722782785_631ECM_N0301344NCAM00427_06_095J01"
"""The real label, without its ending."""
_VECTORS = {
    "C": ("Vector_Center", "_position"),
    "A": ("Vector_Axis", "_unit"),
    "H": ("Vector_Horizontal", "_pixel"),
    "V": ("Vector_Vertical", "_pixel"),
    "O": ("Vector_Optical", "_unit"),
}


def real_text(folder: Path) -> str:
    return (folder / f"{REAL}.xml").read_text()


def pds4_text(real: str, name: str, shot: Shot, mast: Mast, *, clock: str = "722782785.631") -> str:
    """The real label with the camera, joints, counters, pose and picture of another image."""
    rotation, point = mast.head(*shot.joints)
    model = turned(shot.head, rotation, point)
    assert isinstance(model, CAHVORE)
    text = with_camera(real, model)
    site, drive, moved = shot.counter
    for index, value in (("SITE", site), ("DRIVE", drive), ("RSM", moved)):
        text = counters(text, index, value)
    for joint, angle in zip(("AZIMUTH", "ELEVATION"), shot.joints, strict=True):
        text = once(
            rf"({joint} FINAL-RESOLVER</geom:index_id>\s*<geom:index_value_angle unit=\"rad\">)[^<]*",
            text,
            angle,
        )
    text = with_pose(text, shot.offset, shot.wxyz)
    text = re.sub(r"(<img:first_line>)\d+", r"\g<1>1", text)
    text = re.sub(r"(<img:first_sample>)\d+", r"\g<1>1", text)
    text = once(r"(<mars2020:spacecraft_clock_start>)[^<]*", text, clock)
    text = once(r"(<img_surface:ops_instrument_key>)[^<]*", text, shot.instrument)
    if shot.instrument.endswith("RIGHT"):  # the real label is the left camera's
        text = once(r"(<img_surface:instrument_serial_number>)[^<]*", text, "104")
    text = once(r"(<file_name>)[^<]*IMG", text, f"{name}.IMG")
    return sized(text, model.width_px, model.height_px)


def with_camera(text: str, model: CAHVORE) -> str:
    for letter, (entry, suffix) in _VECTORS.items():
        vector: FloatArray = getattr(model, letter)
        for axis, value in zip("xyz", vector, strict=True):
            pattern = rf"(<geom:{entry}>(?:(?!</geom:{entry}>).)*?<geom:{axis}{suffix}[^>]*>)[^<]*"
            text = once(pattern, text, value)
    for entry, values in (("Radial_Terms", model.R), ("Entrance_Terms", model.E)):
        for k, value in enumerate(values):
            text = once(rf"(<geom:{entry}>(?:(?!</geom:{entry}>).)*?<geom:c{k}>)[^<]*", text, value)
    text = once(r"(<geom:cahvore_model_type>)[^<]*", text, 3)
    return once(r"(<geom:cahvore_model_parameter>)[^<]*", text, model.linearity)


def with_pose(text: str, offset: tuple[float, ...], wxyz: tuple[float, ...]) -> str:
    """The rover's pose, the first coordinate space of the label."""
    start = text.index("<geom:Coordinate_Space_Definition>")
    head, spaces = text[:start], text[start:]
    for axis, value in zip("xyz", offset, strict=True):
        spaces = once(rf"(<geom:{axis}_position[^>]*>)[^<]*", spaces, value)
    for name, value in zip(("qcos", "qsin1", "qsin2", "qsin3"), wxyz, strict=True):
        spaces = once(rf"(<geom:{name}>)[^<]*", spaces, value)
    return head + spaces


def sized(text: str, width_px: int, height_px: int, bands: int = 1) -> str:
    for axis, value in (("Band", bands), ("Line", height_px), ("Sample", width_px)):
        text = once(rf"(<axis_name>{axis}</axis_name>\s*<elements>)\d+", text, value)
    return text


def counters(text: str, index: str, value: int) -> str:
    """A counter everywhere, also where frames are named by it."""
    pattern = rf"(<geom:index_id>{index}</geom:index_id>\s*<geom:index_value_number>)\d+"
    head, site_frames, tail = text.partition("<local_identifier>SITE_FRAME_")
    return re.sub(pattern, rf"\g<1>{value}", head) + site_frames + re.sub(pattern, rf"\g<1>{value}", tail)


def once(pattern: str, text: str, value: object) -> str:
    """The text with what follows the first match of a group replaced."""
    out, count = re.subn(pattern, lambda match: f"{match[1]}{value}", text, count=1, flags=re.DOTALL)
    assert count == 1, pattern
    return out


def write_pds4(folder: Path, name: str, text: str, samples: bytes, *, offset: int = 46656) -> Path:
    """A label, and its picture: a header without a label of its own, then samples."""
    (folder / f"{name}.xml").write_text(text)
    file = folder / f"{name}.IMG"
    file.write_bytes(b"\0" * offset + samples)
    return file


def small_pds4_text(model: CAHVORE, joints: tuple[float, float]) -> str:
    """A label with all that a reader needs and nothing else, for hostile changes; its picture is `a.dat`."""
    parts = {
        "C": ("position", ' unit="m"'),
        "A": ("unit", ""),
        "H": ("pixel", ""),
        "V": ("pixel", ""),
        "O": ("unit", ""),
    }
    vectors = ""
    for letter, (suffix, unit) in parts.items():
        axes = "".join(
            f"<{axis}_{suffix}{unit}>{value}</{axis}_{suffix}>\n"
            for axis, value in zip("xyz", getattr(model, letter), strict=True)
        )
        vectors += f"<{_VECTORS[letter][0]}>\n{axes}</{_VECTORS[letter][0]}>\n"
    for entry, terms in (("Radial_Terms", model.R), ("Entrance_Terms", model.E)):
        vectors += f"<{entry}>{''.join(f'<c{k}>{value}</c{k}>' for k, value in enumerate(terms))}</{entry}>\n"
    angles = "".join(
        f"<Device_Angle_Index><index_id>{joint} FINAL-RESOLVER</index_id>\n"
        f'<index_value_angle unit="rad">{angle}</index_value_angle></Device_Angle_Index>\n'
        for joint, angle in zip(("AZIMUTH", "ELEVATION"), joints, strict=True)
    )
    counter = "".join(
        f"<Motion_Counter_Index><index_id>{name}</index_id>\n"
        f"<index_value_number>{value}</index_value_number></Motion_Counter_Index>\n"
        for name, value in (("SITE", 30), ("DRIVE", 1344), ("RSM", 2))
    )
    axes = "".join(
        f"<Axis_Array><axis_name>{name}</axis_name><elements>{elements}</elements>\n"
        f"<sequence_number>{number}</sequence_number></Axis_Array>\n"
        for number, (name, elements) in enumerate(
            (("Line", model.height_px), ("Sample", model.width_px)), start=1
        )
    )
    pose = "".join(
        f"<{q}>{value}</{q}>\n"
        for q, value in (("qcos", 0.6), ("qsin1", 0.0), ("qsin2", 0.0), ("qsin3", 0.8))
    )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<Product_Observational>
<Observing_System_Component><name>Mars 2020</name>
<type>Host</type></Observing_System_Component>
<spacecraft_clock_start>722782785.631</spacecraft_clock_start>
<ops_instrument_key>NAVCAM_LEFT</ops_instrument_key>
<Articulation_Device_Parameters><device_id>RSM</device_id>
<Device_Angle>
{angles}</Device_Angle></Articulation_Device_Parameters>
<Coordinate_Space_Definition>
<Coordinate_Space_Present><coordinate_space_frame_type>ROVER_NAV_FRAME</coordinate_space_frame_type></Coordinate_Space_Present>
<Vector_Origin_Offset><x_position unit="m">94.6</x_position>
<y_position unit="m">-118.9</y_position><z_position unit="m">-7.5</z_position></Vector_Origin_Offset>
<Quaternion_Plus_Direction>{pose}<rotation_direction>Forward</rotation_direction></Quaternion_Plus_Direction>
<Coordinate_Space_Reference><coordinate_space_frame_type>SITE_FRAME</coordinate_space_frame_type></Coordinate_Space_Reference>
</Coordinate_Space_Definition>
<Motion_Counter>
{counter}</Motion_Counter>
<Camera_Model_Parameters><model_type>CAHVORE</model_type>
<CAHVORE_Model>
{vectors}<cahvore_model_type>3</cahvore_model_type>
<cahvore_model_parameter>{model.linearity}</cahvore_model_parameter></CAHVORE_Model>
<Coordinate_Space_Reference><coordinate_space_frame_type>ROVER_NAV_FRAME</coordinate_space_frame_type></Coordinate_Space_Reference>
</Camera_Model_Parameters>
<File_Area_Observational><File><file_name>a.dat</file_name></File>
<Array_2D_Image><offset unit="byte">0</offset>
<Element_Array><data_type>UnsignedByte</data_type></Element_Array>
{axes}</Array_2D_Image></File_Area_Observational>
</Product_Observational>
"""
