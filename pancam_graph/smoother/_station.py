"""One stop as a factor template, and several stops joined into the linkage of a landmark system."""

from collections.abc import Collection, Iterable
from functools import cached_property

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import Sharing, State, Traverse
from pancam_graph.elimination import Linkage, Posture
from pancam_graph.factors import Fixed, Key
from pancam_graph.graph import HardTemplate, Kind, diagonal_noise, index_of, key_of, kind_of, read_variable
from pancam_graph.landmarks import CameraViews

__all__ = ["Patch", "Postures", "Station", "copied"]


class Station:
    """A stop, its frames and images; its variables under the keys that they have in the whole drive."""

    def __init__(self, number: int, traverse: Traverse, sharing: Sharing, first_image: int) -> None:
        """`traverse` has this one stop; `number` counts stops, `first_image` the images before, as added."""
        self.number, self.traverse, self.first_image = number, traverse, first_image
        self.template = HardTemplate(traverse, sharing)
        self.link = self.template.linkage
        self.global_key = self._global_keys()
        """Key in the whole drive of each of the template's keys; entries of the rig that stops share have one
        key."""
        slot = self.template.mast(0)
        self.mast = self.global_key[slot.key] if isinstance(slot, Key) else None
        """Key of the mast pose; None where it is held."""
        self.angles = key_of(Kind.ANGLES, number)
        """Key of its angles, if any is free."""
        self.after = -1
        """Number of the station from which odometry led here; -1: from none."""
        self.motion: gtsam.NonlinearFactor | None = None
        """Factor of odometry from another station, in place of the prior on the mast pose."""
        self.own_keys = tuple(
            self.global_key[k] for k, g in zip(self.link.key, self.link.group, strict=True) if g == 0
        )
        """Keys of the variables of this stop alone."""
        self.shared_keys = tuple(k for k, g in zip(self.link.key, self.link.group, strict=True) if g == 1)
        """Keys of the variables that stops share."""

    def _global_keys(self) -> dict[int, int]:
        """Key of each variable in a template of the whole drive, by its key in this stop's template."""
        out = {key: key_of(kind_of(key), self.number) for key in self.link.key}
        for v in self.template.rig_variables.variables:
            index = index_of(v.key)
            if v.image is not None:
                index += self.first_image
            elif v.stop is not None:
                index += (
                    self.number if v.quantity == "pan_T_tilt" else self.number * len(self.traverse.rig.eyes)
                )
            out[v.key] = key_of(kind_of(v.key), index)
        return out

    @property
    def id(self) -> str:
        """Id of the stop."""
        return self.traverse.stops[0].id

    @property
    def held_of_mast(self) -> IntArray:
        """Components of its pose's tangent that telemetry holds while others are free."""
        slot = self.template.mast(0)
        return (
            self.template.held_of_stops()[slot.key] if isinstance(slot, Key) else np.zeros(0, dtype=np.int64)
        )

    def local(self, values: gtsam.Values) -> gtsam.Values:
        """Values of the template's variables, from those of the whole drive."""
        out = gtsam.Values()
        for key, name in self.global_key.items():
            out.insert(key, read_variable(values, name))
        return out

    def start(self, world_T_mast: gtsam.Pose3, pan_tilt_rad: FloatArray | None = None) -> gtsam.Values:
        """Initial values of its variables: the mast at a pose, angles (frames, 2), the rig uncorrected.

        Without angles they are telemetry's.
        """
        t = self.traverse
        pan_tilt_rad = t.pan_tilt_rad if pan_tilt_rad is None else pan_tilt_rad
        rotation, centre = t.camera_poses([world_T_mast], pan_tilt_rad)
        state = State(
            world_T_mast=(world_T_mast,),
            pan_tilt_rad=pan_tilt_rad,
            world_R_camera=rotation,
            world_t_camera=centre,
            landmarks_m=np.zeros((0, 3)),
        )
        local, out = self.template.values(state), gtsam.Values()
        for key, name in self.global_key.items():
            out.insert(name, read_variable(local, key))
        return out

    def world_T_mast(self, values: gtsam.Values) -> gtsam.Pose3:
        """Mast pose at values of the whole drive."""
        return self.traverse.stops[0].world_T_mast if self.mast is None else values.atPose3(self.mast)

    def pan_tilt_rad(self, values: gtsam.Values) -> FloatArray:
        """Angles (frames, 2) at values of the whole drive."""
        local = self.local(values)
        return self.template.state(local, np.zeros((0, 3))).pan_tilt_rad

    def factors(self, *, firm: bool, at: gtsam.Values | None = None) -> list[gtsam.NonlinearFactor]:
        """Priors of its own variables; odometry, if any, takes the place of the mast's prior.

        `firm`: components that telemetry holds (sigma 0) are constraints of the prior. Else their sigma in
        the prior is 1, for callers who hold these components themselves. `at`: values of the whole drive at
        which a scale of readings, which stops share, is held; None: it is a variable.
        """
        t, out = self.traverse, list[gtsam.NonlinearFactor]()

        if self.motion is not None:
            out.append(self.motion)
        elif self.mast is not None:
            stop = t.stops[0]
            out.append(gtsam.PriorFactorPose3(self.mast, stop.world_T_mast, _noise(stop.sigmas, firm=firm)))
        return out + self.other_priors(firm=firm, at=at)

    def other_priors(self, *, firm: bool, at: gtsam.Values | None = None) -> list[gtsam.NonlinearFactor]:
        """The priors of `factors` that are not on the mast."""
        out = list[gtsam.NonlinearFactor]()
        sigmas = self.template.angle_sigmas_rad
        free = sigmas.any(axis=1)
        if free.any():
            noise = _noise(sigmas[free].ravel(), firm=firm)
            scales = [self.global_key[v.key] for v in self.template.rig_variables.of["encoders"]]
            slots = [Key(key) if at is None else Fixed(at.atVector(key)) for key in scales]
            frames = np.flatnonzero(free)
            out.append(self.template.angle_prior(frames, noise, [self.angles], *slots))
        for factor in self.template.flex_factors(0):
            out.append(factor.rekey([self.global_key[key] for key in factor.keys()]))  # noqa: SIM118  a gtsam factor
        return out + self._rig_priors(0)

    def shared_priors(
        self, keys: Collection[int], known: Collection[int] = ()
    ) -> list[gtsam.NonlinearFactor]:
        """Priors of those entries of the rig that stops share and whose keys are given.

        `known` are the keys that the drive has without this station: with a covariance of the rig, the priors
        are those given these.
        """
        rig = self.template.rig_variables
        if rig.sharing.covariance is not None:
            # A key of the rig's shared entries is the same in the template of a stop and of the drive.
            return rig.joint_priors(sorted(keys), sorted(known))
        return self._rig_priors(None, keys)

    def _rig_priors(
        self, owner: int | None, keys: Collection[int] | None = None
    ) -> list[gtsam.NonlinearFactor]:
        return [
            gtsam.PriorFactorVector(
                self.global_key[v.key], np.zeros(len(v.sigma)), gtsam.noiseModel.Diagonal.Sigmas(v.sigma)
            )
            for v in self.template.rig_variables.of_stop(owner)
            if np.isfinite(v.sigma).any() and (keys is None or self.global_key[v.key] in keys)
        ]


