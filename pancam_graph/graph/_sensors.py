"""Constraints on terrain points as observations by sensors that are no cameras.

A sensor stands at a known place of the world, or at the origin of a stop's mast, and keeps its orientation in
the world: of a stop's pose it depends on the position alone. So a constraint is eliminated with its point.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, axes_across, rz
from pancam_graph.cameras import Fields, LensTable, Sensor
from pancam_graph.data import (
    Constraint,
    LandmarkAzimuth,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPlane,
    LandmarkPosition,
    Traverse,
)
from pancam_graph.elimination import Linkage, Posture
from pancam_graph.landmarks import CameraViews

__all__ = ["Sensors", "Sight", "sights_of"]

_PER_M = 1e-6
"""Sigma of the inverse distance, 1/m, of a point that is at infinity."""


class Sight(NamedTuple):
    """A constraint, or two coordinates of one, as an observation of its point."""

    constraint: int
    """Row of the constraint."""
    track: int
    """Track of the point."""
    kind: Sensor
    world_R_sensor: FloatArray
    """(3, 3)"""
    centre_m: FloatArray
    """(3,) of a sensor at a known place"""
    stop: int
    """Row of the stop whose mast's origin the sensor stands at; -1: at a known place"""
    uv: FloatArray
    """(2,) what it is known to see"""
    sigma: FloatArray
    """(1,) or (2,) standard deviations: of u, or of u and v"""

    @property
    def whitening(self) -> FloatArray:
        """(2, 2) matrix that takes a residual to unit covariance; its second row is 0 without v."""
        return np.diag(np.append(1 / self.sigma, 0.0)[:2])


def sights_of(traverse: Traverse) -> list[Sight]:
    """The constraints of a traverse that are about terrain points; its observations have their tracks."""
    return [sight for i, one in enumerate(traverse.constraints) for sight in _sights(traverse, i, one)]


def _sights(traverse: Traverse, i: int, one: Constraint) -> Iterator[Sight]:
    if not one.landmarks:
        return
    track = traverse.track_of(one.landmarks[0])
    assert track is not None  # the traverse has observations, and looked
    nowhere, none = np.zeros(3), np.zeros(2)

    def sight(
        kind: Sensor,
        sigma: FloatArray | list[float],
        *,
        axes: FloatArray | None = None,
        centre: FloatArray = nowhere,
        stop: int = -1,
        uv: FloatArray = none,
    ) -> Sight:
        rotation = np.eye(3) if axes is None else axes
        return Sight(i, track, kind, rotation, centre, stop, uv, np.asarray(sigma))

    if isinstance(one, LandmarkPosition):
        variance, vectors = np.linalg.eigh(one.covariance)
        along = np.zeros((3, len(variance)))
        along[one.axes] = vectors
        centre = np.zeros(3)
        centre[one.axes] = one.target_m
        sigma = np.sqrt(variance)
        for first in range(0, len(sigma), 2):
            some = slice(first, first + 2)
            yield sight(Sensor.COORDINATES, sigma[some], axes=_rotation(along[:, some]), centre=centre)
    elif isinstance(one, LandmarkHeight | LandmarkPlane):
        normal = np.array([0.0, 0.0, 1.0]) if isinstance(one, LandmarkHeight) else one.unit_normal
        yield sight(
            Sensor.COORDINATES, [one.sigma], axes=_rotation(normal[:, None]), centre=one.value * normal
        )
    elif isinstance(one, LandmarkAzimuth):
        yield sight(Sensor.AZIMUTH, [one.sigma], axes=rz(one.value), stop=_row(traverse, one.stop))
    elif isinstance(one, LandmarkElevation):
        seen = np.array([one.value, 0.0])
        yield sight(Sensor.ELEVATION, [one.sigma], stop=_row(traverse, one.stop), uv=seen)
    elif isinstance(one, LandmarkInfinity):
        assert traverse.observations is not None
        image = int(traverse.observations.image[np.argmax(traverse.observations.track == track)])
        stop = traverse.stops[int(traverse.image_stop[image])]
        yield sight(Sensor.INVERSE_RANGE, [_PER_M], centre=stop.world_T_mast.translation())


def _row(traverse: Traverse, stop: str) -> int:
    return [s.id for s in traverse.stops].index(stop)


