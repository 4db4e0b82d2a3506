"""Constraints on terrain points as observations by sensors that are no cameras.

A sensor stands at a known place of the world, or at the origin of a stop's mast, and keeps its orientation in
the world: of a stop's pose it depends on the position alone. So a constraint is eliminated with its point.

What joins two points cannot be: such a point becomes a variable, a place in the world. Sensors that stand
there hold the eliminated point to it, exactly (`data.EXACT`), and a factor joins the two places.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, axes_across, rz, skew
from pancam_graph.cameras import SURFACE_HEAD, Fields, LensTable, Sensor
from pancam_graph.data import (
    EXACT,
    Constraint,
    LandmarkAzimuth,
    LandmarkDistance,
    LandmarkElevation,
    LandmarkHeight,
    LandmarkInfinity,
    LandmarkPlane,
    LandmarkPosition,
    LandmarkSurface,
    Surface,
    Traverse,
)
from pancam_graph.elimination import Linkage, Posture
from pancam_graph.graph._factors import FactorList
from pancam_graph.graph._keys import Kind, key_of
from pancam_graph.landmarks import CameraViews

__all__ = ["Sensors", "Sight", "sights_of"]

_PER_M = 1e-6
"""Sigma of the inverse distance, 1/m, of a point that is at infinity."""
_LOOSE_M = 1e4
"""Sigma of priors that hold a variable of a point where no observation does."""
_UP = np.eye(3)[:, [2, 0, 1]]
"""(3, 3) axes of a sensor that sees heights."""
_MARGIN = 32
"""Nodes of a surface that compiled loops have beyond the first places of points on it."""


class Sight(NamedTuple):
    """A constraint, or two coordinates of one, as an observation of its point."""

    constraint: int
    """Row of the constraint; -1: it holds its point to the variable of that point"""
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
    surface: Surface | None = None
    """The surface that it sees heights above."""

    @property
    def whitening(self) -> FloatArray:
        """(2, 2) matrix that takes a residual to unit covariance; its second row is 0 without v."""
        return np.diag(np.append(1 / self.sigma, 0.0)[:2])


def sights_of(traverse: Traverse) -> list[Sight]:
    """The constraints of a traverse that are about terrain points; its observations have their tracks.

    Of points that a constraint joins, those that hold them to their variables.
    """
    of_one = [sight for i, one in enumerate(traverse.constraints) for sight in _sights(traverse, i, one)]
    joined = [one.landmarks for one in traverse.constraints if isinstance(one, LandmarkDistance)]
    tracks = {traverse.track_of(landmark) for pair in joined for landmark in pair}
    return [
        *of_one,
        *(sight for track in sorted(t for t in tracks if t is not None) for sight in _held(track)),
    ]


def _held(track: int) -> Iterator[Sight]:
    """The three coordinates of a point, as they are at the place of its variable."""
    for axes, n in ((np.eye(3), 2), (_UP, 1)):
        yield Sight(-1, track, Sensor.COORDINATES, axes, np.zeros(3), -1, np.zeros(2), np.full(n, EXACT))


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
        surface: Surface | None = None,
    ) -> Sight:
        rotation = np.eye(3) if axes is None else axes
        return Sight(i, track, kind, rotation, centre, stop, uv, np.asarray(sigma), surface)

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
    elif isinstance(one, LandmarkSurface):
        yield sight(Sensor.SURFACE, [one.sigma], surface=one.surface)
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
    if along.shape[1] == 1 and along[2, 0] == 1:
        return _UP
    first = along[:, 0]
    second = along[:, 1] if along.shape[1] > 1 else axes_across(first[None])[0, 0]
    return np.column_stack([first, second, skew(first) @ second])


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensors:
    """Sensors that follow the images of a template, one a sight."""

    world_R_sensor: FloatArray
    """(sensors, 3, 3)"""
    centre_m: FloatArray
    """(sensors, 3) of those at known places; of those at variables, the first values of these"""
    stop: IntArray
    """(sensors,) row of the stop that each stands at; -1: none"""
    kind: IntArray
    """(sensors,) kind of each"""
    point: IntArray
    """(sensors,) number of the point's variable that each stands at; -1: none"""
    track: IntArray
    """(points,) track of each point that is a variable"""
    surface: IntArray
    """(sensors,) place in `surfaces` of what each sees heights above; -1: nothing"""
    surfaces: tuple[Surface, ...] = ()

    @staticmethod
    def of(sights: Sequence[Sight], place_m: FloatArray) -> "Sensors":
        """One for each sight; `place_m` (sights, 3) are first places of their points."""
        holds = np.array([s.constraint < 0 for s in sights])
        of_track = np.array([s.track for s in sights], dtype=np.int64)
        track = np.unique(of_track[holds])
        distinct = {id(s.surface): s.surface for s in sights if s.surface is not None}
        number = {one: i for i, one in enumerate(distinct)}
        surface = np.array([number.get(id(s.surface), -1) for s in sights], dtype=np.int64)
        return Sensors(
            world_R_sensor=np.array([s.world_R_sensor for s in sights]),
            centre_m=np.where(holds[:, None], place_m, [s.centre_m for s in sights]),
            stop=np.array([s.stop for s in sights], dtype=np.int64),
            kind=np.array([int(s.kind) for s in sights], dtype=np.int64),
            point=np.where(holds, np.searchsorted(track, of_track), -1),
            track=track,
            surface=surface,
            surfaces=tuple(
                one.around(place_m[surface == i, :2], _MARGIN) for i, one in enumerate(distinct.values())
            ),
        )

    @cached_property
    def point_keys(self) -> dict[int | None, int]:
        """Keys of the points that are variables, by track."""
        return {track: key_of(Kind.LANDMARK, i) for i, track in enumerate(self.track.tolist())}

    @cached_property
    def _first_m(self) -> FloatArray:
        """(points, 3) first values of the points that are variables."""
        first = [np.argmax(self.point == i) for i in range(len(self.track))]
        return np.asarray(self.centre_m[first])

    def insert(self, values: gtsam.Values, present: gtsam.Values | None = None) -> None:
        """Insert the points that are variables, at their first values or at those of `present`."""
        for key, first in zip(self.point_keys.values(), self._first_m, strict=True):
            values.insert(key, first if present is None else present.atPoint3(key))

    def priors(self) -> FactorList:
        """Priors of the points that are variables, so loose that they only hold a point that nothing sees."""
        loose = gtsam.noiseModel.Isotropic.Sigma(3, _LOOSE_M)
        return [
            gtsam.PriorFactorPoint3(key, first, loose)
            for key, first in zip(self.point_keys.values(), self._first_m, strict=True)
        ]

    def linked(self, link: Linkage, mast: Sequence[int | None]) -> Linkage:
        """A linkage with these behind its images; `mast` has the key of each stop's mast, None if held.

        Points that are variables are of the group that stops share.
        """
        moving = self._moving(mast)
        n, fields, n_points = len(moving), link.fields, len(self.track)
        row = {key: i for i, key in enumerate(link.key)}
        by_stop = np.array([-1 if key is None else row[key] for key in mast])[self.stop]
        variable = np.where(self.point >= 0, len(link.key) + self.point, by_stop)[moving]
        if fields is not None:
            column = np.concatenate([fields.image_column, np.zeros(n, dtype=np.int64)])
            fields = replace(fields, image_column=column)
        n_segments, n_units = len(link.segment_variable), len(link.segment_begin) - 1
        return replace(
            link,
            key=(*link.key, *self.point_keys.values()),
            dim=np.append(link.dim, np.full(n_points, 3)),
            group=np.append(link.group, np.full(n_points, len(mast))),
            image_unit=np.concatenate([link.image_unit, n_units + np.arange(n)]),
            segment_begin=np.concatenate([link.segment_begin, n_segments + np.cumsum(moving)]),
            segment_variable=np.append(link.segment_variable, variable),
            segment_column=np.append(link.segment_column, np.zeros(len(variable), dtype=np.int64)),
            segment_width=np.append(link.segment_width, np.where(self.point[moving] >= 0, 3, 6)),
            segment_plain=np.append(link.segment_plain, np.zeros(len(variable), dtype=bool)),
            fields=fields,
        )

    def postured(
        self,
        posture: Posture,
        values: gtsam.Values,
        masts: tuple[FloatArray, FloatArray],
        mast: Sequence[int | None],
    ) -> Posture:
        """A posture with these behind its images; `masts` are rotations and translations of all stops."""
        moving = self._moving(mast)
        chain = np.zeros((len(moving), *posture.chain.shape[1:]))
        # Turns of the mast leave the sensor as it is; shifts along its axes are turned to the world's.
        chain[:, 3:6, 3:6] = masts[0][self.stop]
        chain[self.point >= 0] = 0.0
        chain[self.point >= 0, 3:6, :3] = np.eye(3)
        views = self.behind(posture.views, values, masts[1])
        return Posture(
            views=views,
            unit_R=np.concatenate([posture.unit_R, np.tile(np.eye(3), (len(moving), 1, 1))]),
            unit_t=np.concatenate([posture.unit_t, views.world_t_camera[-len(moving) :]]),
            chain=np.concatenate([posture.chain, chain[moving]]),
        )

    def behind(self, views: CameraViews, values: gtsam.Values, mast_t: FloatArray) -> CameraViews:
        """Cameras with these behind them; `mast_t` (stops, 3) are origins of masts in the world."""
        n, n_images = len(self.stop), len(views.world_t_camera)
        centre_m = np.where((self.stop >= 0)[:, None], mast_t[self.stop], self.centre_m)
        if len(self.track):
            points = np.array([values.atPoint3(key) for key in self.point_keys.values()])
            centre_m = np.where((self.point >= 0)[:, None], points[self.point], centre_m)
        fields = views.fields
        if fields is not None:
            fields = Fields(
                coefficients_px=fields.coefficients_px,
                row=np.concatenate([fields.row, np.full(n, -1)]),
                size_px=np.concatenate([fields.size_px, np.ones((n, 2))]),
            )
        return CameraViews(
            world_R_camera=np.concatenate([views.world_R_camera, self.world_R_sensor]),
            world_t_camera=np.concatenate([views.world_t_camera, centre_m]),
            calibration=np.concatenate([views.calibration, np.tile(np.eye(3), (n, 1, 1))]),
            lenses=LensTable.joined([views.lenses or LensTable.without(n_images), self._lenses]),
            fields=fields,
        )

    @cached_property
    def _lenses(self) -> LensTable:
        return LensTable.of_sensors(self.kind, self.surface, [_table(one) for one in self.surfaces])

    def _moving(self, mast: Sequence[int | None]) -> BoolArray:
        """(sensors,) whether each moves with a variable: with a mast, or with a point."""
        free = np.array([key is not None for key in mast])
        return np.asarray(((self.stop >= 0) & free[self.stop]) | (self.point >= 0))


def _table(surface: Surface) -> FloatArray:
    """A surface as `Sensor.SURFACE` reads it (rows + 1, columns)."""
    rows, columns = surface.height_m.shape
    out = np.zeros((rows + 1, max(columns, SURFACE_HEAD)))
    out[0, :SURFACE_HEAD] = [*surface.first_m, *surface.step_m, rows, columns]
    out[1:, :columns] = surface.height_m
    return out