class Postures:
    """Postures of stations at some values, each computed once."""

    def __init__(self, values: gtsam.Values) -> None:
        self.values = values
        self._of: dict[int, Posture] = {}

    def of(self, station: Station) -> Posture:
        """The posture of one station."""
        posture = self._of.get(station.number)
        if posture is None:
            posture = self._of[station.number] = station.template.posture(station.local(self.values))
        return posture

    def of_all(self, stations: Iterable[Station]) -> list[Posture]:
        """The postures of stations. To be called before threads read any of them."""
        return [self.of(station) for station in stations]

    def moved(self, station: Station, station_values: gtsam.Values) -> "Postures":
        """The same with other values of one station's own variables."""
        values = gtsam.Values(self.values)
        values.update(station_values)
        twin = Postures(values)
        twin._of = {number: posture for number, posture in self._of.items() if number != station.number}
        return twin


class Patch:
    """Several stations as one structure of images, units and variables, in the order in which they are given.

    With `free`, only the variables of that station move; the other stations contribute fixed images.
    """

    def __init__(self, stations: Iterable[Station], free: Station | None = None) -> None:
        """`free` is the only station whose own variables move; None: all variables move."""
        self.stations = tuple(stations)
        # Mask of the segments of each station whose variables move.
        self._segments = [
            np.ones(len(s.link.segment_variable), dtype=bool)
            if free is None
            else (s is free) & (s.link.group[s.link.segment_variable] == 0)
            for s in self.stations
        ]
        self._movable = self.stations if free is None else (free,)
        self._shared = (
            tuple(sorted({key for s in self.stations for key in s.shared_keys})) if free is None else ()
        )
        self.place = {s.number: i for i, s in enumerate(self.stations)}
        counts = [len(s.traverse.images) for s in self.stations]
        self.image_begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        """(stations + 1,) first image of each"""

    @cached_property
    def linkage(self) -> Linkage:
        """One group per free station, then one group of the variables that stations share."""
        dim_of = {
            s.global_key[k]: int(d)
            for s in self.stations
            for k, d in zip(s.link.key, s.link.dim, strict=True)
        }
        keys = [*(key for s in self._movable for key in s.own_keys), *self._shared]
        row = {key: i for i, key in enumerate(keys)}
        # A station without variables has no group, so that groups are numbered without gaps.
        owners = [s for s in self._movable if s.own_keys]
        group = [g for g, s in enumerate(owners) for _ in s.own_keys] + [len(owners)] * len(self._shared)
        units, counts, variables, columns, widths, plain = [], [], [], [], [], []
        n_units = 0
        for station, taken in zip(self.stations, self._segments, strict=True):
            link = station.link
            units.append(n_units + link.image_unit)
            n_units += len(link.segment_begin) - 1
            within = np.concatenate([[0], np.cumsum(taken)])[link.segment_begin]
            counts.append(np.diff(within))
            to_row = np.array([row.get(station.global_key[k], -1) for k in link.key], dtype=np.int64)
            variables.append(to_row[link.segment_variable[taken]])
            columns.append(link.segment_column[taken])
            widths.append(link.segment_width[taken])
            plain.append(link.segment_plain[taken])
        return Linkage(
            key=tuple(keys),
            dim=np.array([dim_of[k] for k in keys], dtype=np.int64),
            group=np.array(group, dtype=np.int64),
            image_unit=np.concatenate(units),
            segment_begin=np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64),
            segment_variable=np.concatenate(variables),
            segment_column=np.concatenate(columns),
            segment_width=np.concatenate(widths),
            segment_plain=np.concatenate(plain),
        )

    def posture(self, postures: Postures) -> Posture:
        """Cameras of all images of the patch, and the chain rule from variables to them."""
        of = postures.of_all(self.stations)
        chains = [p.chain[taken] for p, taken in zip(of, self._segments, strict=True)]
        return Posture(
            views=CameraViews.joined([p.views for p in of]),
            unit_R=np.concatenate([p.unit_R for p in of]),
            unit_t=np.concatenate([p.unit_t for p in of]),
            chain=np.concatenate(chains),
        )

    def views(self, postures: Postures) -> CameraViews:
        """Cameras of all images of the patch."""
        return self.posture(postures).views

    def held_columns(self) -> dict[int, IntArray]:
        """By group, the columns that telemetry holds."""
        return self.linkage.by_group(
            (station.global_key[key], components)
            for station in self.stations
            for key, components in station.template.held_columns().items()
            if station.global_key[key] in self.linkage.row
        )

    def image(self, image: IntArray, station: IntArray) -> IntArray:
        """Rows among the patch's images of images (n,) of the whole drive, given their stations (n,)."""
        shift = np.zeros(max(self.place) + 1, dtype=np.int64)
        for number, i in self.place.items():
            shift[number] = self.image_begin[i] - self.stations[i].first_image
        return image + shift[station]


def _noise(sigmas: FloatArray, *, firm: bool) -> gtsam.noiseModel.Base:
    return diagonal_noise(sigmas if firm else np.where(sigmas > 0, sigmas, 1.0))


def copied(values: gtsam.Values, keys: Iterable[int], into: gtsam.Values | None = None) -> gtsam.Values:
    """Copy the values of some keys, into other values if given."""
    out = gtsam.Values() if into is None else into
    for key in keys:
        out.insert(key, read_variable(values, key))
    return out
