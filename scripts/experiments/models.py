"""Models as the experiments solve them: same observations and telemetry, priors that let images decide."""

from dataclasses import dataclass, field

from experiments.errors import errors_of
from experiments.predicted import predicted_errors
from experiments.running import Sample, attempt
from experiments.scenarios import Scenario
from pancam_graph import Solution, SolveOptions
from pancam_graph.base.errors import SolveError
from pancam_graph.base.threads import blas_on_one_thread
from pancam_graph.data import Freedom, Sharing
from pancam_graph.graph import Flex, Model
from pancam_graph.simulate import Simulation
from pancam_graph.solve import fit, judge, prepare, screen, solution_of

__all__ = ["FREE_FLEX", "KNOWN_RIG", "RIG_OFF", "ClusterTask", "Variant", "variant"]

FREE_FLEX = Flex(rotation_rad=0.02, translation_m=0.3)
"""Of the models without a mast: rotations as loose as pan, centres so loose that telemetry says little of a
circle of 0.14 m. With 0.1 m or 1 m aligned errors are the same within a few percent; with 1 m the scale of
several clusters, which nothing but odometry tells, takes a hundred iterations."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A model, and what of the rig is free."""

    model: str
    sharing: str
    options: SolveOptions = field(hash=False)


def variant(model: Model, sharing: str) -> Variant:
    """A model as the experiments solve it."""
    options = SolveOptions(
        model=model,
        loss="none",
        flex=None if model in {"mast", "circle"} else FREE_FLEX,
        sharing=_sharing(model, sharing),
        # Far below a sigma, and the scale of a free model may take its time.
        relative_decrease=1e-6,
        max_iterations=200,
    )
    return Variant(model=model, sharing=sharing, options=options)


def _sharing(model: Model, name: str) -> Sharing | None:
    """What of the rig is free: shared by the whole traverse, or as little shared as the model can bear."""
    if name == "fixed" or model == "projective":
        return None
    shared = name == "shared"
    of_stop = Freedom(scope="eye" if shared else "stop")
    return Sharing(
        calibration=Freedom(scope="eye" if shared else "image", free=("focal",)),
        mounts=of_stop if model == "mast" else Freedom(),
        radius=of_stop if model == "circle" else None,
    )


_WITH_RIG: tuple[Model, ...] = ("mast", "circle", "free")
_PROJECTIVE = variant("projective", "unshared")
KNOWN_RIG = (*(variant(model, "fixed") for model in _WITH_RIG), _PROJECTIVE)
"""For the rig that the simulation had. `circle` finds the radius of each eye always, `projective` a
calibration of each image."""
RIG_OFF = tuple(variant(model, name) for model in _WITH_RIG for name in ("fixed", "shared", "unshared"))
"""For a rig that is not quite the true one. Not `projective`: its tie to the rig's calibration is wider than
these errors by far."""


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
            metrics, failure = attempt(lambda v=v: _measured(simulation, v.options, self.seed))  # type: ignore[misc]  # bound now
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


def _measured(simulation: Simulation, options: SolveOptions, seed: int) -> dict[str, float]:
    with blas_on_one_thread():  # as `solve`, of which this is the inside: its covariance is wanted whole
        judged = judge(fit(screen(prepare(simulation.traverse, options))))
        solution = solution_of(judged)
        _require_whole(solution)
        return errors_of(solution, simulation) | predicted_errors(judged, seed)


def _require_whole(solution: Solution) -> None:
    """Raise SolveError for what counts as failed."""
    if not solution.converged:
        raise SolveError(f"not converged: {solution.stop_reason}")
    lost = int((~solution.used).sum())
    if lost:
        raise SolveError(f"{lost} observations of lost landmarks")
