"""Stage 5, reconsider: telemetry that the images contradict is let go, one error after the other."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pancam_graph.base.errors import SolveError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Traverse
from pancam_graph.elimination import Root
from pancam_graph.graph import LetGo
from pancam_graph.solve._constraint_tests import ConstraintTest
from pancam_graph.solve._fit import Fitted, fit
from pancam_graph.solve._judge import Judged, judge
from pancam_graph.solve._let_go import letting_go, most_let_go, parts_let_go
from pancam_graph.solve._screen import screened_again
from pancam_graph.solve._telemetry_tests import Correction, StopTelemetry, Suspected

__all__ = ["reconsidered"]

_TESTS = {"pointing", "stops", "constraints"}
"""Tests of the verdict that single errors of telemetry, or of constraints, fail."""
_PLACES = ("x", "y", "z")
"""Entries of a stop's telemetry that are lengths."""
_MOST_CONSTRAINTS = 1 / 3
"""Largest share of the constraints that may be let go; one may in any case."""
_AS_LIKELY = 15.0
"""Another error explains the corrections as well if its squared test is not less by more than this ..."""
_ALIKE = 0.5
"""... and if its correlation with the largest is at least this."""
_CLEARLY = 10.0
"""Difference of squared tests by which a wrong leg must explain more than a wrong scale, or a turn, does. If
the scale is wrong by whatever size, the leg does so in less than one of a thousand drives: the difference is
normal, with the mean -d^2 and the sigma 2 d, and exceeds c with the chance of (d^2 + c) / (2 d) sigmas, which
are the root of c or more."""
_SETTLED_BY = 1e-3
"""Factor on the relative decrease at which iterations end."""
_OF_FRAME = 5.0
"""Largest part of the cost that a wrong rig adds in one frame, over its mean in all frames."""


def reconsidered(judged: Judged) -> Judged:
    """Judged anew without wrong telemetry and constraints; the same object where all agrees with the images.

    While a correction of telemetry is larger than chance allows, the largest one's prior is let go (iterated
    data snooping, Baarda 1968), with the priors of all other errors that would explain it as well: an error
    of a stop's heading and one of all its pans look alike. What is left is then judged and solved again. A
    constraint that is further off than any telemetry is let go alone; where another error explains the
    corrections as well, nothing is.
    Where more than a few parts of telemetry would have to go, or where another rig explains more, or another
    scale of all lengths or a turn of the drive about as much, none is: the verdict says why.
    """
    now, traverse = judged, judged.fitted.screened.prepared.traverse
    most, n_constraints = most_let_go(traverse), len(traverse.constraints)
    most_constraints = max(1, int(_MOST_CONSTRAINTS * n_constraints)) if n_constraints else 0
    for _ in range(most + most_constraints):
        if not _fails(now):
            return now
        suspected = Suspected.of(now.regular, now.uncertainty, is_far=now.fitted.expected is not None)
        problem, every = now.fitted.problem, suspected.angles + suspected.stops
        constraint, is_sure = _wrong_constraint(now.constraints, every.sigmas)
        if constraint is not None:
            let_go = problem.template.let_go + _without(traverse, constraint)
            if not is_sure or let_go.constraints.sum() > most_constraints:
                return judged
        else:
            errors = _largest(suspected)
            if _is_of_rig(errors[0], now) or _grows(errors[0], suspected):
                return judged
            let_go = problem.template.let_go + letting_go(traverse, errors)
            if len(parts_let_go(traverse, let_go, now.state)) > most:
                return judged
        try:
            now = judge(_fitted_again(now.fitted, let_go))
        except SolveError:
            return judged  # nothing but that telemetry holds a direction
    return judged if _fails(now) else now


def _fails(judged: Judged) -> bool:
    if judged.uncertainty.masts is None or not judged.fitted.outcome.converged:
        return False
    return any(test.name in _TESTS for test in judged.verdict.failures)


def _wrong_constraint(tests: Sequence[ConstraintTest], telemetry: FloatArray) -> tuple[int | None, bool]:
    """Row of the constraint that is furthest off, and whether no other error explains that as well.

    None where an error of telemetry, by these sizes (n,) of their tests, explains more.
    """
    square = np.array([max(0.0, one.square - one.freedom + 1) for one in tests if not one.let_go])
    known = np.max(telemetry, initial=0.0) ** 2
    if not len(square) or square.max() <= known:
        return None, False
    rows = [one.row for one in tests if not one.let_go]
    rivals = np.sum(np.append(square, telemetry**2) >= square.max() - _AS_LIKELY)
    return rows[int(np.argmax(square))], bool(rivals == 1)


