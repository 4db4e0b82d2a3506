"""Follow a traverse folder stop by stop; print the time of each stop and the difference from the batch.

Prints JSON. It is run in a new process.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from pancam_graph import SolveOptions, read_traverse, solve
from pancam_graph.cli import run
from pancam_graph.data import Traverse
from pancam_graph.smoother import SmootherOptions, TraverseSmoother, Update
from pancam_graph.smoother._incremental import stops_of


def main() -> int:
    """Drive once cold, then as often as asked; compare the last drive with a batch of what it uses."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("traverse", type=Path)
    parser.add_argument("--repeats", type=int, required=True, help="warm drives after the first one")
    arguments = parser.parse_args()
    traverse = read_traverse(arguments.traverse)
    drives = [_drive(traverse) for _ in range(1 + arguments.repeats)]
    smoother, updates = drives[-1]
    seconds = [[u.seconds for u in each] for _, each in drives]
    print(
        json.dumps(
            {
                "first_s": max(seconds[0]),
                "seconds": [max(each) for each in seconds[1:]],
                "best_per_stop_s": np.min(seconds[1:], axis=0).tolist(),
                "fell_back": sum(u.fell_back for u in updates),
                **_against_batch(smoother, solve(traverse, SolveOptions(rig="held")).cost_final),
            }
        )
    )
    return 0


def _drive(traverse: Traverse) -> tuple[TraverseSmoother, list[Update]]:
    smoother = TraverseSmoother(traverse.rig, SmootherOptions(rig="held"))
    return smoother, [smoother.add_stop(*part) for part in stops_of(traverse)]


def _against_batch(smoother: TraverseSmoother, batch_cost: float) -> dict[str, float]:
    """Cost against the batch's; poses and sigmas against a batch of the same observations."""
    t, estimate = smoother.traverse, smoother.estimate()
    assert t.observations is not None  # simulated traverses have them
    same = solve(
        t.with_observations(t.observations.select(smoother.used)), SolveOptions(rig="held", loss="none")
    )
    off, sigma_off = [0.0], [0.0]
    for i, stop in enumerate(t.stops):
        batch = np.sqrt(np.diag(same.stop_covariance[i]))
        free = batch > 0
        difference = same.final.world_T_mast[i].localCoordinates(estimate.world_T_mast[i])
        off.append(np.max(np.abs(difference[free]) / batch[free], initial=0.0))
        sigma = np.sqrt(np.diag(smoother.covariance(stop.id)))
        sigma_off.append(np.max(np.abs(sigma[free] / batch[free] - 1), initial=0.0))
    return {
        "cost": smoother.cost,
        "cost_off": smoother.cost / batch_cost - 1,
        "pose_off_sigma": float(max(off)),
        "sigma_off": float(max(sigma_off)),
    }


if __name__ == "__main__":
    run(main)
