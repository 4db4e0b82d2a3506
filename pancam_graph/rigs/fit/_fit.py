"""Fit a rig to cameras whose poses are known: axes, arms and mounts of a real mast."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray, correction_twists, pose_arrays
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.cameras import CAHV, Camera, lens_of
from pancam_graph.rigs._chain import Chain, PosedCameras
from pancam_graph.rigs._rig import Eye, PointingSigma, Rig
from pancam_graph.rigs.fit._free_directions import FreeDirection, free_directions
from pancam_graph.rigs.fit._solve import Optimum, optimum
from pancam_graph.rigs.fit._start import first_chain
from pancam_graph.rigs.fit._system import Equations, RigFitOptions, Unknowns

__all__ = ["RigFit", "fit_rig"]

_LARGEST_M = 1e9


@dataclass(frozen=True, kw_only=True, eq=False)
class RigFit:
    """A chain that fits given cameras, its misfits, and the directions that the cameras leave free."""

    world_T_mast: gtsam.Pose3
    """Where the mast stands in the frame of the given cameras."""
    pan_T_tilt: gtsam.Pose3
    """Where the tilt axis (y) sits on the pan stage."""
    eyes: tuple[str, ...]
    """Names of the eyes, in the order in which they appear."""
    head_T_camera: tuple[gtsam.Pose3, ...]
    """Mount of each eye."""
    cameras: tuple[CAHV | None, ...]
    """Mean camera of each eye in its own frame; None where only poses were given."""
    pan_tilt_rad: FloatArray
    """(n, 2) pan and tilt at which the chain meets each camera: given, moved by the offset, or fitted."""
    angle_offset_rad: FloatArray
    """(2,) estimated offsets of the zero points of pan and tilt; 0 where they were not estimated."""
    residual_rad: FloatArray
    """(n, 3) rotation vector from each given camera to the chain's, in the camera's frame."""
    residual_m: FloatArray
    """(n, 3) shift from each given camera's centre to the chain's, in the frame of the given cameras."""
    variance_factor: float
    """Sum of squared whitened residuals per degree of freedom: 1 if the given sigmas are right; NaN where
    there are no more equations than unknowns."""
    names: tuple[str, ...]
    """Names of all numbers of the chain: pose by pose, rotation before translation, then offsets of the
    angles."""
    covariance: FloatArray
    """(numbers, numbers) formal covariance by the given sigmas, in body-frame tangents of the poses. Along
    free directions it is 0: there the reference holds."""
    singular_values: FloatArray
    """Descending: by how many sigmas of the cameras the misfit changes for a step of one sigma of the
    reference along each direction. Below 1, a direction counts as free."""
    free_directions: tuple[FreeDirection, ...]
    """Directions that the cameras do not determine; along these the chain is nearest to the reference."""
    reference: str
    """The reference, in words."""
    converged: bool
    """Whether the fit reached its optimum."""
    iterations: int
    """Number of steps."""

    @property
    def rms_m(self) -> float:
        """Root mean square distance between given centres and those of the chain."""
        return float(np.sqrt(np.mean(np.sum(self.residual_m**2, axis=1))))

    @property
    def rms_rad(self) -> float:
        """Root mean square angle between given cameras and those of the chain."""
        return float(np.sqrt(np.mean(np.sum(self.residual_rad**2, axis=1))))

    @property
    def worst_m(self) -> float:
        """Largest distance between a given centre and the chain's."""
        return float(np.linalg.norm(self.residual_m, axis=1).max())

    @property
    def worst_rad(self) -> float:
        """Largest angle between a given camera and the chain's."""
        return float(np.linalg.norm(self.residual_rad, axis=1).max())

    def rig(
        self,
        name: str = "fitted rig",
        *,
        cameras: Sequence[Camera] | None = None,
        pointing_sigma: PointingSigma | None = None,
    ) -> Rig:
        """The rig that was fitted, with `cameras` (one per eye, in their own frames) in place of its own.

        Raises InputError where an eye has no camera, because poses were fitted.
        """
        given = self.cameras if cameras is None else tuple(cameras)
        if len(given) != len(self.eyes):
            raise InputError(f"rig {name}: expected {len(self.eyes)} cameras, found {len(given)}")
        eyes = []
        for eye, camera, mount in zip(self.eyes, given, self.head_T_camera, strict=True):
            if camera is None:
                raise InputError(f"rig {name}: eye {eye}: expected a camera, found only its poses")
            eyes.append(Eye(name=eye, camera=camera, head_T_camera=mount))
        rig = Rig(name=name, pan_T_tilt=self.pan_T_tilt, eyes=tuple(eyes), source="fit_rig")
        return rig if pointing_sigma is None else replace(rig, pointing_sigma=pointing_sigma)

    def report(self) -> str:
        """The misfits and the free directions, in a few lines of text."""
        worst = int(np.linalg.norm(self.residual_m, axis=1).argmax())
        turned = int(np.linalg.norm(self.residual_rad, axis=1).argmax())
        lines = [
            f"{len(self.residual_m)} cameras, {len(self.eyes)} eyes ({', '.join(self.eyes)}); "
            f"{'converged' if self.converged else 'NOT converged'} in {self.iterations} steps",
            f"misfit of centres: rms {self.rms_m * 1e3:.4f} mm, "
            f"worst {self.worst_m * 1e3:.4f} mm (camera {worst})",
            f"misfit of rotations: rms {self.rms_rad * 1e3:.4f} mrad, "
            f"worst {self.worst_rad * 1e3:.4f} mrad (camera {turned})",
            f"reference: {self.reference}",
            f"directions that the cameras do not tell: {len(self.free_directions)} of "
            f"{len(self.singular_values)}",
            *(f"- {direction.text}" for direction in self.free_directions),
        ]
        return "\n".join(lines)


