"""Constraints: what is known of terrain points and stops beside pictures and telemetry, each with a sigma.

All coordinates are of the world, metres; azimuths and headings count anticlockwise from its x axis, seen from
above. Every constructor raises InputError for numbers that are not finite, and for too many or too few.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import gtsam
import numpy as np

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data._surface import Surface

__all__ = [
    "CONSTRAINTS",
    "EXACT",
    "Constraint",
    "FrameDirection",
    "FramePoint",
    "FrameSeen",
    "Landmark",
    "LandmarkAzimuth",
    "LandmarkDistance",
    "LandmarkElevation",
    "LandmarkHeight",
    "LandmarkInfinity",
    "LandmarkPlane",
    "LandmarkPosition",
    "LandmarkSurface",
    "StopDistance",
    "StopHeading",
    "StopPlacement",
    "StopPose",
    "StopPosition",
]

Landmark = str | int
"""A terrain point: its name in `points.csv`, or the number of its track."""

EXACT = 1e-5
"""Sigma, metres or radians, that stands for 0: far below what pictures tell, and above rounding."""
_LARGEST = 1e9
"""Metres: beyond the size of all bodies that anything drives on; squares of it keep their digits."""
_UNIT = 1e-3
"""How far the length of a unit normal may be from 1; it is made 1."""
_STOPS = "stops: expected the ids of two different stops"
_ASYMMETRY = 1e-9
"""Largest difference of mixed entries of a covariance, as a share of its largest variance."""
_FLATTEST = 1e-12
"""Least eigenvalue of a correlation matrix: less is singular but for rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Constraint:
    """One constraint; its kind says what is known."""

    robust: bool = False
    """Whether it may be wrong: where all else contradicts it, it is let go, and the solution may pass."""

    kind: ClassVar[str] = ""
    """Value of `kind` in files."""

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """The terrain points that it is about."""
        one = getattr(self, "landmark", None)
        return () if one is None else (one,)

    @property
    def stops(self) -> tuple[str, ...]:
        """Ids of the stops that it is about."""
        one = getattr(self, "stop", None)
        return () if one is None else (one,)

    @property
    def about(self) -> str:
        """Its kind, and what it is about, in words."""
        return f"{self.kind} of {' and '.join(str(one) for one in (*self.landmarks, *self.stops))}"

    def contradicts(self, other: "Constraint") -> bool:
        """Whether both are exact (sigma 0), about the same, and differ."""
        return False


