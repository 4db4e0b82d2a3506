"""Small simulated drives that GTSAM's own optimisers solve in a second or two, and options for them."""

from dataclasses import replace
from functools import cache

import numpy as np

from pancam_graph import SimulationOptions, SolveOptions, Traverse, simulate
from pancam_graph.graph import Flex
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import Simulation

__all__ = ["HARD", "NEAR_M", "SMALL", "SOFT", "WAYS", "near_part", "simulated", "some_stops"]

SMALL = SimulationOptions(stops=2, pans=3, sweep_rad=1.5, points_per_image=15)
NEAR_M = 20.0
"""Landmarks farther away end at infinity where they are explicit variables."""
HARD = SolveOptions(rig="held", loss="none", relative_decrease=1e-12)
"""Every observation, to the end, with a hard tie and the rig as it is."""
SOFT = replace(HARD, tie="soft", flex=Flex(rotation_rad=1e-4, translation_m=1e-3))
WAYS = {
    "hard": HARD,
    "explicit": replace(HARD, landmarks="explicit"),
    "soft": SOFT,
    "circle": replace(HARD, model="circle"),
    "free": replace(HARD, model="free"),
    "estimated": replace(HARD, rig="estimated"),
}
"""Ways to solve that take what frames see."""


@cache
def simulated(seed: int, stops: int, points_per_image: int = SMALL.points_per_image) -> Simulation:
    """A small drive, made once."""
    options = replace(SMALL, stops=stops, points_per_image=points_per_image)
    return simulate(mer_navcam(), options, seed=seed)


def near_part(simulation: Simulation) -> Traverse:
    """The traverse with the observations of landmarks within `NEAR_M` of the world's origin alone."""
    t = simulation.traverse
    assert t.observations is not None
    distance = np.linalg.norm(simulation.truth.landmarks_m, axis=1)
    return t.with_observations(t.observations.select((distance < NEAR_M)[t.observations.track]))


def some_stops(drive: Traverse, which: slice) -> Traverse:
    """Some stops of a drive without constraints, with all that their images see, as a drive of their own."""
    ids = {stop.id for stop in drive.stops[which]}
    frames = tuple(frame for frame in drive.frames if frame.stop in ids)
    rows = np.flatnonzero(np.isin(drive.image_stop, np.arange(len(drive.stops))[which]))
    seen = drive.observations
    assert seen is not None
    seen = seen.select(np.isin(seen.image, rows))
    return replace(
        drive,
        stops=drive.stops[which],
        frames=frames,
        images=tuple(drive.images[row] for row in rows),
        observations=replace(seen, image=np.searchsorted(rows, seen.image)),
        constraints=(),
    )