def fit_rig(
    cameras: Sequence[gtsam.Pose3 | CAHV],
    pan_tilt_rad: FloatArray,
    *,
    eyes: Sequence[str] | None = None,
    pointings: Sequence[int] | None = None,
    reference: Rig | None = None,
    world_T_mast: gtsam.Pose3 | None = None,
    pan_T_tilt: gtsam.Pose3 | None = None,
    options: RigFitOptions = RigFitOptions(),  # noqa: B008  frozen
) -> RigFit:
    """Fit `world_T_mast`, `pan_T_tilt` and one `head_T_camera` per eye to cameras at known pan and tilt.

    `cameras` are poses `world_T_camera`, or CAHV-family models with their vectors in one frame, which is then
    the world (labels: the rover frame, z down as it is). `pan_tilt_rad` (n, 2) are the angles of each, pan
    anticlockwise seen from above, tilt upwards. An encoder that counts the other way must have its sign
    turned: cameras alone do not show it, they fit as well with mast and head upside down. `eyes` names the
    eye of each camera (default: one eye, "camera"). `pointings` numbers the pointing of each; default:
    cameras with equal angles are one pointing. It matters only where angles are "free".

    Some directions are never determined by cameras: the zero point of pan against the mast's yaw, and the
    like; with few cameras, one pan or one tilt there are more. They are found by the singular values of the
    Jacobian and named in the result, and the chain is the one that is nearest to the reference in
    `options.reference_sigma`. The reference is the rig `reference` on the mast `world_T_mast`. Where a rig is
    not given, its tilt axis is `pan_T_tilt` (default: axes that meet and are square), and mounts and mast are
    placed where they fit the cameras best.

    Residuals are weighted with the sigmas of the options; it is the maximum-likelihood estimate for
    Gaussian errors of the cameras. Raises InputError for fewer than two cameras (one, where mast and axes are
    held), for numbers that are not finite or do not fit in number, for an eye that the reference has not,
    and for models of one eye that differ in kind or size.
    """
    options = options_of(RigFitOptions, options, "fit_rig")
    if reference is not None and pan_T_tilt is not None:
        raise InputError(
            "fit_rig: pan_T_tilt: expected none beside a reference rig, which has one; found one"
        )
    names = list(eyes) if eyes is not None else ["camera"] * len(cameras)
    s = options.reference_sigma
    needed = 1 if max(s.mast_rad, s.mast_m, s.axis_rad, s.axis_m) == 0 else 2
    n = len(cameras)
    _require(n >= needed, "cameras", f"{needed} or more", str(n))
    _require(len(names) == n, "eyes", f"{n} names, one per camera", str(len(names)))
    angles = _checked_angles(pan_tilt_rad, n)
    models, poses = _split(cameras, names)
    order = tuple(dict.fromkeys(names))
    rotation, centre = pose_arrays(poses)
    posed = PosedCameras(
        rotation=rotation,
        centre_m=centre,
        eye=np.array([order.index(name) for name in names], dtype=np.int64),
        pointing=_numbered_pointings(pointings, angles),
    )
    equations = Equations(
        cameras=posed,
        given_rad=angles,
        reference=_reference(posed, angles, order, reference, world_T_mast, pan_T_tilt),
        unknowns=Unknowns.of(order, options),
        options=options,
    )
    means, words = _mean_cameras(models, names, order), _words(reference, world_T_mast, pan_T_tilt)
    with blas_on_one_thread():  # many small matrices
        return _result(equations, optimum(equations), order, means, words)


