"""Count false alarms: drives of all rigs in which nothing is wrong, and how many fail a test of the verdict.

Each drive has 1 to 4 stops, 5 to 40 points an image, four pans that overlap or a whole turn, both eyes or
one, no outliers, 3 or 10 %, and given or estimated noise. Its rig is off as its uncertainty says and is
estimated, or right and held. A line for each drive that fails or is beyond six formal sigmas; then for each
test the largest value over its limit; then the counts. The same options give the same numbers.

Exit status: 0 no more than a hundredth failed, 1 more, 2 bad input.
"""

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pancam_graph import SolveOptions, simulate, solve
from pancam_graph.base.errors import InputError, PancamGraphError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cli import Progress, ScriptParser, run
from pancam_graph.rigs import Rig, rig_template
from pancam_graph.simulate import SimulationOptions
from wrong_inputs import errors_in_sigmas

_RIGS = ("mer-navcam", "msl-navcam", "mars2020-navcam", "exomars-pancam", "stereo-pan-tilt")
_MOST_FAILED = 0.01
"""Share of right drives that may fail a test."""
_FAR_OFF = 6.0
"""Error in formal sigmas from which a drive is named, whether it failed or not."""


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A right drive, and how it is solved."""

    rig: Rig
    options: SimulationOptions
    solving: SolveOptions
    seed: int

    @staticmethod
    def of(rigs: list[str], seed: int) -> "Drive":
        """The drive of a seed; rigs take turns, all else is drawn."""
        rng = np.random.default_rng([seed, 1])
        name = rigs[seed % len(rigs)]
        rig = rig_template(name)
        n_eyes = 1 if rng.random() < 0.25 else 2
        is_held = bool(rng.random() < 0.25)
        row: dict[str, Any] = {"pans": 4, "sweep_rad": None} if rng.random() < 0.5 else {}
        options = SimulationOptions(
            stops=int(rng.integers(1, 5)),
            points_per_image=int(rng.choice([5, 10, 20, 40])),
            outliers=float(rng.choice([0.0, 0.0, 0.03, 0.1])),
            rig_error="none" if is_held else "drawn",
            **row,
        )
        rescales = bool(rng.random() < 0.25)
        solving = SolveOptions(rig="held" if is_held else "estimated", rescale_noise=rescales or None)
        return Drive(rig=replace(rig, eyes=rig.eyes[:n_eyes]), options=options, solving=solving, seed=seed)

    def __str__(self) -> str:
        """In words."""
        o, eyes = self.options, len(self.rig.eyes)
        noise = "estimated" if self.solving.rescale_noise else "given"
        pans = f"{o.pans} pans" if o.pans else "whole turns"
        return (
            f"seed {self.seed}: {self.rig.name}, {eyes} eye{'s' * (eyes > 1)}, {o.stops} stops of {pans}, "
            f"{o.points_per_image} points, {o.outliers:.0%} outliers, rig {self.solving.rig}, noise "
            f"{noise}"
        )

    def measure(self) -> "Outcome":
        """Simulate, solve, compare with the truth."""
        simulation = simulate(self.rig, self.options, seed=self.seed)
        try:
            solution = solve(simulation.traverse, self.solving)
        except PancamGraphError as refused:
            return Outcome(failed=(str(refused)[:60],), shares={}, errors=np.zeros(0))
        assert solution.verdict is not None  # every solve is tested
        shares = {
            test.name: test.value / test.limit
            for test in solution.verdict.tests
            if test.value is not None and test.limit > 0 and test.name != "cost"
        }
        failed = tuple(test.name for test in solution.verdict.failures)
        let_go = any(test.name == "let go" and test.value for test in solution.verdict.tests)
        errors = errors_in_sigmas(solution, simulation)
        return Outcome(failed=failed, shares=shares, errors=errors, let_go=let_go)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a drive."""

    failed: tuple[str, ...]
    """Names of the tests that failed; the error itself where nothing was solved."""
    shares: dict[str, float]
    """Value of each test over its limit."""
    errors: FloatArray
    """(n,) of pans, tilts and components of stops' poses, in formal sigmas."""
    let_go: bool = False
    """Whether telemetry was let go."""


def main() -> int:
    """Solve all drives, print those that fail."""
    parser = ScriptParser(__doc__ or "")
    add = parser.add_argument
    add("--drives", type=int, default=200, help="(%(default)s)")
    add("--first-seed", type=int, default=0, help="(%(default)s)")
    add("--rigs", nargs="+", default=list(_RIGS), metavar="RIG")
    a = parser.parse_args()
    if a.drives < 1:
        raise InputError(f"--drives: expected 1 or more, found {a.drives}")
    progress = Progress()
    outcomes = []
    with progress.shown("drives"):
        for seed in range(a.first_seed, a.first_seed + a.drives):
            drive = Drive.of(a.rigs, seed)
            outcome = drive.measure()
            outcomes.append(outcome)
            worst = float(outcome.errors.max(initial=0.0))
            if outcome.failed or not worst <= _FAR_OFF:
                print(f"{drive}: {', '.join(outcome.failed) or 'passed'}, {worst:.1f} sigma", flush=True)
    for name in sorted({name for o in outcomes for name in o.shares}):
        values = [o.shares[name] for o in outcomes if name in o.shares]
        print(f"{name:<20} at most {max(values):>6.2f} of its limit, in {len(values)} drives")
    n_failed = sum(bool(o.failed) for o in outcomes)
    errors = np.concatenate([np.zeros(0), *(o.errors for o in outcomes if not o.failed)])
    said = ", ".join(
        f"{test} {n}" for test, n in Counter(t for o in outcomes for t in o.failed).most_common()
    )
    square, worst = float(np.mean(errors**2)), float(errors.max(initial=0.0))
    print(f"{n_failed} of {len(outcomes)} failed{': ' * bool(said)}{said}")
    print(f"{sum(o.let_go for o in outcomes)} let telemetry go")
    print(f"of those that passed: mean squared error over variance {square:.2f}, largest {worst:.1f} sigma")
    return 1 if n_failed > _MOST_FAILED * len(outcomes) else 0


if __name__ == "__main__":
    run(main)
