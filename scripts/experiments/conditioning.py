"""Projection matrices with and without conditioning (thesis 5.2), by how far away the world's origin is."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from experiments.models import variant
from experiments.running import Sample, attempt
from experiments.scenarios import Scenario
from pancam_graph import Traverse, solve
from pancam_graph.base.errors import SolveError

__all__ = ["ORIGINS_M", "ConditioningTask", "name_of"]

ORIGINS_M = (0.0, 30.0, 100.0, 300.0, 1000.0)
_AWAY = np.array([0.6, -0.8, 0.0])


def name_of(origin_m: float) -> str:
    """Name of the experiment with the world's origin this far away."""
    return f"conditioning, origin {origin_m:g} m away"


@dataclass(frozen=True, kw_only=True)
class ConditioningTask:
    """One seed of a cluster with the origin at every distance, which does not change the optimum."""

    scenario: Scenario
    noise_px: float
    seed: int

    def run(self) -> list[Sample]:
        """Solve with and without conditioning at each distance."""
        traverse = self.scenario.simulate(self.noise_px, self.seed).traverse
        return [
            self._sample(_elsewhere(traverse, origin_m), origin_m, normalise=normalise)
            for origin_m in ORIGINS_M
            for normalise in (True, False)
        ]

    def _sample(self, traverse: Traverse, origin_m: float, *, normalise: bool) -> Sample:
        options = replace(variant("projective", "unshared").options, normalise=normalise, max_iterations=100)

        def measure() -> dict[str, float]:
            solution = solve(traverse, options)
            if not solution.converged:
                raise SolveError(f"not converged: {solution.stop_reason}")
            return {"iterations": float(solution.iterations), "cost": solution.cost_final}

        metrics, failure = attempt(measure)
        return Sample(
            experiment=name_of(origin_m),
            model="projective" if normalise else "projective, as it is",
            sharing="unshared",
            noise_px=self.noise_px,
            seed=self.seed,
            metrics=metrics,
            failure=failure,
        )


def _elsewhere(traverse: Traverse, origin_m: float) -> Traverse:
    """The traverse, shifted by this distance from the world's origin."""
    shift = origin_m * _AWAY
    stops = tuple(
        replace(
            s,
            world_T_mast=gtsam.Pose3(s.world_T_mast.rotation(), s.world_T_mast.translation() + shift),
        )
        for s in traverse.stops
    )
    return replace(traverse, stops=stops)
