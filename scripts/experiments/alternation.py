"""The joint solver against that of the thesis, which solves regular and shared parameters in turn."""

from dataclasses import dataclass, replace

from experiments.models import variant
from experiments.running import Sample
from experiments.scenarios import Scenario
from pancam_graph import Traverse, solve
from pancam_graph.base.errors import PancamGraphError
from pancam_graph.graph import Model
from pancam_graph.solve._options import Method

__all__ = ["NAME", "STEPS", "AlternationTask"]

NAME = "joint against alternation"
STEPS = (3, 10, 30, 100)
"""Numbers of steps after which costs are compared.

No solve takes more than the last; one that has not converged by then does not count as failed.
"""
_MODELS: tuple[Model, ...] = ("mast", "circle", "free")
_METHODS: tuple[Method, ...] = ("joint", "alternation")


@dataclass(frozen=True, kw_only=True)
class AlternationTask:
    """One seed of a scenario with shared parameters, with both solvers."""

    scenario: Scenario
    noise_px: float
    seed: int

    def run(self) -> list[Sample]:
        """Solve with each model and both methods."""
        traverse = self.scenario.simulate(self.noise_px, self.seed).traverse
        return [sample for model in _MODELS for sample in self._samples(traverse, model)]

    def _samples(self, traverse: Traverse, model: Model) -> list[Sample]:
        options = replace(variant(model, "shared").options, relative_decrease=1e-9, max_iterations=max(STEPS))
        histories: dict[str, tuple[float, ...]] = {}
        failures = {}
        for method in _METHODS:
            try:
                histories[method] = solve(traverse, replace(options, method=method)).cost_history
            except PancamGraphError as error:
                failures[method] = str(error)
        best = min((h[-1] for h in histories.values()), default=1.0)
        return [
            Sample(
                experiment=NAME,
                model=f"{model}, {method}",
                sharing="shared",
                noise_px=self.noise_px,
                seed=self.seed,
                metrics=_metrics(histories[method], best) if method in histories else {},
                failure=failures.get(method, ""),
            )
            for method in _METHODS
        ]


def _metrics(history: tuple[float, ...], best: float) -> dict[str, float]:
    """Relative excess of the cost over the best of both solvers after each number of STEPS.

    A solver that has ended keeps its last cost.
    """
    excess = {f"excess_after_{n}_steps": history[min(n, len(history) - 1)] / best - 1 for n in STEPS}
    return {**excess, "iterations": float(len(history) - 1)}