def _rotation(along: FloatArray) -> FloatArray:
    """A rotation (3, 3) whose first columns are these one or two (3, k) orthonormal ones."""
    first = along[:, 0]
    second = along[:, 1] if along.shape[1] > 1 else axes_across(first[None])[0, 0]
    return np.column_stack([first, second, np.cross(first, second)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensors:
    """Sensors that follow the images of a template, one a sight."""

    world_R_sensor: FloatArray
    """(sensors, 3, 3)"""
    centre_m: FloatArray
    """(sensors, 3) of those at known places"""
    stop: IntArray
    """(sensors,) row of the stop that each stands at; -1: none"""
    kind: IntArray
    """(sensors,) kind of each"""

    @staticmethod
    def of(sights: Sequence[Sight]) -> "Sensors":
        """One for each sight."""
        return Sensors(
            world_R_sensor=np.array([s.world_R_sensor for s in sights]),
            centre_m=np.array([s.centre_m for s in sights]),
            stop=np.array([s.stop for s in sights], dtype=np.int64),
            kind=np.array([int(s.kind) for s in sights], dtype=np.int64),
        )

    def linked(self, link: Linkage, mast: Sequence[int | None]) -> Linkage:
        """A linkage with these behind its images; `mast` has the key of each stop's mast, None if held."""
        moving = self._moving(mast)
        of_mast = [link.row[key] for s in self.stop[moving] if (key := mast[s]) is not None]
        n, fields = len(moving), link.fields
        if fields is not None:
            column = np.concatenate([fields.image_column, np.zeros(n, dtype=np.int64)])
            fields = replace(fields, image_column=column)
        n_segments, n_units = len(link.segment_variable), len(link.segment_begin) - 1
        return replace(
            link,
            image_unit=np.concatenate([link.image_unit, n_units + np.arange(n)]),
            segment_begin=np.concatenate([link.segment_begin, n_segments + np.cumsum(moving)]),
            segment_variable=np.concatenate([link.segment_variable, np.array(of_mast, dtype=np.int64)]),
            segment_column=np.append(link.segment_column, np.zeros(len(of_mast), dtype=np.int64)),
            segment_width=np.append(link.segment_width, np.full(len(of_mast), 6)),
            segment_plain=np.append(link.segment_plain, np.zeros(len(of_mast), dtype=bool)),
            fields=fields,
        )

    def postured(
        self, posture: Posture, masts: tuple[FloatArray, FloatArray], mast: Sequence[int | None]
    ) -> Posture:
        """A posture with these behind its images; `masts` are rotations and translations of all stops."""
        moving = self._moving(mast)
        chain = np.zeros((int(moving.sum()), *posture.chain.shape[1:]))
        # Turns of the mast leave the sensor as it is; shifts along its axes are turned to the world's.
        chain[:, 3:6, 3:6] = masts[0][self.stop[moving]]
        views = self.behind(posture.views, masts[1])
        return Posture(
            views=views,
            unit_R=np.concatenate([posture.unit_R, np.tile(np.eye(3), (len(moving), 1, 1))]),
            unit_t=np.concatenate([posture.unit_t, views.world_t_camera[-len(moving) :]]),
            chain=np.concatenate([posture.chain, chain]),
        )

    def behind(self, views: CameraViews, mast_t: FloatArray) -> CameraViews:
        """Cameras with these behind them; `mast_t` (stops, 3) are origins of masts in the world."""
        n, n_images = len(self.stop), len(views.world_t_camera)
        at_stop = (self.stop >= 0)[:, None]
        fields = views.fields
        if fields is not None:
            fields = Fields(
                coefficients_px=fields.coefficients_px,
                row=np.concatenate([fields.row, np.full(n, -1)]),
                size_px=np.concatenate([fields.size_px, np.ones((n, 2))]),
            )
        return CameraViews(
            world_R_camera=np.concatenate([views.world_R_camera, self.world_R_sensor]),
            world_t_camera=np.concatenate(
                [views.world_t_camera, np.where(at_stop, mast_t[self.stop], self.centre_m)]
            ),
            calibration=np.concatenate([views.calibration, np.tile(np.eye(3), (n, 1, 1))]),
            lenses=LensTable.joined(
                [views.lenses or LensTable.without(n_images), LensTable.of_sensors(self.kind)]
            ),
            fields=fields,
        )

    def _moving(self, mast: Sequence[int | None]) -> BoolArray:
        """(sensors,) whether each moves with a mast that is a variable."""
        free = np.array([key is not None for key in mast])
        return np.asarray((self.stop >= 0) & free[self.stop])
