"""What of a rig is free: choices, their words and defaults, and what is refused."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pancam_graph import (
    Freedom,
    Sharing,
    SolveOptions,
    solve,
)
from pancam_graph.base.errors import InputError
from pancam_graph.data import ENTRIES, Quantity, default_sigma
from pancam_graph.data._sharing import parse_sharing
from pancam_graph.graph import Model
from support.shared_rigs import FOCAL, simulated

WITHOUT: list[tuple[Quantity, Model]] = [
    ("radius", "mast"),
    ("radius", "free"),
    ("mounts", "free"),
    ("mounts", "circle"),
    ("pan_T_tilt", "free"),
    ("pan_T_tilt", "circle"),
]
"""Quantities that a model does not have."""


def shared_by_stop(quantity: Quantity, model: Model) -> SolveOptions:
    sharing: dict[str, Any] = {quantity: Freedom(scope="stop")}
    return SolveOptions(model=model, sharing=Sharing(**sharing))


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "scope": (lambda: Sharing(calibration=Freedom(scope="each")), r"calibration: scope: .*found 'each'"),  # type: ignore[arg-type]  # the mistake under test
    "mounts all": (
        lambda: Sharing(mounts=Freedom(scope="all")),
        r"mounts: scope: .*each eye has its own mount",
    ),
    "axis per eye": (lambda: Sharing(pan_T_tilt=Freedom(scope="eye")), r"pan_T_tilt: scope: .*one tilt axis"),
    "fixed and free": (
        lambda: Sharing(calibration=Freedom(free=("fx_px",))),
        r"calibration: expected a scope other than fixed .*found fixed with fx_px",
    ),
    "fixed with a sigma": (
        lambda: Sharing(radius=Freedom(sigma={"radius_m": 1.0})),
        r"found fixed with radius_m",
    ),
    "unknown entry": (
        lambda: Sharing(calibration=Freedom(scope="eye", free=("fx",))),
        r"calibration: free: expected entries of focal, aspect, fx_px, .*, cy_px; found 'fx'",
    ),
    "entry of another": (lambda: Sharing(mounts=Freedom(scope="eye", free=("focal",))), r"found 'focal'"),
    "entry twice": (lambda: Sharing(mounts=Freedom(scope="eye", free=("x_m", "x_m"))), r"found x_m twice"),
    "no entry": (
        lambda: Sharing(mounts=Freedom(scope="eye", free=())),
        r"expected one entry or more, found none",
    ),
    "focal twice": (
        lambda: Sharing(calibration=Freedom(scope="all", free=("fy_px", "focal"))),
        r"either focal or fx_px and fy_px, found both",
    ),
    "aspect twice": (
        lambda: Sharing(calibration=Freedom(scope="all", free=("fy_px", "aspect"))),
        r"either aspect or fx_px and fy_px, found both",
    ),
    "sigma of what is held": (
        lambda: Sharing(mounts=Freedom(scope="eye", free=("x_m",), sigma={"y_m": 1.0})),
        r"sigma: expected free entries \(x_m\), found y_m, which is held",
    ),
    "unknown sigma": (lambda: Sharing(mounts=Freedom(scope="eye", sigma={"y": 1.0})), r"sigma: .*found 'y'"),
    "sigma 0": (
        lambda: Sharing(mounts=Freedom(scope="eye", sigma={"y_m": 0.0})),
        r"y_m: expected a number above 0, found 0.0",
    ),
    "sigma not a number": (lambda: Sharing(mounts=Freedom(scope="eye", sigma={"y_m": np.nan})), r"found nan"),
    **{
        f"{quantity} with {model}": (
            partial(shared_by_stop, quantity, model),
            rf"sharing: {quantity}: expected fixed with the model {model}, whose .*; found stop",
        )
        for quantity, model in WITHOUT
    },
    "word": (lambda: parse_sharing(["calibration"]), r"expected QUANTITY=SCOPE .*found 'calibration'"),
    "unknown quantity": (
        lambda: parse_sharing(["focal=eye"]),
        r"one of calibration, mounts, .*found 'focal=eye'",
    ),
    "quantity twice": (lambda: parse_sharing(["mounts=eye", "mounts=stop"]), r"found mounts twice"),
    "scope of a word": (
        lambda: parse_sharing(["mounts=eyes"]),
        r"mounts=eyes: expected one of .*found 'eyes'",
    ),
    "number of a word": (lambda: parse_sharing(["mounts=eye:x_m~wide"]), r"after x_m~, found 'wide'"),
    "nothing after the colon": (lambda: parse_sharing(["mounts=eye:"]), r"found ''"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_means_nothing_is_refused_in_one_sentence(case: str) -> None:
    make, text = REFUSED[case]
    with pytest.raises(InputError, match=text) as caught:
        make()
    assert str(caught.value).startswith("sharing: ")
    assert "\n" not in str(caught.value)


def test_words_of_a_command_line() -> None:
    found = parse_sharing(["calibration=eye:cx_px,fx_px~2.5", "mounts=stop", "radius=fixed"])
    assert found == Sharing(
        calibration=Freedom(scope="eye", free=("cx_px", "fx_px"), sigma={"fx_px": 2.5}),
        mounts=Freedom(scope="stop"),
        radius=Freedom(),
    )
    assert parse_sharing([]) is None
    assert parse_sharing([], found) == found
    again = parse_sharing(["mounts=eye:x_m~inf"], found)
    assert again == replace(found, mounts=Freedom(scope="eye", free=("x_m",), sigma={"x_m": np.inf}))


def freedoms(quantity: Quantity) -> st.SearchStrategy[Freedom]:
    entries = st.lists(st.sampled_from(ENTRIES[quantity]), min_size=1, unique=True)
    number = st.floats(1e-300, 1e300) | st.just(np.inf)
    return entries.flatmap(
        lambda free: st.dictionaries(st.sampled_from(free), number).map(
            lambda sigma: Freedom(scope="stop", free=tuple(free), sigma=sigma)
        )
    )


@settings(max_examples=50, derandomize=True, database=None, deadline=None)
@given(freedoms("mounts"))
def test_any_freedom_can_be_said_in_a_word(freedom: Freedom) -> None:
    assert freedom.free is not None
    names = [f"{e}~{freedom.sigma[e]!r}" if e in freedom.sigma else e for e in freedom.free]
    assert parse_sharing([f"mounts=stop:{','.join(names)}"]) == Sharing(mounts=freedom)


def test_each_model_has_its_own_default() -> None:
    assert not Sharing().for_model("mast").any_free
    assert not Sharing().for_model("free").any_free
    assert Sharing().for_model("circle").radius == Freedom(scope="eye")
    assert not Sharing(radius=Freedom()).for_model("circle").any_free


def test_options_go_before_the_traverse_and_the_traverse_before_the_default() -> None:
    t = replace(simulated().traverse, sharing=Sharing(mounts=Freedom(scope="eye", free=("x_m",))))
    assert {r.quantity for r in solve(t).refined} == {"mounts"}
    other = Sharing(calibration=Freedom(scope="all", free=FOCAL))
    assert {r.quantity for r in solve(t, SolveOptions(sharing=other)).refined} == {"calibration"}
    assert solve(t, SolveOptions(sharing=Sharing())).refined == ()
    with pytest.raises(InputError, match="mounts: expected fixed with the model free"):
        solve(t, SolveOptions(model="free"))


def test_priors_are_those_given_or_the_default() -> None:
    calibration = Freedom(
        scope="eye", free=("fx_px", "fy_px", "skew_px"), sigma={"fy_px": 0.5, "skew_px": np.inf}
    )
    found = solve(
        simulated().traverse, SolveOptions(loss="none", sharing=Sharing(calibration=calibration))
    ).refined
    focal = simulated().traverse.rig.pinholes[0].fx_px
    assert [r.entry for r in found] == 2 * ["fx_px", "fy_px", "skew_px"]
    assert [r.camera for r in found] == 3 * ["left"] + 3 * ["right"]
    assert [r.prior_sigma for r in found[:3]] == [default_sigma("fx_px", focal), 0.5, np.inf]
    assert found[0].prior_sigma == pytest.approx(3e-3 * focal)
    for r in found:
        assert r.sigma < r.prior_sigma
