"""The free entries of a rig as variables: one vector for each owner (thesis 4.3, 5.4).

Variables: `K` calibration, `E` mount (`head_T_camera`), `T` tilt axis (`pan_T_tilt`), `S` scale of pan and
tilt: vectors of corrections to the values of the rig, with free entries alone; `R` radius of a circle
(double).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
import scipy

from pancam_graph.base.geometry import (
    FloatArray,
    IntArray,
    block_diagonal,
    corrected_poses,
    correction_twists,
    pose_arrays,
)
from pancam_graph.cameras import (
    CALIBRATION_ENTRIES,
    FIELD_COEFFICIENTS,
    FIELD_PER_COEFFICIENT,
    field_covariance,
)
from pancam_graph.data import (
    ENTRIES,
    Freedom,
    Quantity,
    Refined,
    RigCorrection,
    Sharing,
    Traverse,
    default_sigma,
)
from pancam_graph.elimination import Covariance, Linkage
from pancam_graph.factors import Corrected, Fixed, Key, PoseSlot, Slot, conditional_prior_factor
from pancam_graph.graph._keys import Kind, index_of, key_of, kind_of
from pancam_graph.rigs import ASPECT, FOCAL, RIG_ENTRIES, RigCovariance, RigEntry

__all__ = ["RigVariable", "RigVariables"]

_KIND: Mapping[Quantity, Kind] = {
    "calibration": Kind.CALIBRATION,
    "mounts": Kind.MOUNT,
    "pan_T_tilt": Kind.TILT_AXIS,
    "radius": Kind.RADIUS,
    "encoders": Kind.ENCODERS,
}
_OF_STOPS: frozenset[Quantity] = frozenset({"pan_T_tilt", "encoders"})
"""Quantities that belong to no eye: a stop, not an image, is a site of theirs."""
_FACTORS = {FOCAL, ASPECT, *ENTRIES["encoders"]}
"""Entries whose value in the rig is 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RigVariable:
    """A variable: free entries of a correction, and their owner; eye, stop or image is None for all."""

    quantity: Quantity
    key: int
    entries: tuple[str, ...]
    """Names of the free entries, with units."""
    sigma: FloatArray
    """(entries,) of the prior; infinite: no prior"""
    usual: FloatArray
    """(entries,) default of `sigma`: the typical deviation of real rigs"""
    eye: int | None
    stop: int | None
    image: int | None
    first: int
    """Row of the first image (of pan_T_tilt and encoders: stop) that has it"""
    nominal: tuple[float | None, ...]
    """(entries,) values of the rig; None where these differ among the images that share the variable"""


