"""GTSAM factors of the caller, checked and expressed on the variables of a template.

The caller writes factors on masts, on pan and tilt of single frames, and on corrections of the rig
(`GraphKeys`). A template may have these in another form: fixed, where telemetry holds them, or as part of a
vector of all angles of a stop. A `Seat` reads one of the caller's variables from the template's.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.graph._graph_keys import GraphKeys
from pancam_graph.graph._keys import read_variable

__all__ = ["GivenFactor", "Seat", "UserFactors", "check_given", "given_factors", "seated"]

UserFactors = Sequence[gtsam.NonlinearFactor] | gtsam.NonlinearFactorGraph | gtsam.NonlinearFactor
"""Factors as a caller may pass them: a sequence, a graph, or one factor."""

_WORST = 1e30
"""Cost that stands for an error that is not finite, so that an optimiser rejects the step."""
_STEEPEST = 1e14
"""Largest whitened Jacobian: beyond it, rounding of a pose of some metres changes the cost."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seat:
    """How a variable of the caller depends on the variables of a template."""

    read: Callable[[gtsam.Values], Any]
    """Takes values of the template to the value of the variable: gtsam.Pose3, vector or number."""
    parts: tuple[tuple[int, FloatArray], ...]
    """Keys of the template, each with the Jacobian (dim, dim of the key) of the variable's tangent by that of
    the key; none where the variable is held."""

    @staticmethod
    def same(key: int, dim: int, held: IntArray | None = None) -> "Seat":
        """A variable that the template has in the same form; components in `held` do not move."""
        moves = np.eye(dim)
        if held is not None:
            moves[held, held] = 0.0
        return Seat(read=lambda values: read_variable(values, key), parts=((key, moves),))

    def on(self, name: Mapping[int, int]) -> "Seat":
        """The same on variables that another template has under other keys; `name` is by the key here."""
        keys = [key for key, _ in self.parts]

        def read(values: gtsam.Values) -> Any:
            here = gtsam.Values()
            for key in keys:
                here.insert(key, read_variable(values, name[key]))
            return self.read(here)

        return Seat(read=read, parts=tuple((name[key], moves) for key, moves in self.parts))

    @staticmethod
    def fixed(value: Any) -> "Seat":
        """A variable that nothing moves."""
        return Seat(read=lambda _values: value, parts=())


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenFactor:
    """A factor of the caller on keys of `GraphKeys`."""

    factor: gtsam.NonlinearFactor
    name: str
    """Its name in errors, with its variables."""
    constraint: int | None = None
    """Row of the traverse's constraint that it states; None for a factor of the caller's."""

    @property
    def keys(self) -> tuple[int, ...]:
        """The caller's keys."""
        return tuple(self.factor.keys())

    def cost(self, values: gtsam.Values) -> float:
        """Its cost at values of its variables; `_WORST` where that is not finite.

        Raises SolveError where the factor raises an exception.
        """
        try:
            cost = float(self.factor.error(values))
        except Exception as error:  # a caller's function may raise any
            raise SolveError(f"{self.name}: expected an error vector, found {_said(error)}") from error
        return cost if np.isfinite(cost) else _WORST

    def linear(self, values: gtsam.Values) -> tuple[list[int], FloatArray, FloatArray]:
        """Keys, whitened Jacobian (rows, columns) key after key, and whitened residual (rows,) at values.

        Raises SolveError where the factor raises an exception, or is not finite.
        """
        if isinstance(self.factor, gtsam.CustomFactor):  # its function may return another shape anywhere
            self.require_shapes(values)
        try:
            linear = self.factor.linearize(values)
            jacobian, minus_residual = linear.jacobian()
        except Exception as error:  # a caller's function may raise any
            raise SolveError(f"{self.name}: expected Jacobians, found {_said(error)}") from error
        if not (np.all(np.isfinite(jacobian)) and np.all(np.isfinite(minus_residual))):
            raise SolveError(f"{self.name}: expected finite residuals and Jacobians, found NaN or infinity")
        return list(linear.keys()), jacobian, -minus_residual

    def require_shapes(self, values: gtsam.Values) -> None:
        """Evaluate a factor with a noise model, whose residual and Jacobians must fit it and each other.

        GTSAM itself reads beyond the end of a Jacobian with too few rows. Raises SolveError for shapes that
        do not fit, and where the factor raises an exception.
        """
        assert isinstance(self.factor, gtsam.NoiseModelFactor)
        jacobians = gtsam.JacobianVector([np.zeros((0, 0))] * len(self.keys))
        try:
            rows = len(np.atleast_1d(self.factor.unwhitenedError(values, jacobians)))
        except Exception as error:  # a caller's function may raise any
            raise SolveError(f"{self.name}: expected an error vector, found {_said(error)}") from error
        noise = self.factor.noiseModel()
        if noise is not None and noise.dim() != rows:
            raise SolveError(
                f"{self.name}: expected a noise model of {rows} rows as its error vector has, "
                f"found {noise.dim()}"
            )
        for key, jacobian in zip(self.keys, jacobians, strict=True):
            if jacobian.shape != (rows, dim := _dim(values, key)):
                shown = gtsam.DefaultKeyFormatter(key)
                raise SolveError(
                    f"{self.name}: expected for {shown} a Jacobian of {rows} x {dim}, "
                    f"found {jacobian.shape[0]} x {jacobian.shape[1]}"
                )


