"""Report of a benchmark: ratios between engines, their comparison with the baseline, a table, a file."""

import importlib.metadata
import json
import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from benchmarks.cases import GROWTH, Size
from benchmarks.engines import ENGINES, Measured, NotRun
from pancam_graph.base.errors import InputError

__all__ = [
    "GROWTH_LIMIT",
    "CaseResult",
    "Report",
    "against_baseline",
    "read_baseline",
    "write_baseline",
]

COST_TOLERANCE = 1e-4
"""Largest relative difference of final costs between engines that solve the same problem."""
GROWTH_LIMIT = 1.3
"""Largest growth of the time per observation and iteration from the shorter to the longer drive of GROWTH."""

_FORMAT, _VERSION = "pancam-graph/benchmark-baseline", 1
_PACKAGES = ("pancam-graph", "gtsam", "numpy", "numba", "scipy", "pycolmap")


def machine() -> dict[str, str]:
    """Processor, system and versions of packages on which the figures were measured."""
    about = {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
    }
    installed = {d.name.lower(): d.version for d in importlib.metadata.distributions() if d.name}
    return {**about, **{p: installed[p] for p in _PACKAGES if p in installed}}


def _processor() -> str:
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        for line in listing.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """Size of a case, and the figures of each engine on it."""

    name: str
    size: Size
    engines: Mapping[str, Measured | NotRun]

    def measured(self, engine: str) -> Measured | None:
        """Figures of an engine; None if it did not run."""
        outcome = self.engines.get(engine)
        return outcome if isinstance(outcome, Measured) else None


@dataclass(frozen=True, kw_only=True)
class Report:
    """Figures of all cases of a run."""

    cases: tuple[CaseResult, ...]
    first_ever_s: Mapping[str, float] = field(default_factory=dict)
    """By engine: first solve of its smallest case, with nothing compiled."""
    machine: Mapping[str, str] = field(default_factory=machine)

    def ratios(self) -> dict[str, float]:
        """Time of ours over the peer's, best to best, and the growth with length; no absolute times."""
        ratios = {}
        for case in self.cases:
            for ours, other in (("eliminated", "ceres"), ("explicit", "ceres"), ("eliminated", "explicit")):
                a, b = case.measured(ours), case.measured(other)
                if a and b:
                    ratios[f"{case.name}: {ours} / {other}"] = a.best_s / b.best_s
                if a and b and a.process_s and b.process_s:
                    ratios[f"{case.name}: {ours} / {other}, whole process"] = a.process_s / b.process_s
        growth = self.growth()
        if growth is not None:
            ratios[f"{GROWTH[1]} / {GROWTH[0]}: time per observation and iteration"] = growth
        return ratios

    def growth(self, *, per_iteration: bool = True) -> float | None:
        """Time per observation (and iteration) of the longer drive over that of the shorter one."""
        each = []
        for name in GROWTH:
            case = next((c for c in self.cases if c.name == name), None)
            ours = case.measured("eliminated") if case else None
            if case is None or ours is None:
                return None
            iterations = max(1, ours.iterations) if per_iteration else 1
            each.append(ours.best_s / (case.size.observations * iterations))
        return each[1] / each[0]

    def complaints(self) -> list[str]:
        """Faults that need no baseline: engines that failed, costs that differ, growth of the time."""
        return [*self._failures(), *self._disagreements(), *self._growth_complaint()]

    def _failures(self) -> Iterator[str]:
        for case in self.cases:
            for name, outcome in case.engines.items():
                if isinstance(outcome, NotRun) and outcome.failed:
                    yield f"{case.name}: {name} failed: {outcome.reason}"
                if isinstance(outcome, Measured) and "not converged" in outcome.detail:
                    yield f"{case.name}: {name}: {outcome.detail}"

    def _disagreements(self) -> Iterator[str]:
        for case in self.cases:
            costs = {
                name: outcome.cost_final
                for name, outcome in case.engines.items()
                if isinstance(outcome, Measured) and ENGINES[name].same_problem
            }
            reference = "ceres" if "ceres" in costs else next(iter(costs), "")
            for name, cost in costs.items():
                off = abs(cost - costs[reference]) / costs[reference]
                if not off <= COST_TOLERANCE:  # a cost that is not a number is off, too
                    yield (
                        f"{case.name}: FINAL COSTS DIFFER: {name} {cost:.9g}, {reference} "
                        f"{costs[reference]:.9g}: by {off:.2g}, expected {COST_TOLERANCE:g} or less"
                    )

    def _growth_complaint(self) -> Iterator[str]:
        growth = self.growth()
        if growth is not None and growth >= GROWTH_LIMIT:
            yield (
                f"from {GROWTH[0]} to {GROWTH[1]} the time per observation and iteration grows by "
                f"{growth:.2f}, expected less than {GROWTH_LIMIT}"
            )

    def notes(self) -> list[str]:
        """Lines below the table: engines that were skipped and why, and details of the others."""
        lines = []
        for case in self.cases:
            for name, outcome in case.engines.items():
                if isinstance(outcome, NotRun) and not outcome.failed:
                    lines.append(f"{case.name}: {name} skipped: {outcome.reason}")
                elif isinstance(outcome, Measured) and outcome.detail:
                    lines.append(f"{case.name}: {name}: {outcome.detail}")
        for name, seconds in self.first_ever_s.items():
            lines.append(f"{name}: first solve ever, code compiled on the way: {seconds:.1f} s")
        growth, whole = self.growth(), self.growth(per_iteration=False)
        if growth is not None and whole is not None:
            lines.append(
                f"{GROWTH[0]} to {GROWTH[1]}: time per observation and iteration times {growth:.2f} "
                f"(limit {GROWTH_LIMIT}), per observation alone times {whole:.2f}"
            )
        return lines

    def markdown(self) -> str:
        """The table for the first page: a line per case and engine."""
        head = (
            "| case | solver | whole process, s | to Ceres's | solve, s: best (median) | to Ceres "
            "| iterations | cost | RMS, px | preparing, s | first solve of a process, s | memory, MB |"
        )
        lines = [head, "| --- | --- " + "| ---: " * 10 + "|"]
        for case in self.cases:
            s, peer = case.size, case.measured("ceres")
            title = f"{case.name}: {s.stops} stops, {s.images:,} images, {s.observations:,} observations"
            for name, m in case.engines.items():
                if not isinstance(m, Measured):
                    continue
                cells = [
                    title,
                    ENGINES[name].title,
                    "" if m.process_s is None else f"{m.process_s:.3g}",
                    f"{m.process_s / peer.process_s:.2f}" if m.process_s and peer and peer.process_s else "",
                    f"{m.best_s:.3g} ({m.median_s:.3g})",
                    f"{m.best_s / peer.best_s:.2f}" if peer else "",
                    f"{m.iterations}",
                    f"{m.cost_final:.1f}" + ("" if ENGINES[name].same_problem else " (its own)"),
                    "" if m.rms_px is None else f"{m.rms_px:.3f}",
                    "" if m.initialise_s is None else f"{m.initialise_s:.2g}",
                    "" if m.first_s is None else f"{m.first_s:.3g}",
                    f"{m.memory_mb:.0f}",
                ]
                lines.append("| " + " | ".join(cells) + " |")
                title = ""
        return "\n".join(lines)

    def text(self, changes: Sequence[str], faults: Sequence[str]) -> str:
        """Text to print: the table, notes, changes of ratios, and faults last."""
        listed = [f"- {line}" for line in (*self.notes(), *changes)]
        return "\n".join([self.markdown(), "", *listed, *(f"ERROR {line}" for line in faults)])

    def to_json(self) -> str:
        """All figures as JSON, absolute times included."""
        cases = {
            c.name: {"size": asdict(c.size), "engines": {name: asdict(e) for name, e in c.engines.items()}}
            for c in self.cases
        }
        content = {
            "machine": dict(self.machine),
            "first_ever_s": dict(self.first_ever_s),
            "cases": cases,
            "ratios": self.ratios(),
            "complaints": self.complaints(),
        }
        return json.dumps(content, indent=1) + "\n"