@dataclass(frozen=True, kw_only=True, eq=False)
class _Placed(Constraint):
    """A known position, of all axes of the world or some."""

    position_m: Sequence[float | None]
    """(3,) coordinates in the world; None leaves an axis free."""
    sigma_m: Sequence[float | None] | None = None
    """(3,) standard deviation of each axis that is not free; 0: exact."""
    covariance_m2: FloatArray | None = None
    """(3, 3) covariance in place of the sigmas, where no axis is free."""

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        position = _three("position_m", self.position_m)
        known = ~np.isnan(position)
        if not known.any():
            raise InputError("position_m: expected one coordinate at least, found none")
        if (self.sigma_m is None) == (self.covariance_m2 is None):
            found = "neither" if self.sigma_m is None else "both"
            raise InputError(f"sigma_m: expected it, or covariance_m2; found {found}")
        if self.sigma_m is not None:
            sigma = _three("sigma_m", self.sigma_m)
            for axis in np.flatnonzero(known).tolist():
                if not sigma[axis] >= 0:  # NaN for a sigma that is missing
                    raise InputError(
                        f"sigma_m[{axis}]: expected 0 (exact) or a positive number, as position_m has this "
                        f"axis; found {self.sigma_m[axis]}"
                    )
            return
        if not known.all():
            raise InputError("covariance_m2: expected sigma_m where position_m leaves an axis free")
        object.__setattr__(self, "covariance_m2", _covariance("covariance_m2", self.covariance_m2, 3))

    @property
    def axes(self) -> IntArray:
        """(k,) axes of the world that are known."""
        return np.flatnonzero(~np.isnan(_three("position_m", self.position_m)))

    @property
    def target_m(self) -> FloatArray:
        """(k,) known coordinates along `axes`."""
        return _three("position_m", self.position_m)[self.axes]

    @property
    def covariance(self) -> FloatArray:
        """(k, k) covariance of the known coordinates; exact ones have `EXACT`."""
        if self.covariance_m2 is not None:
            return self.covariance_m2
        assert self.sigma_m is not None
        return np.diag(_three("sigma_m", self.sigma_m)[self.axes].clip(EXACT) ** 2)

    def contradicts(self, other: Constraint) -> bool:
        """Whether an axis is exact in both, about the same, and differs."""
        if type(other) is not type(self) or self.sigma_m is None:
            return False
        assert isinstance(other, _Placed)
        if other.sigma_m is None or (*self.landmarks, *self.stops) != (*other.landmarks, *other.stops):
            return False
        a, b = _three("", self.position_m), _three("", other.position_m)
        both = (_three("", self.sigma_m) == 0) & (_three("", other.sigma_m) == 0)
        return bool(np.any(both & (np.abs(a - b) > EXACT)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Measured(Constraint):
    """One known number."""

    _value: ClassVar[str]
    """Name of the number, and of its sigma."""
    _sigma: ClassVar[str]
    _period: ClassVar[float] = np.inf

    def __post_init__(self) -> None:
        """Check numbers."""
        _number(self._value, getattr(self, self._value))
        sigma = _number(self._sigma, getattr(self, self._sigma))
        if sigma < 0:
            raise InputError(f"{self._sigma}: expected 0 (exact) or a positive number, found {sigma}")

    @property
    def value(self) -> float:
        """The known number, metres or radians."""
        return float(getattr(self, self._value))

    @property
    def sigma(self) -> float:
        """Its standard deviation; `EXACT` for an exact one."""
        return max(float(getattr(self, self._sigma)), EXACT)

    def contradicts(self, other: Constraint) -> bool:
        """Whether both are exact, about the same, and differ."""
        if type(other) is not type(self):
            return False
        assert isinstance(other, _Measured)
        if {*self.landmarks} != {*other.landmarks} or {*self.stops} != {*other.stops}:
            return False
        exact = getattr(self, self._sigma) == 0 and getattr(other, self._sigma) == 0
        apart = abs(self.value - other.value)
        return bool(exact and min(apart % self._period, -apart % self._period) > EXACT)


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkPosition(_Placed):
    """A terrain point at a known position, as a fiducial or a ground control point."""

    kind = "landmark-position"
    landmark: Landmark


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkHeight(_Measured):
    """A terrain point at a known height."""

    kind, _value, _sigma = "landmark-height", "height_m", "sigma_m"
    landmark: Landmark
    height_m: float
    """z in the world."""
    sigma_m: float


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkPlane(_Measured):
    """A terrain point on a known plane: unit normal . x = offset."""

    kind, _value, _sigma = "landmark-plane", "offset_m", "sigma_m"
    landmark: Landmark
    normal: Sequence[float]
    """(3,) unit normal of the plane in the world."""
    offset_m: float
    """Distance of the plane from the world's origin along the unit normal."""
    sigma_m: float
    """Across the plane."""

    def __post_init__(self) -> None:
        """Check numbers."""
        super().__post_init__()
        normal = _three("normal", self.normal)
        length = float(np.linalg.norm(normal))  # NaN where an entry is null
        if not abs(length - 1) <= _UNIT:  # of another normal, whose offset counts in other units
            raise InputError(
                f"normal: expected three numbers of length 1, found {list(self.normal)} of length {length:g}"
            )

    @property
    def unit_normal(self) -> FloatArray:
        """(3,) of unit length."""
        normal = _three("normal", self.normal)
        return np.asarray(normal / np.linalg.norm(normal))

    def contradicts(self, other: Constraint) -> bool:
        """Whether both are exact, of parallel normals, and differ."""
        if not isinstance(other, LandmarkPlane) or not super().contradicts(other):
            return False
        return bool(np.allclose(self.unit_normal, other.unit_normal, atol=EXACT, rtol=0))


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkAzimuth(_Measured):
    """A terrain point in a known azimuth from the origin of a stop's mast."""

    kind, _value, _sigma, _period = "landmark-azimuth", "azimuth_rad", "sigma_rad", 2 * np.pi
    landmark: Landmark
    stop: str
    azimuth_rad: float
    """Anticlockwise from the world's x axis, seen from above."""
    sigma_rad: float


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkElevation(_Measured):
    """A terrain point at a known elevation above the horizontal, from the origin of a stop's mast."""

    kind, _value, _sigma = "landmark-elevation", "elevation_rad", "sigma_rad"
    landmark: Landmark
    stop: str
    elevation_rad: float
    """Positive upwards, between -pi / 2 and pi / 2."""
    sigma_rad: float

    def __post_init__(self) -> None:
        """Check numbers."""
        super().__post_init__()
        if abs(self.elevation_rad) >= np.pi / 2:
            raise InputError(
                f"elevation_rad: expected a number between -pi / 2 and pi / 2, found {self.elevation_rad}"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkInfinity(Constraint):
    """A terrain point so far that it has no parallax, as a star or the sun."""

    kind = "landmark-infinity"
    landmark: Landmark


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkSurface(Constraint):
    """A terrain point on a known surface: its height above it, at its own place, is 0."""

    kind = "landmark-surface"
    landmark: Landmark
    surface: Surface
    sigma_m: float
    """Of heights; 0: exact."""

    def __post_init__(self) -> None:
        """Check numbers."""
        if _number("sigma_m", self.sigma_m) < 0:
            raise InputError(f"sigma_m: expected 0 (exact) or a positive number, found {self.sigma_m}")

    @property
    def sigma(self) -> float:
        """Standard deviation of heights; `EXACT` for exact ones."""
        return max(float(self.sigma_m), EXACT)


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkDistance(_Measured):
    """The distance between two terrain points, as a scale bar or a tape has it."""

    kind, _value, _sigma = "landmark-distance", "distance_m", "sigma_m"
    between: Sequence[Landmark]
    """The two points; `landmarks` in files."""
    distance_m: float
    sigma_m: float

    def __post_init__(self) -> None:
        """Check numbers."""
        super().__post_init__()
        _two(self.between, "landmarks: expected two different terrain points")
        if self.distance_m <= 0:
            raise InputError(f"distance_m: expected a number above 0, found {self.distance_m}")

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """Both points."""
        return tuple(self.between)


@dataclass(frozen=True, kw_only=True, eq=False)
class StopPosition(_Placed):
    """A stop's mast at a known position, beside the stop's own prior."""

    kind = "stop-position"
    stop: str


@dataclass(frozen=True, kw_only=True, eq=False)
class StopPlacement(Constraint):
    """A stop's mast at a known position and attitude, whose errors hang together; beside the stop's prior."""

    kind = "stop-position"
    stop: str
    world_T_mast: gtsam.Pose3
    covariance: FloatArray
    """(6, 6) in the tangent of world_T_mast: rotation first, in the mast frame, radians and metres."""

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        if not np.all(np.isfinite(self.world_T_mast.matrix())):
            raise InputError("world_T_mast: expected finite numbers, found NaN or infinity")
        object.__setattr__(self, "covariance", _covariance("covariance", self.covariance, 6))


@dataclass(frozen=True, kw_only=True, eq=False)
class StopPose(Constraint):
    """The pose of one stop's mast in that of another, beside the stops' own priors."""

    kind = "stop-pose"
    between: Sequence[str]
    """Ids of the stops a and b; `stops` in files."""
    a_T_b: gtsam.Pose3
    covariance: FloatArray
    """(6, 6) in the tangent of a_T_b: rotation first, in b's mast frame, radians and metres."""

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        _two(self.between, _STOPS)
        if not np.all(np.isfinite(self.a_T_b.matrix())):
            raise InputError("a_T_b: expected finite numbers, found NaN or infinity")
        object.__setattr__(self, "covariance", _covariance("covariance", self.covariance, 6))

    @property
    def stops(self) -> tuple[str, ...]:
        """Ids of both stops."""
        return tuple(self.between)


@dataclass(frozen=True, kw_only=True, eq=False)
class StopDistance(_Measured):
    """The distance between the mast origins of two stops."""

    kind, _value, _sigma = "stop-distance", "distance_m", "sigma_m"
    between: Sequence[str]
    """Ids of the two stops; `stops` in files."""
    distance_m: float
    sigma_m: float

    def __post_init__(self) -> None:
        """Check numbers."""
        super().__post_init__()
        _two(self.between, _STOPS)
        if self.distance_m <= 0:
            raise InputError(f"distance_m: expected a number above 0, found {self.distance_m}")

    @property
    def stops(self) -> tuple[str, ...]:
        """Ids of both stops."""
        return tuple(self.between)


@dataclass(frozen=True, kw_only=True, eq=False)
class StopHeading(_Measured):
    """The heading of a stop's mast: where its x axis points."""

    kind, _value, _sigma, _period = "stop-heading", "heading_rad", "sigma_rad", 2 * np.pi
    stop: str
    heading_rad: float
    """Anticlockwise from the world's x axis, seen from above."""
    sigma_rad: float


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameSeen(Constraint):
    """Something known at a pixel of a frame's picture."""

    frame: str
    """Id of the frame."""
    camera: str
    """Name of the eye that took the picture."""
    u_px: float
    v_px: float
    """Where it is in the picture."""
    sigma_px: float
    """Standard deviation of each coordinate, pixels."""

    def __post_init__(self) -> None:
        """Check numbers."""
        for name in ("u_px", "v_px"):
            _number(name, getattr(self, name))
        if _number("sigma_px", self.sigma_px) <= 0:
            raise InputError(f"sigma_px: expected a number above 0, found {self.sigma_px}")

    @property
    def about(self) -> str:
        """Its kind, frame and camera, in words."""
        return f"{self.kind} of {self.frame} {self.camera}"


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameDirection(FrameSeen):
    """A feature without parallax, in a known direction, at a pixel of a picture: the sun, a star, a far peak.

    The direction is the apparent one: where air bends light, as it is seen from the ground. Of the sun the
    pixel is the middle of its disc.
    """

    kind = "frame-direction"
    azimuth_rad: float
    """Anticlockwise from the world's x axis, seen from above."""
    elevation_rad: float
    """Positive upwards, from -pi / 2 to pi / 2."""
    sigma_rad: float = 0.0
    """Standard deviation of the direction along each axis across it; 0: pixels alone are uncertain."""

    def __post_init__(self) -> None:
        """Check numbers."""
        super().__post_init__()
        _number("azimuth_rad", self.azimuth_rad)
        if _number("sigma_rad", self.sigma_rad) < 0:
            raise InputError(f"sigma_rad: expected 0 (exact) or a positive number, found {self.sigma_rad}")
        if abs(_number("elevation_rad", self.elevation_rad)) > np.pi / 2:
            raise InputError(
                f"elevation_rad: expected a number from -pi / 2 to pi / 2, found {self.elevation_rad}"
            )

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector of the world."""
        a, e = self.azimuth_rad, self.elevation_rad
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


@dataclass(frozen=True, kw_only=True, eq=False)
class FramePoint(FrameSeen):
    """A point of known position at a pixel of a picture: a fiducial that one picture alone sees."""

    kind = "frame-point"
    position_m: Sequence[float]
    """(3,) coordinates in the world."""
    sigma_m: float
    """Standard deviation of each coordinate; 0: exact."""

    def __post_init__(self) -> None:
        """Check numbers."""
        super().__post_init__()
        if np.isnan(_three("position_m", self.position_m)).any():
            raise InputError(f"position_m: expected three numbers, found {list(self.position_m)}")
        if _number("sigma_m", self.sigma_m) < 0:
            raise InputError(f"sigma_m: expected 0 (exact) or a positive number, found {self.sigma_m}")

    @property
    def place_m(self) -> FloatArray:
        """(3,) coordinates in the world."""
        return _three("position_m", self.position_m)


CONSTRAINTS: tuple[type[Constraint], ...] = (
    LandmarkPosition,
    LandmarkHeight,
    LandmarkPlane,
    LandmarkAzimuth,
    LandmarkElevation,
    LandmarkInfinity,
    LandmarkSurface,
    LandmarkDistance,
    StopPosition,
    StopPlacement,
    StopPose,
    StopDistance,
    StopHeading,
    FrameDirection,
    FramePoint,
)
"""All kinds, in the order in which error messages name them."""


def _number(name: str, value: object) -> float:
    number = float_array(name, value)
    if number.ndim or not np.isfinite(number):
        raise InputError(f"{name}: expected a finite number, found {value}")
    if abs(number) > _LARGEST:
        raise InputError(f"{name}: expected a number of at most {_LARGEST:g}, found {value}")
    return float(number)


def _three(name: str, values: Sequence[float | None]) -> FloatArray:
    """(3,) numbers, NaN for None. Raises InputError for others."""
    if isinstance(values, str) or not hasattr(values, "__len__") or len(values) != 3:
        raise InputError(f"{name}: expected three numbers, found {values}")
    out = np.full(3, np.nan)
    for i, value in enumerate(values):
        if value is not None:
            out[i] = _number(f"{name}[{i}]", value)
    return out


def _two(names: Sequence[Landmark], expected: str) -> None:
    if isinstance(names, str) or len(names) != 2 or names[0] == names[1]:
        raise InputError(f"{expected}, found {names}")


def _covariance(name: str, values: object, n: int) -> FloatArray:
    matrix = float_array(name, values)
    if matrix.shape != (n, n):
        raise InputError(f"{name}: expected {n} x {n} numbers, found the shape {matrix.shape}")
    if not np.all(np.isfinite(matrix)):
        raise InputError(f"{name}: expected finite numbers, found NaN or infinity")
    with np.errstate(over="ignore"):  # what overflows fails the tests below
        largest = float(np.abs(np.diag(matrix)).max())
        if not np.abs(matrix - matrix.T).max() <= _ASYMMETRY * largest:
            raise InputError(f"{name}: expected a symmetric matrix, found one that is not")
        matrix = 0.5 * (matrix + matrix.T)
        scale = np.sqrt(np.diag(matrix).clip(1e-300))
        scaled = matrix / scale[:, None] / scale
        if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled)[0] < _FLATTEST:
            raise InputError(f"{name}: expected a positive definite matrix, found one that is not")
    return matrix