def _without(traverse: Traverse, constraint: int) -> LetGo:
    """A constraint let go, and nothing else."""
    out = LetGo.nothing(traverse)
    out.constraints[constraint] = True
    return out


def _is_of_rig(error: Correction, judged: Judged) -> bool:
    """Whether a held number of the rig would explain more than an error of telemetry does."""
    gains = [t.value for t in judged.verdict.tests if t.name == "held rig" and t.value is not None]
    # The rig is wrong in every frame: one frame's corrections can come from its share alone.
    is_single = error.frame is not None
    share = _OF_FRAME / len(judged.fitted.screened.prepared.traverse.frames) if is_single else 1.0
    return any(0.5 * error.sigmas**2 < share * gain for gain in gains)


def _grows(error: Correction, suspected: Suspected) -> bool:
    """Whether images may be wrong in place of a stop's telemetry, or of a leg's: by their scale, or turned.

    They are not if the error explains clearly more, in all three directions less what two more add by chance.
    """
    is_leg = error.entry.startswith("leg")
    if suspected.growing is None or not (is_leg or error.entry in _PLACES):
        return False
    names = {f"leg {name}" if is_leg else name for name in _PLACES}
    alike = [c.sigmas**2 for c in suspected.stops if c.stop == error.stop and c.entry in names]
    return sum(alike) - len(alike) + 1 < suspected.growing.square_of_images + _CLEARLY


def _fitted_again(fitted: Fitted, let_go: LetGo) -> Fitted:
    """The observations judged anew and fitted, from where a fit ended, with telemetry let go."""
    screened = fitted.screened
    # Without the fields and constraints that `fit` adds.
    problem = fitted.problem.untied().on(screened.problem.template)
    problem = replace(
        screened.problem.letting_go(let_go), values=problem.values, landmarks=fitted.problem.landmarks
    )
    excluded = screened.excluded | screened.by_chance
    again = screened_again(replace(screened, problem=problem, excluded=excluded))
    prepared = screened.prepared
    again = replace(
        again,
        prepared=prepared,
        set_aside=screened.set_aside | again.set_aside,
        by_chance=screened.by_chance | again.by_chance,
    )
    # Along what looks alike, steps are long and gain little.
    options = replace(prepared.options, relative_decrease=_SETTLED_BY * prepared.options.relative_decrease)
    new = fit(replace(again, prepared=replace(prepared, options=options)))
    costs = (*fitted.outcome.costs, *new.outcome.costs)
    return replace(new, screened=again, outcome=replace(new.outcome, costs=costs))


def _largest(suspected: Suspected) -> Sequence[Correction]:
    """The error that the corrections speak for most strongly, and others that explain them as well."""
    every = suspected.angles + suspected.stops
    worst = every.largest
    response = _response(worst, suspected.telemetry, suspected.root)
    out = [worst]
    for i in np.flatnonzero(every.sigmas**2 >= worst.sigmas**2 - _AS_LIKELY):
        c = every[int(i)]
        common = sum(float(a @ response[stop]) for stop, a in c.along.items())
        if i != np.argmax(every.sigmas) and abs(common) >= _ALIKE * np.sqrt(c.shown * worst.shown):
            out.append(c)
    return out


def _response(c: Correction, telemetry: Sequence[StopTelemetry], root: Root) -> dict[int, FloatArray]:
    """By stop, what an error of unit size does to the pulls (n,) of all telemetry: K a."""
    begin = np.concatenate([[0], np.cumsum(root.structure.dim)])
    of = {one.stop: one for one in telemetry}
    told = {stop: of[stop].told(along) for stop, along in c.along.items()}
    x = np.zeros(int(begin[-1]))
    for stop, right in told.items():
        rows = np.flatnonzero(right)
        columns = of[stop].column[rows]
        first, last = int(columns.min()), int(columns.max()) + 1
        inverse = root.inverse_columns(stop, slice(first, last))
        x += inverse[:, columns - first] @ right[rows]
        if (by_shared := of[stop].by_shared) is not None:
            x += root.inverse_columns(len(begin) - 2, slice(0, by_shared.shape[1])) @ (by_shared.T @ right)
    nothing = {one.stop: np.zeros(len(one.entry)) for one in telemetry}
    return {
        one.stop: told.get(one.stop, nothing[one.stop]) - one.told(one.moved(x, begin)) for one in telemetry
    }
