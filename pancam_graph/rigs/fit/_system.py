"""The equations of the fit: the unknowns, their units, and their whitened least squares."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.rigs._chain import Chain, PosedCameras

__all__ = ["Equations", "Place", "ReferenceSigma", "RigFitOptions", "System", "Unknowns"]


@dataclass(frozen=True, kw_only=True)
class ReferenceSigma:
    """Expected difference of a mechanism from the reference, one standard deviation of each component.

    These are the units of the unknowns, in which a direction counts as free. 0: held.
    """

    mast_rad: float = 0.05
    """Rotation of world_T_mast."""
    mast_m: float = 0.05
    """Translation of world_T_mast."""
    axis_rad: float = 5e-3
    """Rotation of pan_T_tilt, as the deviation of the axes from a right angle."""
    axis_m: float = 5e-3
    """Translation of pan_T_tilt."""
    mount_rad: float = 0.05
    """Rotation of each head_T_camera."""
    mount_m: float = 0.05
    """Translation of each head_T_camera."""
    offset_rad: float = 0.05
    """The zero points of pan and tilt, where they are estimated."""


@dataclass(frozen=True, kw_only=True)
class RigFitOptions:
    """How to fit a rig. Raises InputError naming the option that makes no sense."""

    angles: Literal["exact", "offsets", "free"] = "exact"
    """The given pan and tilt are "exact"; or right except for one zero point each ("offsets"); or measured
    with `angle_sigma_rad` in each pointing ("free")."""
    rotation_sigma_rad: float = 1e-5
    """Standard deviation of the given cameras' rotations, each component. Default: six printed digits."""
    centre_sigma_m: float = 1e-5
    """Standard deviation of the given cameras' centres, each component."""
    angle_sigma_rad: float = 1.34e-3
    """Standard deviation of given pan and tilt where they are "free". Default: MER, 0.077 degrees."""
    reference_sigma: ReferenceSigma = ReferenceSigma()

    def __post_init__(self) -> None:
        """Check the choices."""
        if self.angles not in {"exact", "offsets", "free"}:
            raise InputError(f"fit_rig: angles: expected exact, offsets or free; found {self.angles!r}")
        for name in ("rotation_sigma_rad", "centre_sigma_m", "angle_sigma_rad"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"fit_rig: {name}: expected a number above 0, found {getattr(self, name)}")
        for name, sigma in vars(self.reference_sigma).items():
            if not 0 <= sigma < np.inf:
                raise InputError(
                    f"fit_rig: reference_sigma: {name}: expected 0 (held) or above, found {sigma}"
                )


