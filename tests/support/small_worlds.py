"""Small worlds, which are quick to render."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from pancam_graph.simulate import _scene


@contextmanager
def smaller_worlds() -> Iterator[None]:
    """Limit the ground and its rocks to a smaller area."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (
            ("_FINE_REACH_M", 6.0),
            ("_MID_STEP_M", 0.5),
            ("_MID_REACH_M", 25.0),
            ("_FAR_NODES", 128),
            ("_ROCK_REACH_M", 15.0),
        ):
            patch.setattr(_scene, name, value)
        yield
