"""Options are of their kind, or refused in a sentence."""

from collections.abc import Callable
from typing import Any

import pytest

from pancam_graph import SimulationOptions, SmootherOptions, SolveOptions, TraverseSmoother, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.options import options_of
from pancam_graph.images import find_observations
from pancam_graph.rigs import mer_navcam
from pancam_graph.solve import build_graph
from support import io_samples

CALLS: dict[str, tuple[Callable[[Any], object], str]] = {
    "solve": (lambda given: solve(io_samples.traverse(), given), "SolveOptions"),
    "build_graph": (lambda given: build_graph(io_samples.traverse(), given), "SolveOptions"),
    "simulate": (lambda given: simulate(mer_navcam(), given), "SimulationOptions"),
    "find_observations": (lambda given: find_observations(io_samples.traverse(), given), "FrontEndOptions"),
    "TraverseSmoother": (lambda given: TraverseSmoother(mer_navcam(), given), "SmootherOptions"),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_dictionary_is_refused_with_what_makes_options_of_it(name: str) -> None:
    call, kind = CALLS[name]
    with pytest.raises(InputError) as refused:
        call({"loss": "none"})
    assert str(refused.value) == (
        f"{name}: options: expected {kind}(...), found a dict; {kind}(**options) makes them of it"
    )
    with pytest.raises(InputError, match=rf"expected {kind}\(\.\.\.\), found a str$"):
        call("none")


def test_none_gives_the_usual_ones_and_others_are_kept() -> None:
    assert options_of(SolveOptions, None, "solve") == SolveOptions()
    options = SimulationOptions(stops=3)
    assert options_of(SimulationOptions, options, "simulate") is options
    assert options_of(SmootherOptions, None, "smoother") == SmootherOptions()