@dataclass(frozen=True, kw_only=True, eq=False)
class Unknowns:
    """The unknowns: corrections of the chain's poses, and the offsets of pan and tilt."""

    names: tuple[str, ...]
    """Names of all numbers, held ones too: pose by pose, rotation before translation, then the offsets."""
    sigma: FloatArray
    """(numbers,) unit of each; 0 where held."""

    @staticmethod
    def of(eyes: Sequence[str], options: RigFitOptions) -> "Unknowns":
        """The numbers of a chain with these eyes."""
        s = options.reference_sigma
        poses = ["world_T_mast", "pan_T_tilt", *(f"head_T_camera of {e}" for e in eyes)]
        names = [
            f"{p}: {kind} {xyz}" for p in poses for kind in ("turn about", "shift along") for xyz in "xyz"
        ]
        units = [(s.mast_rad, s.mast_m), (s.axis_rad, s.axis_m), *[(s.mount_rad, s.mount_m)] * len(eyes)]
        offset = s.offset_rad if options.angles == "offsets" else 0.0
        return Unknowns(
            names=(*names, "offset of pan", "offset of tilt"),
            sigma=np.concatenate([np.repeat(np.array(units), 3, axis=1).ravel(), [offset, offset]]),
        )

    @property
    def sought(self) -> BoolArray:
        """(numbers,) whether each is estimated."""
        return np.asarray(self.sigma > 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """A point of the parameter space: corrections of the reference, and the angles of pointings."""

    unknowns: FloatArray
    """(numbers,) radians and metres; 0 at the reference."""
    angles_rad: FloatArray
    """(pointings, 2) pan and tilt: estimated where they are free, else as given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """Whitened equations about one place, free angles eliminated."""

    jacobian: FloatArray
    """(rows, sought) derivatives by the unknowns in their units."""
    residual: FloatArray
    """(rows,) whitened residuals."""
    cost: float
    """Sum of squares of all rows, before elimination."""
    angle_gain: FloatArray
    """(pointings, 2, sought) radians by which eliminated angles follow the unknowns in their units."""
    angle_step_rad: FloatArray
    """(pointings, 2) change of eliminated angles if the unknowns do not change, radians."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Equations:
    """The least squares problem of a fit."""

    cameras: PosedCameras
    given_rad: FloatArray
    """(n, 2) pan and tilt of each camera as given."""
    reference: Chain
    unknowns: Unknowns
    options: RigFitOptions

    @cached_property
    def measured_rad(self) -> FloatArray:
        """(pointings, 2) mean of the given angles of each pointing's cameras."""
        count = np.bincount(self.cameras.pointing)
        sums = [np.bincount(self.cameras.pointing, angle) for angle in self.given_rad.T]
        return np.asarray(np.stack(sums, axis=1) / count[:, None])

    @cached_property
    def first_place(self) -> Place:
        """The reference, at the given angles."""
        return Place(unknowns=np.zeros(len(self.unknowns.names)), angles_rad=self.measured_rad)

    def spare(self, rank: int) -> int:
        """Degrees of freedom that are left if so many directions of the unknowns are determined."""
        # The two angles of a pointing are two unknowns and two measurements.
        return 6 * len(self.given_rad) - rank

    @property
    def _angles_are_free(self) -> bool:
        return self.options.angles == "free"

    @cached_property
    def _weights(self) -> FloatArray:
        return 1 / np.repeat([self.options.rotation_sigma_rad, self.options.centre_sigma_m], 3)

    def chain(self, place: Place) -> Chain:
        """The chain at a place."""
        return self.reference.corrected(place.unknowns[:-2].reshape(-1, 6))

    def pan_tilt_rad(self, place: Place) -> FloatArray:
        """(n, 2) pan and tilt of each camera at a place."""
        if self._angles_are_free:
            return place.angles_rad[self.cameras.pointing]
        return self.given_rad + place.unknowns[-2:]

    def misfit(self, place: Place) -> FloatArray:
        """Misfit (n, 6) of the chain to each camera; see `Chain.misfit`."""
        return self.chain(place).misfit(self.cameras, self.pan_tilt_rad(place))

    def cost(self, place: Place) -> float:
        """Sum of squares of all rows."""
        cost = float(np.sum((self.misfit(place) * self._weights) ** 2))
        if self._angles_are_free:
            moved = place.angles_rad - self.measured_rad
            cost += float(np.sum((moved / self.options.angle_sigma_rad) ** 2))
        return cost

    def system(self, place: Place) -> System:
        """The equations about a place."""
        misfit, by_pose, by_angle = self.reference.misfit_jacobian(
            self.cameras, self.pan_tilt_rad(place), place.unknowns[:-2].reshape(-1, 6)
        )
        n, sought = len(misfit), self.unknowns.sought
        residual = misfit * self._weights
        by_angle = by_angle * self._weights[:, None]
        by_pose = by_pose.reshape(n, 6, -1) * self._weights[:, None]
        jacobian = np.concatenate([by_pose, by_angle], axis=2)[..., sought] * self.unknowns.sigma[sought]
        if self._angles_are_free:
            return self._eliminated(place, residual, jacobian, by_angle)
        pointings = len(self.measured_rad)
        return System(
            jacobian=jacobian.reshape(6 * n, -1),
            residual=residual.ravel(),
            cost=float(np.sum(residual**2)),
            angle_gain=np.zeros((pointings, 2, jacobian.shape[2])),
            angle_step_rad=np.zeros((pointings, 2)),
        )

    def _eliminated(
        self, place: Place, residual: FloatArray, jacobian: FloatArray, by_angle: FloatArray
    ) -> System:
        """The equations with the angles of each pointing eliminated by QR decomposition."""
        prior = (place.angles_rad - self.measured_rad) / self.options.angle_sigma_rad
        columns, pointings = jacobian.shape[2], len(prior)
        rows, values = [], []
        gain, step = np.zeros((pointings, 2, columns)), np.zeros((pointings, 2))
        order = np.argsort(self.cameras.pointing, kind="stable")
        count = np.bincount(self.cameras.pointing, minlength=pointings)
        begin = np.cumsum(count) - count
        for size in np.unique(count):  # pointings with equally many cameras, all at once
            of = np.flatnonzero(count == size)
            images = order[begin[of, None] + np.arange(size)]
            measured = np.broadcast_to(np.eye(2) / self.options.angle_sigma_rad, (len(of), 2, 2))
            by_own_angles = np.concatenate([by_angle[images].reshape(len(of), -1, 2), measured], axis=1)
            shared = jacobian[images].reshape(len(of), -1, columns)
            shared = np.concatenate([shared, np.zeros((len(of), 2, columns))], axis=1)
            value = np.concatenate([residual[images].reshape(len(of), -1), prior[of]], axis=1)
            q, r = np.linalg.qr(by_own_angles, mode="complete")
            q_T = np.swapaxes(q, 1, 2)
            shared, value = q_T @ shared, (q_T @ value[..., None])[..., 0]
            gain[of] = -np.linalg.solve(r[:, :2], shared[:, :2])
            step[of] = -np.linalg.solve(r[:, :2], value[:, :2, None])[..., 0]
            rows.append(shared[:, 2:].reshape(-1, columns))
            values.append(value[:, 2:].ravel())
        return System(
            jacobian=np.concatenate(rows),
            residual=np.concatenate(values),
            cost=float(np.sum(residual**2) + np.sum(prior**2)),
            angle_gain=gain,
            angle_step_rad=step,
        )

    def moved(self, place: Place, system: System, step: FloatArray) -> Place:
        """A place moved by a step of the unknowns (sought,) in their units; eliminated angles follow."""
        sought = self.unknowns.sought
        unknowns = place.unknowns.copy()
        unknowns[sought] += self.unknowns.sigma[sought] * step
        return Place(
            unknowns=unknowns,
            angles_rad=place.angles_rad + system.angle_step_rad + system.angle_gain @ step,
        )
