"""Models as the experiments solve them: same observations and telemetry, priors that let images decide."""

from dataclasses import dataclass, field

from experiments.errors import errors_of
from experiments.running import Sample, attempt
from experiments.scenarios import Scenario
from pancam_graph import Solution, SolveOptions, solve
from pancam_graph.errors import SolveError
from pancam_graph.graph import Flex
from pancam_graph.simulate import Simulation

__all__ = ["FREE_FLEX", "FULL_RIG", "ClusterTask", "Variant"]

FREE_FLEX = Flex(rotation_rad=0.02, translation_m=1.0)
"""Of the models without a mast: rotations as loose as pan, centres so loose that telemetry says nothing of a
circle of 0.14 m."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A model, and what of the rig is free."""

    model: str
    sharing: str
    options: SolveOptions = field(hash=False)


FULL_RIG = (
    Variant(model="mast", sharing="fixed", options=SolveOptions(model="mast", loss="none")),
    Variant(model="circle", sharing="radius per eye", options=SolveOptions(model="circle", loss="none")),
    Variant(model="free", sharing="fixed", options=SolveOptions(model="free", loss="none", flex=FREE_FLEX)),
)
"""With the rig that the simulation had."""


@dataclass(frozen=True, kw_only=True)
class ClusterTask:
    """One seed of a scenario at one noise, solved with every variant."""

    scenario: Scenario
    noise_px: float
    seed: int
    variants: tuple[Variant, ...]

    def run(self) -> list[Sample]:
        """Simulate once, solve with each."""
        simulation = self.scenario.simulate(self.noise_px, self.seed)
        samples = []
        for v in self.variants:
            metrics, failure = attempt(lambda v=v: _measured(simulation, v.options))  # type: ignore[misc]  # bound now
            samples.append(
                Sample(
                    experiment=self.scenario.name,
                    model=v.model,
                    sharing=v.sharing,
                    noise_px=self.noise_px,
                    seed=self.seed,
                    metrics=metrics,
                    failure=failure,
                )
            )
        return samples


def _measured(simulation: Simulation, options: SolveOptions) -> dict[str, float]:
    solution = solve(simulation.traverse, options)
    _require_whole(solution)
    return errors_of(solution, simulation)


def _require_whole(solution: Solution) -> None:
    """Raise SolveError for what counts as failed."""
    if not solution.converged:
        raise SolveError(f"not converged: {solution.stop_reason}")
    lost = int((~solution.used).sum())
    if lost:
        raise SolveError(f"{lost} observations of lost landmarks")