def given_factors(factors: UserFactors | None, keys: GraphKeys) -> tuple[GivenFactor, ...]:
    """The caller's factors with their names. Raises InputError for one that is no factor on these keys."""
    if factors is None:
        return ()
    if isinstance(factors, gtsam.NonlinearFactorGraph):
        factors = [factors.at(i) for i in range(factors.size())]
    elif isinstance(factors, gtsam.NonlinearFactor):
        factors = [factors]
    if not isinstance(factors, Iterable):
        raise InputError(f"factors: expected GTSAM factors in a sequence or a graph, found {_kind(factors)}")
    out = []
    for i, factor in enumerate(factors):
        if not isinstance(factor, gtsam.NonlinearFactor):
            raise InputError(f"factors: factor {i}: expected a GTSAM factor, found {_kind(factor)}")
        where = f"factors: factor {i} ({_kind(factor)})"
        if not factor.keys():
            raise InputError(f"{where}: expected a factor on one variable or more, found it on none")
        names = [keys.name(key, where) for key in factor.keys()]  # noqa: SIM118  a gtsam factor
        name = f"factors: factor {i} ({_kind(factor)} on {', '.join(names)})"
        if len(set(factor.keys())) < len(names):
            raise InputError(f"{name}: expected each variable once, found one twice")
        noise = factor.noiseModel() if hasattr(factor, "noiseModel") else None
        if isinstance(noise, gtsam.noiseModel.Robust):
            noise = noise.noise()
        if noise is not None and noise.isConstrained():
            raise InputError(
                f"{name}: expected sigmas above 0, found a constraint; a sigma far below the others' does it"
            )
        out.append(GivenFactor(factor=factor, name=name))
    return tuple(out)


def check_given(given: Iterable[GivenFactor], seats: Mapping[int, Seat], values: gtsam.Values) -> None:
    """Evaluate factors once at values of a template, before GTSAM does it unguarded.

    Raises InputError naming the factor for one that cannot move anything, raises an exception, is not finite,
    has a noise model or a Jacobian of another size than its residual and its variables, or sigmas so small
    that rounding alone is many of them.
    """
    for one in given:
        if not any(seats[key].parts for key in one.keys):
            raise InputError(
                f"{one.name}: expected a variable that is free, found only such as telemetry holds (sigma 0)"
            )
        _check(one, _own_values(one, seats, values))


def _check(one: GivenFactor, values: gtsam.Values) -> None:
    try:
        if isinstance(one.factor, gtsam.NoiseModelFactor):
            one.require_shapes(values)
        if one.cost(values) >= _WORST:
            found = one.factor.error(values)
            raise InputError(f"{one.name}: expected a finite error at the start, found {found}")
        _, jacobian, _ = one.linear(values)
    except SolveError as error:
        raise InputError(str(error)) from error
    steepest = float(np.abs(jacobian).max(initial=0.0))
    if steepest > _STEEPEST:
        raise InputError(
            f"{one.name}: expected at most {_STEEPEST:.0e} sigmas per radian or metre, as 64 bits "
            f"resolve, found {steepest:.1e}"
        )


def seated(given: GivenFactor, seats: Mapping[int, Seat]) -> gtsam.CustomFactor | None:
    """The factor on a template's variables; None where all variables of it are held.

    Its cost and its linearisation are those of the caller's factor, under any noise model.
    """
    moving = [key for key in given.keys if seats[key].parts]
    template_keys = list(dict.fromkeys(k for key in moving for k, _ in seats[key].parts))
    if not template_keys:
        return None
    place = {key: i for i, key in enumerate(template_keys)}

    def evaluate(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        local = _own_values(given, seats, values)
        if jacobians is None:
            return np.array([np.sqrt(2 * given.cost(local))])
        keys, whole, residual = given.linear(local)
        blocks: list[FloatArray | None] = [None] * len(template_keys)
        begin = 0
        for key in keys:
            width = _dim(local, key)
            for k, moves in seats[key].parts:
                part = whole[:, begin : begin + width] @ moves
                before = blocks[place[k]]
                blocks[place[k]] = part if before is None else before + part
            begin += width
        for i, block in enumerate(blocks):
            assert block is not None
            jacobians[i] = np.asfortranarray(block)
        return residual

    # No noise model: the rows are whitened already.
    no_noise: Any = None
    return gtsam.CustomFactor(no_noise, template_keys, evaluate)


def _own_values(one: GivenFactor, seats: Mapping[int, Seat], values: gtsam.Values) -> gtsam.Values:
    """The caller's variables of one factor, from values of a template."""
    out = gtsam.Values()
    for key in one.keys:
        out.insert(key, seats[key].read(values))
    return out


def _dim(values: gtsam.Values, key: int) -> int:
    value = read_variable(values, key)
    return 6 if isinstance(value, gtsam.Pose3) else int(np.size(value))


def _kind(thing: object) -> str:
    return type(thing).__name__


def _said(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{_kind(error)}: {text[:200]}" if text else _kind(error)