class RigVariables:
    """The free entries of a traverse's rig as variables, and the cameras at their values.

    Corrections of calibration, mounts and radius are per image, those of pan_T_tilt and encoders per stop.
    """

    def __init__(self, traverse: Traverse, sharing: Sharing) -> None:
        """`sharing` as `Sharing.for_model` returns it."""
        t = self.traverse = traverse
        self.sharing = sharing
        self._K = t.calibration
        self._focals_px = [float(p.calibration_matrix[0, 0]) for p in t.rig.pinholes]
        mounts_R, mounts_t = pose_arrays([e.head_T_camera for e in t.rig.eyes])
        self._mounts = mounts_R[t.image_eye], mounts_t[t.image_eye]
        self._place: dict[Quantity, IntArray] = {}
        self._basis: dict[Quantity, FloatArray] = {}
        self.of: dict[Quantity, tuple[RigVariable, ...]] = {}
        """Variables of each quantity"""
        for quantity in _KIND:
            freedom: Freedom | None = getattr(sharing, quantity)
            self.of[quantity] = self._variables(quantity, freedom or Freedom())

    # --- structure ---

    def _variables(self, quantity: Quantity, freedom: Freedom) -> tuple[RigVariable, ...]:
        entries, scope, t = freedom.entries(quantity), freedom.scope, self.traverse
        if not entries:
            return ()
        no_eye = quantity in _OF_STOPS
        eye, stop = (None, np.arange(len(t.stops))) if no_eye else (t.image_eye, t.image_stop)
        n_sites = len(stop)
        owner = np.zeros(n_sites, dtype=np.int64)
        if scope == "image":
            owner = np.arange(n_sites)
        elif scope == "stop":
            owner = stop if eye is None else stop * len(t.rig.eyes) + eye
        elif scope == "eye" and eye is not None:
            owner = eye
        numbers, firsts, place = np.unique(owner, return_index=True, return_inverse=True)
        self._place[quantity] = place.astype(np.int64)
        self._basis[quantity] = self._basis_of(quantity, entries, n_sites)
        nominal = self._nominal(quantity, entries, n_sites)
        out = []
        for i, (number, first) in enumerate(zip(numbers, firsts, strict=True)):
            is_same = (nominal[place == i] == nominal[first]).all(axis=0)
            eye_of_all = None if no_eye or scope == "all" else int(t.image_eye[first])
            focal = 1.0 if no_eye else self._focal_px(eye_of_all)
            key = key_of(_KIND[quantity], int(number))
            sigma = np.array([self._own_sigma(quantity, e, eye_of_all) for e in entries])
            if self.sharing.covariance is not None:
                sigma = np.sqrt(np.diag(self.sharing.covariance.among(self._entries_of(key), sigma)))
            out.append(
                RigVariable(
                    quantity=quantity,
                    key=key,
                    entries=entries,
                    sigma=sigma,
                    usual=np.array([default_sigma(e, focal) for e in entries]),
                    eye=None if eye is None or scope == "all" else int(eye[first]),
                    stop=int(stop[first]) if scope in {"stop", "image"} else None,
                    image=int(first) if scope == "image" else None,
                    first=int(first),
                    nominal=tuple(
                        one if same else None
                        for same, one in zip(is_same.tolist(), nominal[first].tolist(), strict=True)
                    ),
                )
            )
        return tuple(out)

    def _focal_px(self, eye: int | None) -> float:
        """Focal length that scales default priors: the eye's, or the mean of all eyes of the rig.

        It does not depend on which images a traverse has, so that a drive has the same priors at every stop.
        """
        return float(np.mean(self._focals_px)) if eye is None else self._focals_px[eye]

    def _basis_of(self, quantity: Quantity, free: tuple[str, ...], n_sites: int) -> FloatArray:
        """(sites, entries, columns) takes free entries to all entries of the correction."""
        one = np.array([[float(name == column) for column in free] for name in ENTRIES[quantity]])
        out: FloatArray = np.broadcast_to(one, (n_sites, *one.shape)).copy()
        if FOCAL in free:
            # A factor 1 + f on both focal lengths changes each by f times its value in the rig.
            out[:, :2, free.index(FOCAL)] = self._K[:, [0, 1], [0, 1]]
        if ASPECT in free:
            out[:, 1, free.index(ASPECT)] = self._K[:, 1, 1]
        return out

    def _nominal(self, quantity: Quantity, free: tuple[str, ...], n_sites: int) -> FloatArray:
        """(sites, columns) values of the rig of the free entries; 0 for an entry that is a correction."""
        out: FloatArray = np.zeros((n_sites, len(free)))
        for j, entry in enumerate(free):
            if entry in _FACTORS:
                out[:, j] = 1.0
            elif quantity == "calibration":
                row, column = (at[ENTRIES[quantity].index(entry)] for at in CALIBRATION_ENTRIES)
                out[:, j] = self._K[:, row, column]
            elif quantity == "radius":
                out[:, j] = self._radius_m[self.traverse.image_eye]
        return out

    @cached_property
    def _radius_m(self) -> FloatArray:
        """(eyes,) the rig's radius of each eye's circle at the mean measured tilt."""
        tilt = float(np.mean(self.traverse.pan_tilt_rad[:, 1]))
        return np.array([self.traverse.rig.circle(e, tilt)[0] for e in range(len(self.traverse.rig.eyes))])

    @cached_property
    def variables(self) -> tuple[RigVariable, ...]:
        """All variables, by quantity."""
        return tuple(v for variables in self.of.values() for v in variables)

    def of_stop(self, stop: int | None) -> list[RigVariable]:
        """Variables of one stop alone; None: variables that stops share."""
        return [v for v in self.variables if v.stop == stop]

    @cached_property
    def numbers(self) -> list[RigVariable]:
        """The variables that stops share and that are numbers of a rig (`rigs.RIG_ENTRIES`)."""
        return [v for v in self.of_stop(None) if v.quantity in RIG_ENTRIES]

    @cached_property
    def keys(self) -> list[int]:
        """Keys of `numbers`."""
        return [v.key for v in self.numbers]

    @cached_property
    def field_keys(self) -> list[int]:
        """Keys of the fields of all eyes; empty where fields are held."""
        is_free = bool(self.sharing.field.entries("field"))
        return [key_of(Kind.FIELD, i) for i in range(len(self.traverse.rig.eyes))] if is_free else []

    def group(self, variable: RigVariable) -> int:
        """Group in which a variable is eliminated: its stop's, or the last one."""
        return len(self.traverse.stops) if variable.stop is None else variable.stop

    def variable(self, quantity: Quantity, site: int) -> RigVariable | None:
        """The variable of an image (of pan_T_tilt: a stop); None where the quantity is fixed."""
        return self.of[quantity][int(self._place[quantity][site])] if self.of[quantity] else None

    def place(self, quantity: Quantity) -> IntArray:
        """(images,), of what has no eye (stops,): place of each one's variable among `of[quantity]`."""
        return self._place[quantity]

    def basis(self, quantity: Quantity) -> FloatArray:
        """(images, entries, columns), of pan_T_tilt (stops, ...): free entries to all of the correction."""
        return self._basis[quantity]

    def owner(self, variable: RigVariable) -> str:
        """Owner of a variable in words: " of left at s1"; empty where all images share it."""
        where = self._where(variable)
        return f" of {' '.join(where)}".replace(" of at ", " at ") if where else ""

    def name(self, variable: RigVariable, entry: str) -> str:
        """Name of an entry for warnings."""
        return " ".join([variable.quantity, *self._where(variable), entry])

    def _where(self, variable: RigVariable) -> list[str]:
        t = self.traverse
        where = [] if variable.eye is None else [t.rig.eyes[variable.eye].name]
        if variable.image is not None:
            where = [t.images[variable.image].id]
        elif variable.stop is not None:
            where.append(f"at {t.stops[variable.stop].id}")
        return where

    # --- values ---

    def _read(self, quantity: Quantity, values: gtsam.Values) -> FloatArray:
        """Corrections (images, entries), of pan_T_tilt (stops, entries); 0 for held entries."""
        variables = self.of[quantity]
        if not variables:
            sites = self.traverse.stops if quantity in _OF_STOPS else self.traverse.images
            return np.zeros((len(sites), len(ENTRIES[quantity])))
        if quantity == "radius":
            corrections = np.array([[values.atDouble(v.key) - self.reference_radius_m(v)] for v in variables])
        else:
            corrections = np.array([values.atVector(v.key) for v in variables])
        return np.asarray(np.einsum("nij,nj->ni", self._basis[quantity], corrections[self._place[quantity]]))

    def correction(self, values: gtsam.Values) -> RigCorrection | None:
        """All corrections; None where nothing is free."""
        if not self.variables:
            return None
        return RigCorrection(
            calibration_px=self._read("calibration", values),
            mount=self._read("mounts", values),
            pan_T_tilt=self._read("pan_T_tilt", values),
            radius_m=self._read("radius", values)[:, 0],
            encoders=self._read("encoders", values) if self.of["encoders"] else None,
        )

    def insert(self, values: gtsam.Values, given: RigCorrection | None) -> None:
        """Add the variables to `values`, as near to a correction as their free entries allow."""
        for v in self.variables:
            entries = np.zeros(len(v.entries))
            if given is not None:
                entries = np.linalg.pinv(self._basis[v.quantity][v.first]) @ _of(given, v.quantity)[v.first]
            if v.quantity == "radius":
                values.insert(v.key, self.reference_radius_m(v) + float(entries[0]))
            else:
                values.insert(v.key, entries)

    def prior_factors(self, stop: int | None) -> list[gtsam.NonlinearFactor]:
        """Priors of `of_stop`; with what all stops share also those of fields."""
        out: list[gtsam.NonlinearFactor] = []
        joint: list[int] = []
        if stop is None and self.sharing.covariance is not None:
            joint = [*self.keys, *self.field_keys]
        elif stop is None:
            for eye, key in enumerate(self.field_keys):
                noise = gtsam.noiseModel.Gaussian.Covariance(self._field_covariance(eye))
                out.append(gtsam.PriorFactorVector(key, np.zeros(FIELD_COEFFICIENTS), noise))
        out += self.joint_priors(joint, ())
        for v in self.of_stop(stop):
            if v.key in joint or not np.isfinite(v.sigma).any():
                continue
            noise = gtsam.noiseModel.Diagonal.Sigmas(v.sigma)  # an infinite one weighs its row with 0
            if v.quantity == "radius":
                out.append(gtsam.PriorFactorDouble(v.key, self.reference_radius_m(v), noise))
            else:
                out.append(gtsam.PriorFactorVector(v.key, np.zeros(len(v.sigma)), noise))
        return out

    # --- priors whose errors hang together ---

    def _entries_of(self, key: int) -> list[RigEntry]:
        """The numbers of the rig that a variable of an eye, or of the tilt axis, corrects."""
        if kind_of(key) is Kind.FIELD:
            eye = self.traverse.rig.eyes[index_of(key)]
            return [RigEntry("field", eye.name, entry) for entry in RIG_ENTRIES["field"]]
        quantity = next(q for q, kind in _KIND.items() if kind is kind_of(key))
        camera = None if quantity in _OF_STOPS else self.traverse.rig.eyes[index_of(key)].name
        freedom: Freedom = getattr(self.sharing, quantity)
        return [RigEntry(quantity, camera, entry) for entry in freedom.entries(quantity)]

    def _joint(self, keys: Sequence[int]) -> FloatArray:
        """Covariance (n, n) of the priors of variables that stops share, also of eyes that no image has."""
        prior = self.sharing.covariance or RigCovariance(entries=(), matrix=np.zeros((0, 0)))
        entries = [entry for key in keys for entry in self._entries_of(key)]
        rig = self.traverse.rig
        eyes = [None if e.camera is None else rig.eye_index(e.camera) for e in entries]
        sigma = [self._own_sigma(e.quantity, e.entry, eye) for e, eye in zip(entries, eyes, strict=True)]
        matrix, named = prior.among(entries, np.array(sigma)), set(prior.entries)
        place = 0
        for key in keys:
            own = self._entries_of(key)
            if kind_of(key) is Kind.FIELD and named.isdisjoint(own):
                columns = slice(place, place + len(own))
                matrix[columns, columns] = self._field_covariance(index_of(key))
            place += len(own)
        return matrix

    def _field_covariance(self, eye: int) -> FloatArray:
        """Covariance of the prior of an eye's field of which the rig's covariance says nothing."""
        return field_covariance(self.sharing.field.sigma_of("field_px", self._focal_px(eye)))

    def _own_sigma(self, quantity: str, entry: str, eye: int | None) -> float:
        """Sigma of the prior of an entry by itself, whatever the covariance says."""
        freedom: Freedom = getattr(self.sharing, quantity)
        focal = 1.0 if quantity in _OF_STOPS else self._focal_px(eye)
        if quantity == "field":  # any coefficient, where the freedom says how large a field is at a pixel
            return freedom.sigma_of("field_px", focal) / FIELD_PER_COEFFICIENT
        return freedom.sigma_of(entry, focal)

    def joint_priors(self, new: Sequence[int], known: Sequence[int]) -> list[gtsam.NonlinearFactor]:
        """The prior of the variables `new` given those `known`; both are keys of variables that stops share.

        The product of such factors, each with what came before it as known, is the joint prior.
        """
        if not new:
            return []
        keys = [*known, *new]
        covariance = self._joint(keys)
        size = np.sqrt(np.diag(covariance))
        root = scipy.linalg.cholesky(covariance / np.outer(size, size), lower=True)
        # The rows of a lower triangular square root of the information are conditional on what stands before.
        rows = scipy.linalg.solve_triangular(root, np.diag(1 / size), lower=True)
        first = len(covariance) - sum(len(self._entries_of(key)) for key in new)
        return [conditional_prior_factor(rows[first:], [Key(key) for key in keys])]

    def field_sigmas(self, changes_px: FloatArray) -> FloatArray:
        """Size of changes (eyes, ...) of fields' coefficients: RMS (eyes,) in sigmas of their priors."""
        out = []
        for key, change_px in zip(self.field_keys, changes_px.reshape(len(changes_px), -1), strict=True):
            whitened = np.linalg.solve(np.linalg.cholesky(self._joint([key])), change_px)
            out.append(np.sqrt(np.mean(whitened**2)))
        return np.array(out)

    def prior_information(self) -> FloatArray:
        """Information (n, n) of the priors of the variables of `keys`, one after the other."""
        if self.sharing.covariance is None:
            return np.diag(np.concatenate([v.sigma for v in self.numbers]) ** -2.0)
        covariance = self._joint(self.keys)
        size = np.sqrt(np.diag(covariance))
        return np.asarray(np.linalg.inv(covariance / np.outer(size, size)) / np.outer(size, size))

    # --- cameras at values of the variables ---

    def calibration(self, values: gtsam.Values) -> FloatArray:
        """K (images, 3, 3)."""
        if not self.of["calibration"]:
            return self._K
        out: FloatArray = self._K.copy()
        row, column = CALIBRATION_ENTRIES
        out[:, row, column] += self._read("calibration", values)
        return out

    def mounts(self, values: gtsam.Values) -> tuple[FloatArray, FloatArray]:
        """`head_T_camera` (images, 3, 3), (images, 3)."""
        return (
            corrected_poses(*self._mounts, self._read("mounts", values))
            if self.of["mounts"]
            else self._mounts
        )

    def mount_twists(self, values: gtsam.Values) -> FloatArray:
        """(images, 6, columns) body-frame twist of each mount by its variable."""
        return np.asarray(correction_twists(self._read("mounts", values)) @ self._basis["mounts"])

    def axes(self, values: gtsam.Values) -> tuple[FloatArray, FloatArray] | None:
        """`pan_T_tilt` (stops, 3, 3), (stops, 3); None where it is fixed."""
        if not self.of["pan_T_tilt"]:
            return None
        nominal = self.traverse.rig.pan_T_tilt
        correction = self._read("pan_T_tilt", values)
        return corrected_poses(nominal.rotation().matrix(), nominal.translation(), correction)

    def axis_twists(self, values: gtsam.Values) -> FloatArray:
        """(stops, 6, columns) body-frame twist of each tilt axis by its variable."""
        return np.asarray(correction_twists(self._read("pan_T_tilt", values)) @ self._basis["pan_T_tilt"])

    def mount_slot(self, image: int) -> PoseSlot:
        """Slot of an image's mount."""
        nominal = self.traverse.rig.eyes[int(self.traverse.image_eye[image])].head_T_camera
        return _pose_slot(self.variable("mounts", image), nominal)

    def axis_slot(self, stop: int) -> PoseSlot:
        """Slot of a stop's tilt axis."""
        return _pose_slot(self.variable("pan_T_tilt", stop), self.traverse.rig.pan_T_tilt)

    def radius_slot(self, image: int) -> tuple[Slot, float]:
        """Slot of the radius of an image's circle, and the rig's value of that radius, metres."""
        if (v := self.variable("radius", image)) is not None:
            return Key(v.key), self.reference_radius_m(v)
        reference = float(self._radius_m[self.traverse.image_eye[image]])
        return Fixed(reference), reference

    def reference_radius_m(self, variable: RigVariable) -> float:
        """The rig's radius of a variable's circle, metres; of several images, that of the first."""
        return float(self._radius_m[self.traverse.image_eye[variable.first]])

    # --- uncertainties ---

    def sigmas(self, covariance: Covariance, linkage: Linkage) -> list[FloatArray]:
        """Standard deviations (entries,) of each variable."""
        out = []
        for v in self.variables:
            columns, g = linkage.columns_of(v.key), self.group(v)
            out.append(np.sqrt(np.diag(covariance.block(g, g)[columns, columns])))
        return out

    def rig_covariance(self, values: gtsam.Values, covariance: Covariance, linkage: Linkage) -> RigCovariance:
        """Joint covariance of the rig's numbers about their values after the adjustment.

        Of the numbers that belong to the whole traverse; an entry of the prior's covariance whose eye has no
        image, or that was held, keeps its covariance with the others like it. Corrections of a rig that is
        corrected already differ from those of this one in the second order: their Jacobian is in it.
        """
        variables, g = self.numbers, len(self.traverse.stops)
        keys = [*self.keys, *self.field_keys]
        columns = [np.arange(c.start, c.stop) for c in map(linkage.columns_of, keys)]
        entries = [entry for key in keys for entry in self._entries_of(key)]
        order = np.concatenate([np.zeros(0, dtype=np.int64), *columns])
        moved = [self._moved(v, values) for v in variables]
        of_field = [np.eye(len(RIG_ENTRIES["field"])) for _ in self.field_keys]  # it is linear
        jacobian = block_diagonal([*moved, *of_field])
        matrix = jacobian @ covariance.block(g, g)[np.ix_(order, order)] @ jacobian.T
        prior = self.sharing.covariance
        if prior is not None:
            unseen = [e for e in prior.entries if e not in entries]
            entries += unseen
            matrix = block_diagonal([matrix, prior.among(unseen, np.zeros(len(unseen)))])
        return RigCovariance(entries=tuple(entries), matrix=(matrix + matrix.T) / 2)

    def _moved(self, variable: RigVariable, values: gtsam.Values) -> FloatArray:
        """Derivative (n, n) of corrections of the adjusted rig by those of the rig of the traverse."""
        at = values.atVector(variable.key)
        basis = self._basis[variable.quantity][variable.first]
        if variable.quantity != "calibration":
            twists = correction_twists(basis @ at)
            held = ~np.any(basis != 0, axis=1)
            return np.asarray(twists[np.ix_(~held, ~held)])
        fx, fy = self._K[variable.first][[0, 1], [0, 1]] + (basis @ at)[:2]
        nominal = self._K[variable.first][[0, 1], [0, 1]]
        out = np.eye(len(at))
        # A share of the adjusted focal length is less of it than the same share of the one of the traverse.
        place = {entry: i for i, entry in enumerate(variable.entries)}
        if FOCAL in place:
            out[place[FOCAL], place[FOCAL]] = nominal[0] / fx
        if ASPECT in place:
            out[place[ASPECT], place[ASPECT]] = nominal[1] / fy
            if FOCAL in place:
                out[place[ASPECT], place[FOCAL]] = nominal[1] / fy - nominal[0] / fx
        return out

    def refined(self, values: gtsam.Values, sigmas: list[FloatArray] | None) -> tuple[Refined, ...]:
        """Estimates of every free entry at the values; sigmas as `sigmas` gives them, None: unknown."""
        t = self.traverse
        out = []
        for i, v in enumerate(self.variables):
            if v.quantity == "radius":
                change_of_entry = np.array([values.atDouble(v.key) - self.reference_radius_m(v)])
            else:
                change_of_entry = values.atVector(v.key)
            for j, entry in enumerate(v.entries):
                out.append(
                    Refined(
                        quantity=v.quantity,
                        entry=entry,
                        camera=None if v.eye is None else t.rig.eyes[v.eye].name,
                        stop=None if v.stop is None else t.stops[v.stop].id,
                        image=None if v.image is None else t.images[v.image].id,
                        nominal=v.nominal[j],
                        change=float(change_of_entry[j]),
                        sigma=np.nan if sigmas is None else float(sigmas[i][j]),
                        prior_sigma=float(v.sigma[j]),
                    )
                )
        return tuple(out)

    def start_error(self) -> tuple[FloatArray, FloatArray]:
        """Initial error of each image's camera, one sigma: pixels (images,), metres (images,).

        It follows from the priors of calibration, mounts, pan_T_tilt and encoders; an entry without a prior
        counts with the default sigma.
        """
        t, focal = self.traverse, self._K[:, 0, 0]
        half = np.array([max(e.camera.width_px, e.camera.height_px) / 2 for e in t.rig.eyes])[t.image_eye]
        one = np.ones(len(focal))
        # Motion of pixels by a unit of an entry; by one of a calibration, at the edge of the image.
        farthest = np.abs(t.pan_tilt_rad).max(axis=0, initial=0.0)
        weight = {"cx_px": one, "cy_px": one, FOCAL: half, ASPECT: half}
        weight |= {"pan_scale": focal * farthest[0], "tilt_scale": focal * farthest[1]}
        weight |= dict.fromkeys(ENTRIES["mounts"][:3], focal)
        square_px, square_m = np.zeros(len(t.images)), np.zeros(len(t.images))
        for v in self.variables:
            if v.quantity == "radius":  # calibration, mounts, axes and encoders alone count
                continue
            place = self._place[v.quantity][t.image_stop if v.quantity in _OF_STOPS else slice(None)]
            of_variable = np.array([other is v for other in self.of[v.quantity]])[place]
            for entry, known in zip(v.entries, np.where(np.isfinite(v.sigma), v.sigma, v.usual), strict=True):
                if entry.endswith("_m"):
                    square_m[of_variable] += known**2
                else:
                    square_px[of_variable] += (known * weight.get(entry, half / focal)[of_variable]) ** 2
        return np.sqrt(square_px), np.sqrt(square_m)


def _of(correction: RigCorrection, quantity: Quantity) -> FloatArray:
    return {
        "calibration": correction.calibration_px,
        "mounts": correction.mount,
        "pan_T_tilt": correction.pan_T_tilt,
        "radius": correction.radius_m[:, None],
        "encoders": np.zeros((len(correction.pan_T_tilt), 2))
        if correction.encoders is None
        else correction.encoders,
    }[quantity]


def _pose_slot(variable: RigVariable | None, nominal: gtsam.Pose3) -> PoseSlot:
    if variable is None:
        return Fixed(nominal)
    free = tuple(ENTRIES[variable.quantity].index(e) for e in variable.entries)
    return Corrected(variable.key, nominal, free)
