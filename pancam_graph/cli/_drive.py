"""The subcommand drive: a simulated drive followed stop by stop, as a page."""

import math
import os
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.cli._command import Command, Invocation
from pancam_graph.cli._drive_options import add_rig_option
from pancam_graph.cli._parser import CommandParser

__all__ = ["DRIVE"]

_DESCRIPTION = """\
Simulate a drive that ends where it began, and follow it stop by stop: estimate against truth and odometry.

A line for each stop on the terminal; OUT, an HTML page, replays the estimate with its ellipses.

Exit status: 0 written, 2 bad input or a fault (nothing is written), 130 interrupted.
"""


def _add_options(parser: CommandParser) -> None:
    parser.add_argument("out", metavar="OUT", type=Path, help="HTML file to write")
    add_rig_option(parser)
    parser.add_argument(
        "--stops", type=int, default=30, help="number of places where the mast stands (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="another seed, another drive (%(default)s)")


def _check_page(page: Path) -> None:
    """Raise InputError, before a long drive, for a place where no file can be written."""
    expected = f"{page}: expected a place for an HTML file in a folder that exists"
    if page.exists() and not page.is_file():  # a device would be replaced
        raise InputError(f"{expected}, found {'a folder' if page.is_dir() else 'no file'} in its place")
    if not page.parent.is_dir():
        raise InputError(f"{expected}, found no folder {page.parent}")
    if not os.access(page if page.exists() else page.parent, os.W_OK):
        raise InputError(f"{expected}, found no permission to write there")


def _work(call: Invocation) -> int:
    """Simulate, follow, write."""
    from pancam_graph import SimulationOptions, SmootherOptions, TraverseSmoother, simulate
    from pancam_graph.report import DriveStep, write_drive
    from pancam_graph.rigs import rig_template
    from pancam_graph.smoother import stops_of

    arguments = call.arguments
    options = SimulationOptions(
        stops=arguments.stops, loop=True, odometry=True, spacing_m=9.0, heading_change_rad=0.15, pans=10,
        tilts_rad=(-0.2,), points_per_image=12, detection=0.4, noise_px=0.5, link_stops=2, reach_m=16.0,
        max_turn_rad=math.pi, max_zoom=6.0, sigma_stop_m=0.3, sigma_stop_rad=0.01,
    )  # fmt: skip
    _check_page(arguments.out)
    steps: list[DriveStep] = []
    with call.progress.shown("simulating"):
        simulation = simulate(rig_template(arguments.rig), options, seed=arguments.seed)
        smoother = TraverseSmoother(simulation.traverse.rig, SmootherOptions(telemetry="odometry"))
        for part in stops_of(simulation.traverse):
            update = smoother.add_stop(*part)
            call.progress.stop(update, arguments.stops)
            steps.append(DriveStep.of(smoother, update, simulation))
        last = steps[-1]
        closing = next((i for i, s in enumerate(steps) if any(c.accepted for c in s.update.closures)), None)
        before = steps[closing - 1] if closing else last
        for name, step in (("before the loop closes", before), ("at the end", last)):
            call.say(f"{name}: {step.summary}")
        call.progress.say(f"writing {arguments.out}")
        write_drive(steps, simulation, arguments.out)
    return 0


DRIVE = Command(
    name="drive",
    summary="follow a made-up drive stop by stop, and replay it on a page",
    description=_DESCRIPTION,
    add_options=_add_options,
    work=_work,
)
