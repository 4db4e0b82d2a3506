"""Frame cameras of the Community Sensor Model as USGS has them: model states, one an image.

Source: UsgsAstroFrameSensorModel of usgscsm (state keys, groundToImage, numbers of distortion models). Its
pixels have the centre of the first at (0.5, 0.5). The focal length is in pixels, so that the focal plane has
a pitch of 1; skew and the ratio of focal lengths are in the transform from it to pixels.
"""

import json
from pathlib import Path

import numpy as np

from pancam_graph.base.geometry import wxyz_from_rotation
from pancam_graph.cameras import Brown
from pancam_graph.results.formats._one_an_image import write_brown_cameras
from pancam_graph.results.formats._source import Source

__all__ = ["write_csm"]

_MODEL = "USGS_ASTRO_FRAME_SENSOR_MODEL"
_RADIAL, _RADTAN = 0, 7
"""Numbers of distortion models: radial, here without coefficients, and Brown's as OpenCV has it."""
_FIRST_PIXEL = 0.5
_HEIGHT_M = 1e4
_NO_PLANET_M = 1.0
"""Radii of the ellipsoid in a local frame: a metre about its origin, of which no ray should be asked."""


def write_csm(source: Source, folder: Path) -> None:
    """Write `IMAGE.json`, a model state, of each image into an empty folder; see `write_brown_cameras`."""
    write_brown_cameras(source, folder, "csm", ".json", _state, skew=True)


def _state(source: Source, image: int, lens: Brown) -> str:
    pose = source.body_T_camera(image)
    w, x, y, z = wxyz_from_rotation(pose.rotation().matrix()).tolist()
    f = lens.fx_px
    to_pixel = np.array([[1.0, lens.skew_px / f], [0.0, lens.fy_px / f]])
    to_plane = np.linalg.inv(to_pixel)
    identity, site = source.identities[image], source.solution.traverse.site
    state = {
        "m_modelName": _MODEL,
        "m_sensorName": identity.instrument,
        "m_platformName": identity.mission,
        "m_focalLength": f,
        "m_iTransS": [0.0, *to_pixel[0].tolist()],
        "m_iTransL": [0.0, *to_pixel[1].tolist()],
        # From lines and samples, in this order, to the focal plane.
        "m_transX": [0.0, float(to_plane[0, 1]), float(to_plane[0, 0])],
        "m_transY": [0.0, float(to_plane[1, 1]), float(to_plane[1, 0])],
        "m_boresight": [0.0, 0.0, 1.0],
        "m_majorAxis": _NO_PLANET_M if site is None else site.shape.equator_m,
        "m_minorAxis": _NO_PLANET_M if site is None else site.shape.pole_m,
        "m_spacecraftVelocity": [0.0, 0.0, 0.0],
        "m_sunPosition": [0.0, 0.0, 0.0],
        "m_startingDetectorSample": 0.0,
        "m_startingDetectorLine": 0.0,
        "m_detectorSampleSumming": 1.0,
        "m_detectorLineSumming": 1.0,
        "m_targetName": "" if site is None else site.body,
        "m_ifov": 0.0,
        "m_instrumentID": identity.instrument,
        "m_focalLengthEpsilon": 0.0,
        "m_ccdCenter": [lens.cy_px + _FIRST_PIXEL, lens.cx_px + _FIRST_PIXEL],
        "m_minElevation": -_HEIGHT_M,
        "m_maxElevation": _HEIGHT_M,
        "m_distortionType": _RADTAN if any(lens.distortion) else _RADIAL,
        "m_opticalDistCoeffs": list(lens.distortion) if any(lens.distortion) else [0.0, 0.0, 0.0],
        "m_originalHalfLines": lens.height_px / 2,
        "m_originalHalfSamples": lens.width_px / 2,
        "m_spacecraftName": identity.mission,
        "m_pixelPitch": 1.0,
        "m_ephemerisTime": 0.0,
        "m_nLines": lens.height_px,
        "m_nSamples": lens.width_px,
        "m_lineJitter": [],
        "m_sampleJitter": [],
        "m_lineTimes": [],
        "m_currentParameterValue": [*pose.translation().tolist(), x, y, z, w],
        "m_currentParameterCovariance": [0.0] * 49,
        "m_imageIdentifier": identity.unique_id,
        "m_collectionIdentifier": "",
        "m_referencePointXyz": [*pose.translation().tolist()],
    }
    return f"{_MODEL}\n{json.dumps(state, indent=2, allow_nan=False)}\n"
