"""One run of the benchmark, from names of cases to a report."""

from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.cases import Case, make
from benchmarks.engines import ENGINES, NotRun, Setting, ceres_program, measure, solve_first_ever
from benchmarks.report import CaseResult, Report

__all__ = ["prepare", "run_cases"]

_CERES_SOURCE = Path(__file__).resolve().parents[3] / "shared" / "bench" / "peer_ceres.cc"


def prepare(cases: Sequence[Case], folder: Path, ceres: Path | None) -> Setting:
    """What the engines need: an empty cache under `folder`, and the Ceres program if a case wants it.

    `ceres` is the program; None: compiled from ../shared/bench where that is possible.
    """
    wanted = any("ceres" in case.engines for case in cases)
    return Setting(
        ceres=ceres_program(ceres, _CERES_SOURCE, folder / "ceres")
        if wanted
        else NotRun(reason="not asked for", failed=False),
        numba_cache=folder / "numba",
    )


def run_cases(
    cases: Sequence[Case],
    setting: Setting,
    folder: Path,
    *,
    first_ever: bool = True,
    say: Callable[[str], None] = lambda _: None,
) -> Report:
    """Make each case in a new folder under `folder` and let its engines solve it, one after the other.

    `first_ever`: measure the first solve with nothing compiled, on the smallest case that the compiled
    solver solves; it leaves the compiled code for all others. `say` is told what goes on.
    """
    made = {}
    for case in cases:
        say(f"{case.name}: simulating")
        made[case.name] = make(case, folder / case.name)
    compiled = [c for c in cases if "eliminated" in c.engines]
    first_ever_s: float | None = None
    if first_ever and compiled:
        smallest = min(compiled, key=lambda c: made[c.name][1].observations)
        say(f"{smallest.name}: first solve ever")
        found = solve_first_ever(ENGINES["eliminated"], made[smallest.name][0], setting)
        first_ever_s = None if isinstance(found, NotRun) else found
    results = []
    for case in cases:
        files, size = made[case.name]
        engines = {}
        for name in case.engines:
            say(f"{case.name}: {name}")
            engines[name] = measure(ENGINES[name], files, setting, case.repeats)
        results.append(CaseResult(name=case.name, size=size, engines=engines))
    return Report(cases=tuple(results), first_ever_s=first_ever_s)
