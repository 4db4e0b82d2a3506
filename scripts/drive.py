"""Simulate a drive of 30 stops and back, and follow it stop by stop: estimate against truth and odometry.

A line for each stop on the terminal; OUT, an HTML page, replays the estimate with its ellipses.

Exit status: 0 written, 2 bad input (nothing is written).
"""

import sys
from pathlib import Path

import numpy as np

from pancam_graph import SimulationOptions, SmootherOptions, TraverseSmoother, simulate
from pancam_graph.cli._program import Parser, Progress, run, show_log
from pancam_graph.report import DriveStep, write_drive
from pancam_graph.rigs import TEMPLATES, rig_template
from pancam_graph.smoother._incremental import stops_of


def main() -> int:
    """Simulate, follow, write."""
    parser = Parser(__doc__ or "")
    parser.add_argument("out", metavar="OUT", type=Path, help="HTML file to write")
    parser.add_argument("--rig", choices=TEMPLATES, default="mer-navcam", help="cameras (%(default)s)")
    parser.add_argument("--stops", type=int, default=30, help="places of the mast (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="another seed, another drive (%(default)s)")
    arguments = parser.parse_args()
    show_log(verbose=arguments.verbose)
    options = SimulationOptions(
        stops=arguments.stops, loop=True, odometry=True, spacing_m=9.0, heading_change_rad=0.15, pans=10,
        tilts_rad=(-0.2,), points_per_image=12, detection=0.4, noise_px=0.5, link_stops=2, reach_m=16.0,
        max_turn_rad=np.pi, max_zoom=6.0, sigma_stop_m=0.3, sigma_stop_rad=0.01,
    )  # fmt: skip
    simulation = simulate(rig_template(arguments.rig), options, seed=arguments.seed)
    smoother = TraverseSmoother(simulation.traverse.rig, SmootherOptions(telemetry="odometry"))
    progress, steps = Progress(), list[DriveStep]()
    for part in stops_of(simulation.traverse):
        update = smoother.add_stop(*part)
        progress.stop(update)
        steps.append(DriveStep.of(smoother, update, simulation))
    last = steps[-1]
    closed = next((i for i, s in enumerate(steps) if any(c.accepted for c in s.update.closures)), None)
    before = steps[closed - 1] if closed else last
    for name, step in (("before the loop closes", before), ("at the end", last)):
        sys.stdout.write(f"{name}: {step.summary}\n")
    write_drive(steps, simulation, arguments.out)
    return 0


if __name__ == "__main__":
    run(main)
