"""Simulated traverses whose rig is wrong, and freedoms that no prior holds."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from pancam_graph import (
    Freedom,
    SimulationOptions,
    simulate,
)
from pancam_graph.data import ENTRIES, Quantity
from pancam_graph.data._sharing import Scope
from pancam_graph.initialise import Start
from pancam_graph.rigs import mer_navcam
from pancam_graph.simulate import Simulation

FOCAL = ("focal",)
WRONG = {"focal_error": 3e-3, "mount_error_rad": 2e-3, "mount_error_m": 2e-3}
TWO_TILTS = SimulationOptions(stops=2, pans=4, sweep_rad=2.0, tilts_rad=(-0.1, -0.5), points_per_image=20)


def loose(quantity: Quantity, scope: Scope, *entries: str) -> Freedom:
    """Free, and held by no prior."""
    free = entries or ENTRIES[quantity]
    return Freedom(scope=scope, free=free, sigma=dict.fromkeys(free, np.inf))


def start_of(simulation: Simulation) -> Start:
    telemetry = simulation.telemetry_start
    return Start(world_T_mast=telemetry.world_T_mast, pan_tilt_rad=telemetry.pan_tilt_rad)


@cache
def simulated(seed: int = 2, **changes: Any) -> Simulation:
    return simulate(mer_navcam(), replace(TWO_TILTS, **changes), seed=seed)
