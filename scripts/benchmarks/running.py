"""One run of the benchmark, from names of cases to a report."""

from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.cases import Case, make
from benchmarks.engines import ENGINES, NotRun, Setting, ceres_program, measure, solve_first_ever
from benchmarks.report import CaseResult, Report

__all__ = ["prepare", "run_cases"]

_CERES_SOURCE = Path(__file__).resolve().parents[3] / "shared" / "bench" / "peer_ceres.cc"


def prepare(cases: Sequence[Case], folder: Path, ceres: Path | None) -> Setting:
    """The setting of a run: an empty cache under `folder`, and the Ceres program if a case needs it.

    `ceres` is the program; if None, it is compiled from ../shared/bench where that is possible.
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
    say: Callable[[str], None] = lambda _: None,
) -> Report:
    """Make each case in a new folder under `folder` and let its engines solve it, one after the other.

    Before that, an engine that compiles code solves its smallest case with nothing compiled, which leaves
    the code on disk for all others. `say` gets a sentence before each step.
    """
    made = {}
    for case in cases:
        say(f"{case.name}: simulating")
        made[case.name] = make(case, folder / case.name)
    first_ever_s = {}
    for name in [n for n, engine in ENGINES.items() if engine.compiles]:
        solved = [made[case.name] for case in cases if name in case.engines]
        if solved:
            say(f"{name}: first solve ever")
            files, _ = min(solved, key=lambda files_size: files_size[1].observations)
            first_s = solve_first_ever(ENGINES[name], files, setting)
            if not isinstance(first_s, NotRun):  # if it failed, it fails again below and is reported there
                first_ever_s[name] = first_s
    results = []
    for case in cases:
        files, size = made[case.name]
        engines = {}
        for name in case.engines:
            say(f"{case.name}: {name}")
            engines[name] = measure(ENGINES[name], files, setting, case.repeats)
        results.append(CaseResult(name=case.name, size=size, engines=engines))
    return Report(cases=tuple(results), first_ever_s=first_ever_s)