def _require(fits: bool, entry: str, expected: str, found: str) -> None:
    if not fits:
        raise InputError(f"fit_rig: {entry}: expected {expected}, found {found}")


def _checked_angles(pan_tilt_rad: FloatArray, n: int) -> FloatArray:
    angles = float_array("pan_tilt_rad", pan_tilt_rad)
    _require(angles.shape == (n, 2), "pan_tilt_rad", f"shape ({n}, 2)", str(angles.shape))
    bad = np.flatnonzero(~np.isfinite(angles).all(axis=1))
    if len(bad):
        _require(False, f"pan_tilt_rad, row {bad[0]}", "finite angles", str(angles[bad[0]].tolist()))
    return angles


def _numbered_pointings(pointings: Sequence[int] | None, pan_tilt_rad: FloatArray) -> IntArray:
    """(n,) numbers from 0 without gaps; cameras with equal angles are one pointing unless told otherwise."""
    n = len(pan_tilt_rad)
    if pointings is None:
        rows = np.unique(pan_tilt_rad, axis=0, return_inverse=True)[1]
    else:
        _require(len(pointings) == n, "pointings", f"{n} numbers, one per camera", str(len(pointings)))
        rows = np.unique(np.asarray(pointings), return_inverse=True)[1]
    return rows.reshape(-1).astype(np.int64)


def _split(
    cameras: Sequence[gtsam.Pose3 | CAHV], names: Sequence[str]
) -> tuple[list[CAHV | None], list[gtsam.Pose3]]:
    """Models in their own frames (None for a pose), and poses. Checks that an eye's models are of a kind."""
    models: list[CAHV | None] = []
    poses: list[gtsam.Pose3] = []
    kinds: dict[str, str] = {}
    for i, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        if isinstance(camera, CAHV):
            model, pose = camera.split()
            kind = f"{type(camera).__name__} of {camera.width_px} x {camera.height_px}"
        else:
            model, pose, kind = None, camera, "pose"
        fine = np.isfinite(pose.matrix()).all() and np.abs(pose.translation()).max() < _LARGEST_M
        centre = str(pose.translation().tolist())
        _require(bool(fine), f"cameras[{i}]", "a pose of finite numbers", f"its centre at {centre}")
        expected = kinds.setdefault(name, kind)
        _require(
            kind == expected, f"cameras[{i}]", f"a {expected} like the others of eye {name}", f"a {kind}"
        )
        models.append(model)
        poses.append(pose)
    return models, poses


