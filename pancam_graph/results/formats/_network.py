"""ISIS control networks as CSV."""

import json
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import LandmarkPosition
from pancam_graph.io import network_csv
from pancam_graph.results.formats._source import Source
from pancam_graph.results.formats._vicar import pairs_of_tracks

__all__ = ["write_network"]

_FREE, _CONSTRAINED = 2, 3
_SUBPIXEL, _MANUAL = 3, 1
"""Types of measures: registered to a fraction of a pixel, and made by hand."""
_FIRST_PIXEL = 1.0
_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


def write_network(source: Source, path: Path) -> None:
    """Write a control network: a row a measure of each track that two images see.

    Constraints on whole positions become constrained points; others have no place, and a warning counts them.
    Raises InputError without observations that join two images.
    """
    solution = source.solution
    traverse, observations = solution.traverse, solution.traverse.observations
    names = {} if observations is None else {track: name for name, track in observations.point_track.items()}
    known = {
        traverse.track_of(one.landmark): one
        for one in traverse.constraints
        if isinstance(one, LandmarkPosition) and len(one.axes) == 3
    }
    lost = sum(bool(one.landmarks) for one in traverse.constraints) - len(known)
    rows: list[dict[str, str]] = []
    for track, seen in pairs_of_tracks(source):
        assert observations is not None  # there are rows
        landmark = int(solution.landmark_row[seen[0]])
        point = {"id": names.get(track, str(track)), "pointType": str(_FREE), "pointIgnore": "False"}
        if track in known:
            one = known[track]
            place, covariance = _fixed(source, one.target_m, one.covariance)
            point |= {"pointType": str(_CONSTRAINED), "aprioriCovar": json.dumps(covariance[_UPPER].tolist())}
            point |= _xyz("apriori", place)
        if landmark >= 0 and np.isfinite(solution.final.landmarks_m[landmark]).all():
            place, _ = _fixed(source, solution.final.landmarks_m[landmark], np.zeros((3, 3)))
            point |= _xyz("adjusted", place)
            if track not in known:
                point |= _xyz("apriori", place)
        for row in seen.tolist():
            u, v = observations.uv_px[row].tolist()
            residual = solution.residual_final_px[row]
            measure = {
                "serialnumber": source.identities[int(observations.image[row])].unique_id,
                "measureType": str(_MANUAL if track in names else _SUBPIXEL),
                "measureIgnore": "False",
                "sample": repr(u + _FIRST_PIXEL),
                "line": repr(v + _FIRST_PIXEL),
                "samplesigma": repr(float(solution.sigma_px[row])),
                "linesigma": repr(float(solution.sigma_px[row])),
            }
            if np.isfinite(residual).all():
                measure |= {
                    "sampleResidual": repr(float(residual[0])),
                    "lineResidual": repr(float(residual[1])),
                }
            rows.append(point | measure)
    if not rows:
        raise InputError("control-network: expected observations that join two images, found none")
    if lost:
        source.warnings.append(
            f"control-network: {lost} constraints on points are no whole positions: left out"
        )
    path.write_bytes(network_csv(rows))


def _fixed(source: Source, place: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A place of the world and its covariance in the body's own frame, where the drive has one."""
    site = source.solution.traverse.site
    if site is None:
        return place, covariance
    rotation, origin = site.body_frame
    return rotation @ place + origin, rotation @ covariance @ rotation.T


def _xyz(kind: str, place: FloatArray) -> dict[str, str]:
    return {f"{kind}{axis}": repr(value) for axis, value in zip("XYZ", place.tolist(), strict=True)}
