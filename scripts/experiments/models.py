"""Options of each model in the experiments: the same observations, priors so wide that images decide."""

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
"""Flex of the models without a mast: rotations as loose as pan, centres so loose that telemetry hardly
constrains a circle of 0.14 m.

With 0.1 m or 1 m aligned errors are the same within a few percent; with 1 m the scale of several clusters,
which odometry alone determines, takes a hundred iterations to settle.
"""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A model, and the quantities of the rig that are free."""

    model: str
    sharing: str
    options: SolveOptions = field(hash=False)


def variant(model: Model, sharing: str) -> Variant:
    """The variant of a model with a way of sharing: "fixed", "shared" or "unshared"."""
    options = SolveOptions(
        model=model,
        rig="held",
        loss="none",
        flex=None if model in {"mast", "circle"} else FREE_FLEX,
        sharing=_sharing(model, sharing),
        # Far below a sigma, and the scale of a free model may take its time.
        relative_decrease=1e-6,
        max_iterations=200,
    )
    return Variant(model=model, sharing=sharing, options=options)


def _sharing(model: Model, name: str) -> Sharing | None:
    """Free quantities of the rig: shared by the whole traverse, or as little as the model allows."""
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
"""Variants for solvers that know the true rig. `circle` always estimates the radius of each eye, `projective`
the calibration of each image."""
RIG_OFF = tuple(variant(model, name) for model in _WITH_RIG for name in ("fixed", "shared", "unshared"))
"""Variants for solvers that are given a slightly wrong rig. `projective` is left out: its tie to the rig's
calibration is much wider than these errors."""


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
    """Raise SolveError for a solution that counts as failed."""
    if not solution.converged:
        raise SolveError(f"not converged: {solution.stop_reason}")
    lost = int((~solution.used).sum())
    if lost:
        raise SolveError(f"{lost} observations of lost landmarks")
