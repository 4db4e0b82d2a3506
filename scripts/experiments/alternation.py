"""The joint solver against the thesis's own: regular and shared parameters in turn."""

from dataclasses import dataclass, fields, replace
from typing import Any

from experiments.models import variant
from experiments.running import Sample, attempt
from experiments.scenarios import Scenario
from pancam_graph import Solution, SolveOptions, Traverse, solve
from pancam_graph.errors import SolveError
from pancam_graph.graph import Model

__all__ = ["NAME", "AlternationTask", "can_alternate"]

NAME = "joint against alternation"
_MODELS: tuple[Model, ...] = ("mast", "circle", "free")


def can_alternate() -> bool:
    """Whether the package has the other solver."""
    return any(f.name == "method" for f in fields(SolveOptions))


@dataclass(frozen=True, kw_only=True)
class AlternationTask:
    """One seed of a scenario with shared parameters, with both solvers."""

    scenario: Scenario
    noise_px: float
    seed: int

    def run(self) -> list[Sample]:
        """Solve with each model and both methods."""
        traverse = self.scenario.simulate(self.noise_px, self.seed).traverse
        samples = []
        for model in _MODELS:
            options = variant(model, "shared").options
            # To the end: what is compared is how many steps lead there.
            joint = solve(traverse, replace(options, relative_decrease=1e-9))
            for method in ("joint", "alternation"):
                metrics, failure = attempt(
                    lambda m=method, j=joint, o=options: _measured(traverse, o, m, j)  # type: ignore[misc]  # bound now
                )
                samples.append(
                    Sample(
                        experiment=NAME,
                        model=f"{model}, {method}",
                        sharing="shared",
                        noise_px=self.noise_px,
                        seed=self.seed,
                        metrics=metrics,
                        failure=failure,
                    )
                )
        return samples


def _measured(traverse: Traverse, options: SolveOptions, method: str, best: Solution) -> dict[str, float]:
    by_method: dict[str, Any] = {"method": method}
    solution = solve(traverse, replace(options, **by_method))
    if not solution.converged:
        raise SolveError(f"not converged: {solution.stop_reason}")
    return {
        "iterations": float(solution.iterations),
        "cost_excess_relative": solution.cost_final / best.cost_final - 1,
    }
