"""Free calibrations as variables of GTSAM's type Cal3_S2, letter `C`, for its projection factors.

A variable `K` of free entries becomes one `C` for each eye that shares it. A factor carries the prior of `K`
over and constrains the changes of `C` that `K` cannot make.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.graph._given import Seat
from pancam_graph.graph._keys import Kind, key_of
from pancam_graph.graph._rig_variables import RigVariable, RigVariables

__all__ = ["NativeCalibrations"]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Native:
    """The variables `C` that replace one variable `K` of n entries."""

    variable: RigVariable
    """The variable `K` that is replaced."""
    keys: tuple[int, ...]
    """Key of each `C`."""
    nominal: FloatArray
    """(5 keys,) nominal fx, fy, skew, cx and cy of each"""
    along: FloatArray
    """(n, 5 keys) takes changes of the numbers of `C` to `K`"""
    across: FloatArray
    """(5 keys - n, 5 keys) takes changes of the numbers of `C` to the part that `K` cannot make"""
    basis: FloatArray
    """(5 keys, n) takes `K` to changes of the numbers of `C`"""


class NativeCalibrations:
    """The `C` variables of a rig's free calibrations; none where they are fixed."""

    def __init__(self, rig: RigVariables) -> None:
        self._native: list[_Native] = []
        variables, eyes = rig.of["calibration"], rig.traverse.image_eye
        self._key_of_image = np.zeros(len(eyes), dtype=np.uint64)
        self.any = bool(variables)
        number = 0
        for i, v in enumerate(variables):
            of_variable = rig.place("calibration") == i
            keys, nominal, basis = [], [], []
            for eye in np.unique(eyes[of_variable]):
                images = of_variable & (eyes == eye)
                keys.append(key_of(Kind.NATIVE_CALIBRATION, number))
                number += 1
                self._key_of_image[images] = keys[-1]
                basis.append(rig.basis("calibration")[np.argmax(images)])
                pinhole = rig.traverse.rig.pinholes[int(eye)]
                nominal.append(gtsam.Cal3_S2(*_numbers(pinhole.calibration_matrix)).vector())
            stacked = np.vstack(basis)
            self._native.append(
                _Native(
                    variable=v,
                    keys=tuple(keys),
                    nominal=np.concatenate(nominal),
                    along=np.linalg.pinv(stacked),
                    across=scipy.linalg.null_space(stacked.T).T,
                    basis=stacked,
                )
            )

    def key(self, image: int) -> int:
        """Key of an image's calibration."""
        return int(self._key_of_image[image])

    def in_place(self, factors: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
        """A template's factors, with those on `K` replaced by equivalent ones on `C`."""
        if not self.any:
            return gtsam.NonlinearFactorGraph(factors)
        known = {n.variable.key: n for n in self._native}
        graph, joint = gtsam.NonlinearFactorGraph(), set[int]()
        for i in range(factors.size()):
            factor = factors.at(i)
            keys = list(factor.keys())
            if known.keys().isdisjoint(keys):
                graph.push_back(factor)
            elif len(keys) > 1:  # a prior of several variables of the rig
                assert isinstance(factor, gtsam.NoiseModelFactor)
                graph.push_back(_through(factor, keys, known))
                joint.update(known.keys() & set(keys))
        for n in self._native:
            held = _hold(n, has_prior=n.variable.key not in joint)
            if held is not None:
                graph.push_back(held)
        return graph

    def seats(self, seats: Mapping[int, Seat]) -> dict[int, Seat]:
        """Seats of the variables of given factors, with each `K` read from its `C`."""
        return {**seats, **{n.variable.key: _seat(n) for n in self._native if n.variable.key in seats}}

    def values_of(self, cameras: gtsam.Values) -> gtsam.Values:
        """A template's values, `K` replaced by `C`."""
        values = gtsam.Values(cameras)
        for n in self._native:
            _insert(n, values)
            values.erase(n.variable.key)
        return values

    def join(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Add each `C` to a graph and values that have `K`, constrained to the calibration that `K` gives."""
        for n in self._native:
            _insert(n, values)
            graph.push_back(_link(n))

    def free_entries(self, values: gtsam.Values) -> dict[int, FloatArray]:
        """Value (n,) of each `K` by its key, from values that have `C`."""
        return {n.variable.key: _entries(n, values) for n in self._native}

    def held(self, held: Mapping[int, IntArray]) -> dict[int, IntArray]:
        """By key, tangent components that are held: those given, and those of `C` that no entry of `K` moves.

        A factor on both focal lengths moves two components along one line: neither counts as held.
        """
        out = dict(held)
        for n in self._native:
            still = ~np.any(n.basis != 0, axis=1)
            for key, is_held in zip(n.keys, still.reshape(-1, 5), strict=True):
                out[key] = np.flatnonzero(is_held)
        return out

    def step(self, step: gtsam.VectorValues) -> gtsam.VectorValues:
        """A step that has `C`, with the corresponding step of each `K` added."""
        out = gtsam.VectorValues(step)
        for n in self._native:
            out.insert(n.variable.key, n.along @ np.concatenate([step.at(key) for key in n.keys]))
        return out


def _insert(native: _Native, values: gtsam.Values) -> None:
    """Add each `C` for the values of `K`."""
    numbers = native.nominal + native.basis @ values.atVector(native.variable.key)
    for key, entries in zip(native.keys, numbers.reshape(-1, 5), strict=True):
        values.insert(key, gtsam.Cal3_S2(*entries))


def _link(native: _Native) -> gtsam.CustomFactor:
    """The constraint that each `C` is the nominal calibration corrected by `K`."""
    n = len(native.nominal)
    columns = [np.asfortranarray(part) for part in (-native.basis, *np.split(np.eye(n), len(native.keys), 1))]

    def evaluate(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        numbers = np.concatenate([values.atCal3_S2(key).vector() for key in native.keys])
        if jacobians is not None:
            for i, column in enumerate(columns):
                jacobians[i] = column
        return np.asarray(numbers - native.nominal - native.basis @ values.atVector(native.variable.key))

    noise = gtsam.noiseModel.Constrained.All(n)
    return gtsam.CustomFactor(noise, [native.variable.key, *native.keys], evaluate)


def _entries(native: _Native, values: gtsam.Values) -> FloatArray:
    """Value (n,) of `K` from values that have `C`."""
    numbers = np.concatenate([values.atCal3_S2(key).vector() for key in native.keys])
    return np.asarray(native.along @ (numbers - native.nominal))


def _seat(native: _Native) -> Seat:
    parts = [(key, native.along[:, 5 * i : 5 * i + 5]) for i, key in enumerate(native.keys)]
    return Seat(read=lambda values: _entries(native, values), parts=tuple(parts))


def _numbers(calibration: FloatArray) -> tuple[float, float, float, float, float]:
    k = calibration
    return float(k[0, 0]), float(k[1, 1]), float(k[0, 1]), float(k[0, 2]), float(k[1, 2])


def _through(
    factor: gtsam.NoiseModelFactor, keys: Sequence[int], natives: Mapping[int, _Native]
) -> gtsam.CustomFactor:
    """A factor with unit noise on several vectors, with each `K` among them read from its `C`."""
    of_key = [natives[key].keys if key in natives else (key,) for key in keys]

    def evaluate(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        local = gtsam.Values()
        for key in keys:
            local.insert(key, _entries(natives[key], values) if key in natives else values.atVector(key))
        if jacobians is not None:
            whole = factor.linearize(local).jacobian()[0]
            widths = [len(local.atVector(key)) for key in keys]
            blocks = []
            for key, block in zip(keys, np.split(whole, np.cumsum(widths)[:-1], axis=1), strict=True):
                if key in natives:
                    moved = block @ natives[key].along
                    blocks += np.split(moved, len(natives[key].keys), axis=1)
                else:
                    blocks.append(block)
            for i, block in enumerate(blocks):
                jacobians[i] = np.asfortranarray(block)
        return np.asarray(factor.unwhitenedError(local))

    noise = gtsam.noiseModel.Unit.Create(factor.noiseModel().dim())
    return gtsam.CustomFactor(noise, [key for own in of_key for key in own], evaluate)


def _hold(native: _Native, *, has_prior: bool) -> gtsam.CustomFactor | None:
    """The prior of `K`, expressed on `C`, if it has one, and a constraint on changes that `K` cannot make.

    None without either.
    """
    own = slice(None) if has_prior else slice(0)
    rows = np.vstack([native.along[own], native.across])
    if not len(rows):
        return None
    sigmas = np.concatenate([native.variable.sigma[own], np.zeros(len(native.across))])
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    if len(native.across):
        noise = gtsam.noiseModel.Constrained.MixedSigmas(np.full(len(sigmas), 1e3), sigmas)
    columns = [np.asfortranarray(rows[:, 5 * i : 5 * i + 5]) for i in range(len(native.keys))]

    def evaluate(
        _this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        numbers = np.concatenate([values.atCal3_S2(key).vector() for key in native.keys])
        if jacobians is not None:
            for i, column in enumerate(columns):
                jacobians[i] = column
        return np.asarray(rows @ (numbers - native.nominal))

    return gtsam.CustomFactor(noise, list(native.keys), evaluate)
