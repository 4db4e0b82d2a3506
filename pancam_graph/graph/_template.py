"""Factor templates: variables and factors of a rig, made from the stops, frames and images of a traverse."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Self

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.cameras import Fields, LensTable, fields_of
from pancam_graph.data import FrameSeen, Refined, RigCorrection, Sharing, State, Traverse
from pancam_graph.elimination import Covariance, JointCovariance, Linkage, PosePlace, Posture, Root
from pancam_graph.factors import Fixed, Key, Slot, encoder_factor, joint_prior_factor
from pancam_graph.graph._factors import FactorList, Factors
from pancam_graph.graph._given import GivenFactor, Seat, seated
from pancam_graph.graph._graph_keys import GraphKeys
from pancam_graph.graph._graph_options import Model
from pancam_graph.graph._head_flex import HeadFlex
from pancam_graph.graph._keys import Kind, index_of, key_of, kind_of, read_variable
from pancam_graph.graph._let_go import LetGo
from pancam_graph.graph._rig_variables import RigVariables
from pancam_graph.graph._seen_factors import seen_by_mast
from pancam_graph.graph._sensors import Sensors
from pancam_graph.landmarks import CameraViews

__all__ = ["FactorTemplate", "diagonal_noise"]


class FactorTemplate(ABC):
    """Factors and variables of a traverse's rig for one model; landmarks are separate."""

    sensors: Sensors | None = None
    """Sensors behind the images in `linkage` and `posture`; None: there are none."""

    def __init__(self, traverse: Traverse, model: Model, sharing: Sharing | None = None) -> None:
        """`sharing` as `Sharing.for_model` returns it; None: the default of the model."""
        self.traverse = traverse
        self.model: Model = model
        self.rig_variables = RigVariables(traverse, sharing or Sharing().for_model(model))
        self.head_flex = HeadFlex(self.rig_variables.sharing.flex)
        self.let_go = LetGo.nothing(traverse)

    def letting_go(self, let_go: LetGo) -> Self:
        """The same variables, with other priors of telemetry: those of all factors made from then on."""
        other = copy(self)
        other.let_go = let_go
        return other

    @property
    def refines_landmarks(self) -> bool:
        """Whether landmarks are optimised with cameras held after every step, besides back substitution.

        Where telemetry holds no scale, steps are long for points that follow them to first order alone; and a
        tied point that follows its variable over a long step leaves it by more than they may be apart.
        """
        tied = self.sensors is not None and len(self.sensors.track) > 0
        return tied or bool(self.let_go.stops[:, 3:].any())

    @property
    @abstractmethod
    def linkage(self) -> Linkage:
        """Variables and how images depend on them; one group per stop, then one that all stops share."""

    @property
    def cliques(self) -> tuple[tuple[int, ...], ...]:
        """Sets of groups that factors of this template join."""
        shared = range(len(self.traverse.stops), self.linkage.n_groups)
        return tuple((stop, *shared) for stop in range(len(self.traverse.stops))) if shared else ()

    @abstractmethod
    def posture(self, values: gtsam.Values) -> Posture:
        """Cameras and chain rule at the values."""

    @abstractmethod
    def views(self, values: gtsam.Values) -> CameraViews:
        """Cameras of all images at the values."""

    @abstractmethod
    def telemetry_priors(self) -> FactorList:
        """Priors of masts and angles."""

    def ties(self, *, apart: bool = False) -> FactorList:
        """Factors that tie cameras to the mast, one per stop, or one per image if `apart`; none here."""
        return []

    def factors(
        self,
        given: Sequence[GivenFactor] = (),
        *,
        present: gtsam.Values | None = None,
        apart: bool = False,
    ) -> Factors:
        """All factors but those of landmarks, with the caller's own.

        `present` are values of another template, from which variables of given factors are fixed that this
        template lacks. `apart` as for `ties`: it keeps the graph sparse for elimination by GTSAM.
        """
        stops = range(len(self.traverse.stops))
        given = [self.own(one) for one in given]
        return Factors(
            telemetry=tuple(self.telemetry_priors()),
            ties=tuple(self.ties(apart=apart)),
            rig=(
                *(factor for owner in (*stops, None) for factor in self.rig_variables.prior_factors(owner)),
                *(factor for stop in stops for factor in self.flex_factors(stop)),
            ),
            given=tuple(given),
            seated=self.seated(given, present),
        )

    def seated(
        self, given: Sequence[GivenFactor], present: gtsam.Values | None = None
    ) -> tuple[gtsam.NonlinearFactor, ...]:
        """Given factors on this template's variables, but those held or let go; see `factors`."""
        given = self.believed(given)
        seats = self.seats(given, present)
        placed = (seated(one, seats) for one in given)
        return tuple(factor for factor in placed if factor is not None)

    def believed(self, given: Sequence[GivenFactor]) -> list[GivenFactor]:
        """Given factors but those that state constraints which were let go."""
        gone = self.let_go.constraints
        return [one for one in given if one.constraint is None or not gone[one.constraint]]

    def own(self, given: GivenFactor) -> GivenFactor:
        """A given factor as this template has it: what a camera sees is on its own variables."""
        one = None if given.constraint is None else self.traverse.constraints[given.constraint]
        if not isinstance(one, FrameSeen):
            return given
        return replace(given, factor=self.seen_factor(one))

    def seen_factor(self, one: FrameSeen) -> gtsam.CustomFactor:
        """What a camera sees, on keys of which the template has seats; here by the mast."""
        image = self.image_of(one)
        stop, frame = int(self.traverse.image_stop[image]), int(self.traverse.image_frame[image])
        return seen_by_mast(
            one,
            self.rig_variables,
            image,
            self.mast(stop),
            Key(key_of(Kind.ANGLES, frame)),
            self.head_flex.slot(key_of(Kind.FLEX, frame)),
            self.plain_px(one),
        )

    def image_of(self, one: FrameSeen) -> int:
        """Row of the image that something is seen in."""
        image = self.traverse.image_of(one)
        assert image is not None  # the traverse has looked
        return image

    def plain_px(self, one: FrameSeen) -> FloatArray:
        """(2,) the pixel of what is seen as it would be without the smooth field of the rig's camera."""
        image = np.array([self.image_of(one)])
        (plain_px,) = self.without_field(image, np.array([[one.u_px, one.v_px]]))
        return np.asarray(plain_px)

    @cached_property
    def keys(self) -> GraphKeys:
        """Keys as callers know them."""
        return GraphKeys(self.traverse, self.rig_variables)

    def seats(self, given: Sequence[GivenFactor], present: gtsam.Values | None = None) -> dict[int, Seat]:
        """Seats of the variables of given factors among this template's variables; see `factors`."""
        held = self.held_columns() if given else {}
        return {key: self._seat(key, held.get(key), present) for one in given for key in one.keys}

    def _seat(self, key: int, held: IntArray | None, present: gtsam.Values | None) -> Seat:
        kind = kind_of(key)
        if kind is Kind.ANGLES:
            return self.angle_seat(index_of(key))
        if kind is Kind.FLEX and self.head_flex:
            return self.flex_seat(index_of(key))
        if kind is Kind.MAST and isinstance(slot := self.mast(index_of(key)), Fixed):
            return Seat.fixed(slot.value)
        if key not in self.linkage.row:
            assert present is not None  # every key of `keys` is a variable, or held by telemetry
            return Seat.fixed(read_variable(present, key))
        return Seat.same(key, int(self.linkage.dim[self.linkage.row[key]]), held)

    @abstractmethod
    def angle_frames(self, key: int) -> IntArray:
        """Frames (frames,) whose pan and tilt the variable of a key has, in their order there."""

    @abstractmethod
    def angle_seat(self, frame: int) -> Seat:
        """Seat of a frame's pan and tilt among the variables."""

    def flex_seat(self, frame: int) -> Seat:
        """Seat of a frame's flex among the variables, where heads flex."""
        raise NotImplementedError  # no head flexes in the other models

    @property
    @abstractmethod
    def has_cameras(self) -> bool:
        """Whether each image has a variable for its camera, tied to the mast."""

    @abstractmethod
    def values(self, state: State) -> gtsam.Values:
        """The variables at a state."""

    @abstractmethod
    def state(self, values: gtsam.Values, landmarks_m: FloatArray, views: CameraViews | None = None) -> State:
        """The state at values of the variables; inverse of `values`. `views`: cameras there, if known."""

    @abstractmethod
    def held_columns(self) -> dict[int, IntArray]:
        """By key, tangent components that telemetry holds while others of the same variable are free."""

    @cached_property
    def held_by_group(self) -> dict[int, IntArray]:
        """By group, the columns that telemetry holds."""
        return self.linkage.by_group(self.held_columns().items())

    @abstractmethod
    def angle_rows(self, frame: int, state: State) -> tuple[IntArray, FloatArray]:
        """Jacobian of a frame's pan and tilt by its stop: columns (k,) of the group, rows (2, k).

        No columns where both are held.
        """

    def angle_sigma_rad(self, covariance: Covariance, state: State) -> FloatArray:
        """Standard deviation of pan and tilt (frames, 2); 0 where held."""
        rows = [self.angle_rows(frame, state) for frame in range(len(self.traverse.frames))]
        return _sigmas(covariance, self.traverse.frame_stop, rows)

    def relative_angle_sigma_rad(self, covariance: Covariance, state: State, pairs: IntArray) -> FloatArray:
        """Standard deviation (pairs, 2) of the difference in pan and tilt of pairs of frames of one stop.

        `pairs` (pairs, 2) are rows of frames.
        """
        rows = []
        for i, j in pairs:
            (columns_i, rows_i), (columns_j, rows_j) = (self.angle_rows(int(f), state) for f in (i, j))
            rows.append((np.concatenate([columns_i, columns_j]), np.hstack([-rows_i, rows_j])))
        return _sigmas(covariance, self.traverse.frame_stop[pairs[:, 0]], rows)

    def mast(self, stop: int) -> Slot:
        """Slot of a stop's mast pose: fixed where both its sigmas are 0."""
        return self._masts[stop]

    @cached_property
    def _masts(self) -> tuple[Slot, ...]:
        return tuple(
            Fixed(stop.world_T_mast)
            if stop.sigma_rotation_rad == 0 and stop.sigma_translation_m == 0
            else Key(key_of(Kind.MAST, i))
            for i, stop in enumerate(self.traverse.stops)
        )

    def masts(self, values: gtsam.Values) -> tuple[gtsam.Pose3, ...]:
        """Mast poses of all stops at the values."""
        return tuple(
            values.atPose3(slot.key) if isinstance(slot, Key) else slot.value for slot in self._masts
        )

    def correction(self, values: gtsam.Values) -> RigCorrection | None:
        """Corrections of the traverse's rig at the values; None where nothing of it is free."""
        found = self.rig_variables.correction(values)
        return self.head_flex.with_flex(found, self.flexes(values), self.traverse)

    def flexes(self, values: gtsam.Values) -> FloatArray | None:
        """Corrections (frames, 6) of the heads, in their own frames; None where the mast is rigid."""
        return None

    def rig_sigmas(self, covariance: Covariance, values: gtsam.Values) -> list[FloatArray]:
        """Standard deviations of the free entries of the rig, as `refined` takes them."""
        return self.rig_variables.sigmas(covariance, self.linkage)

    def refined(self, values: gtsam.Values, sigmas: list[FloatArray] | None) -> tuple[Refined, ...]:
        """Estimates of every free entry of the rig; sigmas are NaN where None is given."""
        return self.rig_variables.refined(values, sigmas)

    def stop_factors(self, stop: int) -> FactorList:
        """The prior of a stop's mast pose."""
        entry, slot = self.traverse.stops[stop], self.mast(stop)
        if not isinstance(slot, Key):
            return []
        sigmas = self.let_go.widened(entry.sigmas, self.let_go.stops[stop])
        return [gtsam.PriorFactorPose3(slot.key, entry.world_T_mast, diagonal_noise(sigmas))]

    def angle_noise(self, stop: int, frames: IntArray) -> gtsam.noiseModel.Base:
        """Noise of the pan and tilt of some frames of a stop, one after the other."""
        stated = self.angle_sigmas_rad[frames]
        extra = self.let_go.angles_rad[frames]
        covariance = self.let_go.angle_covariance(stop, stated, extra)
        if covariance is None:
            return diagonal_noise(self.let_go.widened(stated, extra).ravel())
        return gtsam.noiseModel.Gaussian.Covariance(covariance)

    def angle_prior(
        self,
        frames: IntArray,
        noise: gtsam.noiseModel.Base,
        angles: Sequence[int],
        encoders: Slot | None = None,
    ) -> gtsam.NonlinearFactor:
        """What telemetry reads of the pan and tilt of frames, which variables have one after the other.

        `encoders` is the slot of the scale of readings, where it is free; default: this template's variable.
        """
        reading = self.traverse.pan_tilt_rad[frames].ravel()
        if not self.rig_variables.of["encoders"]:
            if len(angles) == 1:
                return gtsam.PriorFactorVector(angles[0], reading, noise)
            return joint_prior_factor(noise, [Key(key) for key in angles], reading)
        (scale,) = self.rig_variables.of["encoders"]
        joint = np.tile(np.arange(2), len(frames))
        moved = np.where(self.angle_sigmas_rad[frames].ravel() > 0, reading, 0.0)  # a held angle is exact
        by_joint = moved[:, None] * np.eye(2)[joint]
        return encoder_factor(
            noise,
            encoders or Key(scale.key),
            [Key(key) for key in angles],
            reading=reading,
            by_scale=by_joint @ self.rig_variables.basis("encoders")[0],
        )

    def flex_factors(self, stop: int) -> FactorList:
        """The prior of how a stop's heads stand off the rigid mast; none here."""
        return []

    @cached_property
    def angle_sigmas_rad(self) -> FloatArray:
        """(frames, 2) sigmas of the priors of pan and tilt, widened where heads flex; 0 where held."""
        return self.head_flex.widened(self.traverse.pan_tilt_sigmas_rad)

    def held_of_stops(self) -> dict[int, IntArray]:
        """`held_columns` of the masts."""
        slots = [(self.mast(i), stop) for i, stop in enumerate(self.traverse.stops)]
        return {s.key: np.flatnonzero(stop.sigmas == 0) for s, stop in slots if isinstance(s, Key)}

    def stop_covariance(self, covariance: Covariance) -> FloatArray:
        """Covariance of each mast pose (stops, 6, 6), rotation first, body frame; 0 where held."""
        out = np.zeros((len(self.traverse.stops), 6, 6))
        for i in range(len(out)):
            if isinstance(slot := self.mast(i), Key):
                rows = self.linkage.columns_of(slot.key)
                out[i] = covariance.block(i, i)[rows, rows]
        return out

    def mast_covariance(self, root: Root) -> JointCovariance:
        """Joint covariances of mast poses, from the square root of this template's whole system."""
        held = self.held_of_stops()
        places: list[PosePlace | None] = []
        for i in range(len(self.traverse.stops)):
            slot = self.mast(i)
            place = None
            if isinstance(slot, Key):
                columns = self.linkage.columns_of(slot.key)
                place = PosePlace(group=i, columns=columns, held=held[slot.key])
            places.append(place)
        return JointCovariance(root=root, places=tuple(places))

    def views_of(
        self, world_R_camera: FloatArray, world_t_camera: FloatArray, values: gtsam.Values
    ) -> CameraViews:
        """Cameras of all images from their poses (images, 3, 3), (images, 3) and the values' calibrations."""
        return CameraViews(
            world_R_camera=world_R_camera,
            world_t_camera=world_t_camera,
            calibration=self.rig_variables.calibration(values),
            lenses=self.lenses,
            fields=self.fields,
        )

    @cached_property
    def fields(self) -> Fields | None:
        """The smooth fields of all images' cameras as the rig has them; None where it has none."""
        t = self.traverse
        return fields_of([eye.camera for eye in t.rig.eyes], t.image_eye)

    def without_field(self, image: IntArray, uv_px: FloatArray) -> FloatArray:
        """Where pixels (n, 2) of images (n,) would be if the rig's cameras had no smooth fields."""
        return uv_px if self.fields is None else uv_px - self.fields.at(image, uv_px)

    @cached_property
    def lenses(self) -> LensTable:
        """The distortions of all images' cameras."""
        t = self.traverse
        return LensTable.of([eye.camera for eye in t.rig.eyes], t.image_eye)


def _sigmas(
    covariance: Covariance, stop: IntArray, rows: Sequence[tuple[IntArray, FloatArray]]
) -> FloatArray:
    """Standard deviations (n, 2) propagated by rows (2, k) from columns (k,) of the groups of stops (n,)."""
    sigma = np.zeros((len(rows), 2))
    for i, (columns, jacobian) in enumerate(rows):
        if len(columns):
            block = covariance.block(int(stop[i]), int(stop[i]))[np.ix_(columns, columns)]
            sigma[i] = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, block, jacobian).clip(0.0))
    return sigma


def diagonal_noise(sigmas: FloatArray) -> gtsam.noiseModel.Base:
    """Diagonal noise; entries of 0 are held exactly (1e3 is GTSAM's own weight of a violation)."""
    if np.all(sigmas > 0):
        return gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    return gtsam.noiseModel.Constrained.MixedSigmas(np.full(len(sigmas), 1e3), sigmas)