def _reference(
    cameras: PosedCameras,
    pan_tilt_rad: FloatArray,
    eyes: tuple[str, ...],
    rig: Rig | None,
    world_T_mast: gtsam.Pose3 | None,
    pan_T_tilt: gtsam.Pose3 | None,
) -> Chain:
    mounts, axis = None, pan_T_tilt or gtsam.Pose3()
    if rig is not None:
        mounts = pose_arrays([rig.eyes[rig.eye_index(name)].head_T_camera for name in eyes])
        axis = rig.pan_T_tilt
    mast = None if world_T_mast is None else (world_T_mast.rotation().matrix(), world_T_mast.translation())
    return first_chain(
        cameras,
        pan_tilt_rad,
        (axis.rotation().matrix(), axis.translation()),
        mast=mast,
        mounts=mounts,
        n_eyes=len(eyes),
    )


def _words(rig: Rig | None, world_T_mast: gtsam.Pose3 | None, pan_T_tilt: gtsam.Pose3 | None) -> str:
    axis = "axes that meet and are square" if pan_T_tilt is None else "the given tilt axis"
    what = f"{axis}, mounts that suit the cameras" if rig is None else f"the rig {rig.name}"
    return f"{what}, on {'a mast that suits the cameras' if world_T_mast is None else 'the given mast'}"


def _mean_cameras(
    models: Sequence[CAHV | None], names: Sequence[str], eyes: tuple[str, ...]
) -> tuple[CAHV | None, ...]:
    """Mean of each eye's models, vector by vector; labels of one camera differ in their last digits."""
    out: list[CAHV | None] = []
    for eye in eyes:
        of_eye = [m for m, name in zip(models, names, strict=True) if name == eye and m is not None]
        out.append(_mean_model(of_eye) if of_eye else None)
    return tuple(out)


def _mean_model(models: Sequence[CAHV]) -> CAHV:
    first = models[0]
    means: dict[str, Any] = {
        name: np.mean([getattr(model, name) for model in models], axis=0)
        for name in lens_of(first).attributes()
    }
    numbers: dict[str, Any] = {n: value if np.ndim(value) else float(value) for n, value in means.items()}
    return replace(first, **numbers)


def _result(
    equations: Equations,
    best: Optimum,
    eyes: tuple[str, ...],
    cameras: tuple[CAHV | None, ...],
    reference: str,
) -> RigFit:
    chain = equations.chain(best.place)
    mast, axis, *mounts = (
        gtsam.Pose3(gtsam.Rot3(R), t) for R, t in zip(chain.rotation, chain.translation_m, strict=True)
    )
    misfit = equations.misfit(best.place)
    spare = equations.spare(best.rank)
    return RigFit(
        world_T_mast=mast,
        pan_T_tilt=axis,
        eyes=eyes,
        head_T_camera=tuple(mounts),
        cameras=cameras,
        pan_tilt_rad=equations.pan_tilt_rad(best.place),
        angle_offset_rad=best.place.unknowns[-2:],
        residual_rad=misfit[:, :3],
        residual_m=misfit[:, 3:],
        variance_factor=equations.cost(best.place) / spare if spare > 0 else float("nan"),
        names=equations.unknowns.names,
        covariance=_covariance(equations, best),
        singular_values=best.singular_values,
        free_directions=free_directions(equations, best),
        reference=reference,
        converged=best.converged,
        iterations=best.iterations,
    )


def _covariance(equations: Equations, best: Optimum) -> FloatArray:
    """Covariance of body-frame tangents, from that of the corrections along determined directions."""
    sought, sigma = equations.unknowns.sought, equations.unknowns.sigma
    half = np.zeros((len(sigma), best.rank))
    told = best.directions[: best.rank].T / best.singular_values[: best.rank]
    half[sought] = sigma[sought][:, None] * told
    poses = half[:-2].reshape(len(half) // 6, 6, best.rank)
    twists = correction_twists(best.place.unknowns[:-2].reshape(-1, 6)) @ poses
    half[:-2] = twists.reshape(half[:-2].shape)
    return np.asarray(half @ half.T)
