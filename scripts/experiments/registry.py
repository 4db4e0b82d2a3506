"""The experiments, their sizes, and those that cannot be run here."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from experiments import opportunity, validation
from experiments.alternation import AlternationTask
from experiments.conditioning import ConditioningTask
from experiments.models import KNOWN_RIG, RIG_OFF, ClusterTask, Variant
from experiments.running import Task
from experiments.scenarios import NOISES_PX, Eyes, Scenario

__all__ = ["CLUSTERS", "FAMILIES", "PANORAMAS", "TRAVERSES", "Plan", "plan"]

CLUSTERS = (
    Scenario(name="one cluster, one eye", eyes="one eye"),
    Scenario(name="one cluster, both eyes", eyes="both eyes"),
    Scenario(name="three clusters, one eye", eyes="one eye", stops=3),
    Scenario(name="three clusters, both eyes", eyes="both eyes", stops=3),
)
DENSE = Scenario(name="one cluster, one eye, 150 points per image", eyes="one eye", points_per_image=150)
"""The first cluster with six times as many tracks, which shows how much models still differ."""
RIG_OFF_CLUSTERS = tuple(replace(c, name=f"{c.name}, rig not quite known", rig_off=True) for c in CLUSTERS)
_PANORAMAS: tuple[tuple[Eyes, int], ...] = (
    ("both eyes", 5),
    ("both eyes", 10),
    ("both eyes", 20),
    ("one eye", 10),
)
PANORAMAS = tuple(
    Scenario(
        name=f"two panoramas {spacing_m} m apart, {eyes}",
        eyes=eyes,
        stops=2,
        images=36 if eyes == "both eyes" else 18,
        spacing_m=spacing_m,
        points_per_image=150,
        reach_m=100.0,
    )
    for eyes, spacing_m in _PANORAMAS
)
TRAVERSES = (
    Scenario(
        name="traverse of ten stops, both eyes",
        eyes="both eyes",
        stops=10,
        points_per_image=60,
        reach_m=100.0,
    ),
    Scenario(
        name="traverse of ten stops, one eye", eyes="one eye", stops=10, points_per_image=60, reach_m=100.0
    ),
)
_MIDDLE_PX = (0.5,)
FAMILIES = ("validation", "clusters", "alternation", "conditioning", "localisation", "opportunity")


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Tasks to run, and a sentence for each experiment that is left out."""

    tasks: tuple[Task, ...]
    left_out: tuple[str, ...]


def plan(*, seeds: int, quick: bool, families: Sequence[str] = FAMILIES) -> Plan:
    """The tasks of some families of experiments, each over this number of seeds."""
    tasks: list[Task] = []
    left_out: list[str] = []
    few = min(seeds, max(2, seeds // 5))
    """Of what tells the same with every seed, or takes long for a look."""
    if "validation" in families:
        tasks += [validation.ValidationTask(noise_px=0.5, seed=seed) for seed in range(min(seeds, 10))]
    if "clusters" in families:
        for scenario in CLUSTERS:
            noises = (0.5, 2.0) if quick else NOISES_PX if scenario.stops == 1 else (0.1, 0.5, 1.0, 2.0)
            tasks += _over_seeds([scenario], noises, seeds, KNOWN_RIG)
        tasks += _over_seeds([DENSE], _MIDDLE_PX, seeds, KNOWN_RIG)
        tasks += _over_seeds(RIG_OFF_CLUSTERS, _MIDDLE_PX, seeds, RIG_OFF)
    if "alternation" in families:
        tasks += [
            AlternationTask(scenario=RIG_OFF_CLUSTERS[-1], noise_px=0.5, seed=seed) for seed in range(few)
        ]
    if "conditioning" in families:
        tasks += [ConditioningTask(scenario=CLUSTERS[1], noise_px=0.5, seed=seed) for seed in range(few)]
    if "localisation" in families:
        tasks += _over_seeds(PANORAMAS, _MIDDLE_PX, seeds, KNOWN_RIG)
        tasks += _over_seeds(TRAVERSES, _MIDDLE_PX, few if quick else seeds, KNOWN_RIG)
    if "opportunity" in families:
        folder = opportunity.opportunity_folder()
        if folder is None:
            left_out.append(
                f"{opportunity.NAME}: its images are not part of the repository and were not found in "
                "../shared or in the folder that PANCAM_GRAPH_SHARED names"
            )
        else:
            tasks.append(
                opportunity.OpportunityTask(folder=folder, models=("mast", "circle", "free", "projective"))
            )
    return Plan(tasks=tuple(tasks), left_out=tuple(left_out))


def _over_seeds(
    scenarios: Iterable[Scenario], noises_px: Iterable[float], seeds: int, variants: tuple[Variant, ...]
) -> list[ClusterTask]:
    return [
        ClusterTask(scenario=scenario, noise_px=noise_px, seed=seed, variants=variants)
        for scenario in scenarios
        for noise_px in noises_px
        for seed in range(seeds)
    ]
