"""A caller's arrays become float64 and int64, and nothing of them is dropped."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph import Observations, SolveOptions, solve
from pancam_graph.base.arrays import float_array, int_array
from pancam_graph.base.errors import CameraError, InputError, PancamGraphError
from pancam_graph.cameras import decompose_projection
from pancam_graph.initialise import Start, extract_free, fit_circle
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import SimulationOptions, simulate
from support import io_samples

MASKED = np.ma.MaskedArray([1.0, 2.0], mask=[False, True])


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4", ">f4", ">i4", "<i2", ">u2", "f2", "g"])
def test_numbers_of_any_width_and_byte_order_are_float64(dtype: str) -> None:
    values = np.array([[1, 2], [3, 4]], dtype=dtype)
    for given in (values, np.asfortranarray(values), values[::1], values.tolist()):
        made = float_array("a", given)
        assert made.dtype == np.dtype(np.float64)
        assert made.dtype.isnative
        assert made.flags.c_contiguous
        np.testing.assert_array_equal(made, [[1, 2], [3, 4]])


def test_an_array_that_is_right_already_is_not_copied() -> None:
    floats, integers = np.zeros(3), np.zeros(3, dtype=np.int64)
    assert float_array("a", floats) is floats
    assert int_array("a", integers) is integers


@pytest.mark.parametrize(
    ("values", "found"),
    [
        (np.array([1 + 0j]), "complex128"),
        ([1.0, 2j], "complex128"),
        (MASKED, "1 masked entries"),
        (np.array(["1"]), "<U1"),
        (np.array([True]), "bool"),
        ([1.0, None], "object"),
        ([10**400], "object"),
        ([[1.0], [1.0, 2.0]], "list"),
        (np.array(["2000"], "M8[Y]"), "datetime64"),
    ],
)
def test_what_is_no_number_is_refused(values: Any, found: str) -> None:
    for turned in (float_array, int_array):
        with pytest.raises(CameraError, match=f"^a: expected (numbers|integers), found .*{found}"):
            turned("a", values, CameraError)


def test_integers_are_not_rounded_or_wrapped() -> None:
    np.testing.assert_array_equal(int_array("a", np.array([1, 2], ">i4")), [1, 2])
    assert len(int_array("a", [])) == 0
    with pytest.raises(InputError, match="a: expected integers, found float64"):
        int_array("a", [1.0])
    with pytest.raises(InputError, match=r"a: expected integers below 2\^63, found 9223372036854775808"):
        int_array("a", np.array([2**63], np.uint64))


def test_a_mask_that_hides_nothing_does_no_harm() -> None:
    np.testing.assert_array_equal(float_array("a", np.ma.MaskedArray([1.0, 2.0])), [1, 2])


def test_big_endian_observations_are_solved_to_the_same_bits() -> None:
    options = SimulationOptions(stops=1, pans=2, tilts_rad=(-0.2,), sweep_rad=0.8, points_per_image=12)
    traverse = simulate(mer_navcam(), options).traverse
    obs = traverse.observations
    assert obs is not None
    swapped = Observations(
        image=obs.image.astype(">i4"),
        track=obs.track.astype(">i8"),
        uv_px=np.asfortranarray(obs.uv_px.astype(">f8")),
        sigma_px=obs.sigma_px.astype(">f8"),
    )
    plain, other = (solve(replace(traverse, observations=each), SolveOptions()) for each in (obs, swapped))
    assert other.cost_history == plain.cost_history
    np.testing.assert_array_equal(other.final.pan_tilt_rad, plain.final.pan_tilt_rad)


@pytest.mark.parametrize("name", ["image", "track", "uv_px", "sigma_px", "covariance_px2"])
def test_columns_of_observations_are_refused_by_name(name: str) -> None:
    obs = io_samples.traverse().observations
    assert obs is not None
    obs = obs.with_covariance(io_samples.covariances(len(obs)))
    column = getattr(obs, name)
    hidden = np.ma.MaskedArray(column, mask=np.zeros(column.shape, bool))
    hidden[3] = np.ma.masked
    for other, found in ((column + 1j, "complex128"), (hidden, "masked entries"), (column.astype(str), "<U")):
        changes: dict[str, Any] = {name: other}
        with pytest.raises(InputError, match=f"^observations: {name}: expected .*{found}"):
            replace(obs, **changes)


COMPLEX: Any = np.zeros((4, 3, 4)) + 1j


@pytest.mark.parametrize(
    "use",
    [
        lambda: decompose_projection(COMPLEX[0]),
        lambda: extract_free(COMPLEX),
        lambda: fit_circle(COMPLEX[0]),
        lambda: Start(world_T_mast=(gtsam.Pose3(),), pan_tilt_rad=COMPLEX[0]),
        lambda: replace(io_samples.all_eyes()[2].camera, C=np.zeros(3) + 1j),  # type: ignore[call-arg]  # a CAHV
        lambda: replace(io_samples.traverse(), frames=(_turned(1j),)),
        lambda: replace(io_samples.traverse(), frames=(_turned("0.1"),)),
    ],
)
def test_every_door_of_the_api_refuses_imaginary_parts_and_texts(use: Callable[[], object]) -> None:
    with pytest.raises(PancamGraphError, match=r": expected numbers, found (complex128|<U3)"):
        use()


def _turned(pan: Any) -> Any:
    return replace(io_samples.traverse().frames[0], pan_rad=pan)