def against_baseline(
    ratios: Mapping[str, float], baseline: Mapping[str, float], tolerance: float
) -> tuple[list[str], list[str]]:
    """Complaints and notes: what got worse by more than `tolerance` (a share), what better, what is new."""
    worse, notes = [], []
    for name, ratio in ratios.items():
        if name not in baseline:
            notes.append(f"{name}: {ratio:.3g}; not in the baseline")
            continue
        change = ratio / baseline[name] - 1
        text = f"{name}: {ratio:.3g}, baseline {baseline[name]:.3g} ({change:+.0%})"
        if not change <= tolerance:
            worse.append(f"{text}: WORSE by more than {tolerance:.0%}")
        else:
            notes.append(text + (": better; --write-baseline would keep it" if change < -tolerance else ""))
    return worse, notes


def read_baseline(path: Path) -> dict[str, float]:
    """Ratios by name; none where there is no file. Raises InputError for a file of another kind."""
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        known = (content["format"], content["version"]) == (_FORMAT, _VERSION)
        ratios = {str(name): float(ratio) for name, ratio in content["ratios"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: expected a benchmark baseline, found: {error}") from error
    if not known:
        raise InputError(f"{path}: expected format {_FORMAT} {_VERSION}, found {content['format']}")
    bad = [f"{name} {ratio}" for name, ratio in ratios.items() if not (math.isfinite(ratio) and ratio > 0)]
    if bad:
        raise InputError(f"{path}: ratios: expected numbers above 0, found {bad[0]}")
    return ratios


def write_baseline(path: Path, ratios: Mapping[str, float]) -> list[str]:
    """Renew the ratios that were measured, keep the others; returns what changed, a line each."""
    old = read_baseline(path)
    new = {**old, **{name: round(ratio, 4) for name, ratio in ratios.items()}}
    content = {"format": _FORMAT, "version": _VERSION, "ratios": dict(sorted(new.items()))}
    beside = path.with_name(path.name + ".new")
    beside.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    beside.replace(path)
    return [
        f"{name}: {old[name]:.4g} -> {new[name]:.4g}" if name in old else f"{name}: {new[name]:.4g}, new"
        for name in ratios
    ]
