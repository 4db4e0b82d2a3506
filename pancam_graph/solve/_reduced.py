"""A problem with its landmarks eliminated: the square root of the system in the variables of cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.elimination import Linkage, Panels, Root, Rows, with_rows
from pancam_graph.graph import Factors, FactorTemplate, Kind, graph_of, kind_of
from pancam_graph.solve._problem import EliminatedLandmarks, Problem, system_of

__all__ = [
    "ReducedSystem",
    "add_factors",
    "joint_panels",
    "landmark_panels",
    "loosened_root",
    "panels_of",
]


@dataclass(frozen=True, kw_only=True, eq=False)
class ReducedSystem:
    """The system in the variables of cameras at a problem's values, all factors included."""

    system: EliminatedLandmarks
    """Of the landmarks, linearised at these values."""
    rows: IntArray
    """(n,) rows of its landmarks among all."""
    root: Root
    """Square root of the system."""
    gain: float
    """Decrease of the linearised cost by the step of the cameras, as the normal equations have it."""

    @staticmethod
    def by_root(system: EliminatedLandmarks, rows: IntArray, root: Root) -> "ReducedSystem":
        """The same of a square root of the normal equations."""
        return ReducedSystem(system=system, rows=rows, root=root, gain=root.gain())

    @staticmethod
    def of(
        problem: Problem,
        arranged: tuple[EliminatedLandmarks, IntArray] | None = None,
        *,
        without: Mapping[int, FloatArray] | None = None,
    ) -> "ReducedSystem":
        """Linearise a problem; `arranged` is its landmark system and rows, if these exist already.

        `without` is information (n, n) by group that is taken off. Raises SolveError where no observation
        takes part.
        """
        system, rows = arranged or system_of(problem)
        root = landmark_panels(problem, system, without=without).root()
        return ReducedSystem.by_root(system, rows, root).firm(problem)

    def firm(self, problem: Problem) -> "ReducedSystem":
        """The same, or one by QR where a weak prior of the problem is lost in rounding errors of this one."""
        return replace(self, root=_firm_root(problem, self.system, self.root))


def panels_of(problem: Problem) -> Panels:
    """The system in the variables of cameras at a problem's values, all factors included.

    Raises SolveError where no observation takes part.
    """
    return landmark_panels(problem, system_of(problem)[0])


def landmark_panels(
    problem: Problem, system: EliminatedLandmarks, *, without: Mapping[int, FloatArray] | None = None
) -> Panels:
    """The same, of a landmark system that exists already and is linearised again.

    `without` is information (n, n) by group that is taken off.
    """
    panels = system.linearise(problem.template.posture(problem.values))
    panels = joint_panels(problem.template, problem.factors, problem.values, panels)
    for group, information in (without or {}).items():
        panels.panel[group][: len(information), : len(information)] -= information
    return panels


def joint_panels(template: FactorTemplate, factors: Factors, values: gtsam.Values, panels: Panels) -> Panels:
    """Add all factors except landmarks' to the panels of the eliminated landmarks, and hold columns."""
    add_factors(panels, template.linkage, factors.linearize(values))
    panels.hold(template.held_by_group)
    return panels


def loosened_root(problem: Problem, system: EliminatedLandmarks, factor: float) -> Root:
    """The square root at a problem's values, with the sigmas of all priors multiplied by a factor.

    Ties and given factors are unchanged. `system` is the problem's, and is linearised again.
    """
    template, link, factors = problem.template, problem.template.linkage, problem.factors
    panels = system.linearise(template.posture(problem.values))

    def add(which: Sequence[gtsam.NonlinearFactor], weight: float) -> None:
        add_factors(panels, link, graph_of(which).linearize(problem.values), weight=weight)

    add((*factors.ties, *factors.seated), 1.0)
    add(factors.priors, factor**-2)
    panels.hold(template.held_by_group)
    return _firm_root(problem, system, panels.root(), factor)


def _firm_root(problem: Problem, system: EliminatedLandmarks, root: Root, factor: float = 1.0) -> Root:
    """A root, or one by QR where a weak prior of the problem is lost in rounding errors and QR keeps it.

    `root` is that of `loosened_root` with this factor.
    """
    if not root.is_rounded:
        return root
    motion = _common_motion(problem)
    if motion is None and not root.leaves_free:
        return root
    return _root_by_qr(problem, system, motion, factor)


def _root_by_qr(
    problem: Problem, system: EliminatedLandmarks, motion: FloatArray | None, factor: float
) -> Root:
    """The square root of `loosened_root`, by QR of the rows of landmarks and of all other factors.

    `motion` is the common motion of all poses that images cannot tell, if there is one.
    """
    template, link, factors, values = (
        problem.template,
        problem.template.linkage,
        problem.factors,
        problem.values,
    )
    held = template.held_by_group
    panels = system.linearise(template.posture(values))
    panels.hold(held)
    more = _rows(link, graph_of((*factors.ties, *factors.seated)).linearize(values), held, 1.0)
    more += _rows(link, graph_of(factors.priors).linearize(values), held, 1 / factor)
    root = panels.root()
    return with_rows(root if motion is None else _without_motion(root, motion, link), more)


def _common_motion(problem: Problem) -> FloatArray | None:
    """The tangents (columns, 6) of a common rotation and shift of all poses; None where some pose is held."""
    template, link = problem.template, problem.template.linkage
    kinds = [kind_of(key) for key in link.key]
    moving = set(link.key)
    t = template.traverse
    stops_move = all(template.keys.mast(t.stops[s].id) in moving for s in np.unique(t.image_stop).tolist())
    if Kind.PROJECTION in kinds or not (stops_move or template.has_cameras):
        return None
    of_poses = [i for i, kind in enumerate(kinds) if kind in {Kind.MAST, Kind.CAMERA}]
    poses = [problem.values.atPose3(link.key[i]) for i in of_poses]
    out = np.zeros((int(link.group_column[-1]), 6))
    middle = np.mean([pose.translation() for pose in poses], axis=0) if poses else np.zeros(3)
    for i, pose in zip(of_poses, poses, strict=True):
        first = int(link.group_column[link.group[i]]) + link.columns_of(link.key[i]).start
        inverse = pose.rotation().matrix().T
        arm = pose.translation() - middle
        out[first : first + 3, :3] = inverse
        out[first + 3 : first + 6, :3] = inverse @ np.cross(np.eye(3), arm).T
        out[first + 3 : first + 6, 3:] = inverse
    held = [link.group_column[g] + columns for g, columns in template.held_by_group.items()]
    return None if any(np.any(out[columns]) for columns in held) else out


def _without_motion(root: Root, motion: FloatArray, linkage: Linkage) -> Root:
    """The root of what images alone say, without what rounding says of a common motion (columns, 6).

    Images cannot tell it: the product of each row with it is 0 but for rounding, and a row along it is
    rounding itself.
    """
    rows, begin = [], linkage.group_column
    for after, some in zip(root.structure.after, root.rows, strict=True):
        moves = np.concatenate([motion[begin[h] : begin[h + 1]] for h in after])
        told = some[:, :-1] - (some[:, :-1] @ moves) @ np.linalg.pinv(moves)
        rows.append(np.column_stack([told, some[:, -1]]))
    return replace(root, rows=tuple(rows))


def _rows(
    linkage: Linkage, linear: gtsam.GaussianFactorGraph, held: dict[int, IntArray], weight: float
) -> list[Rows]:
    """Rows of factors as GTSAM linearises them, `weight` times; those of held columns are 0."""
    out: list[Rows] = []
    for i in range(linear.size()):
        factor = linear.at(i)
        if factor is None:
            continue
        places = [linkage.place[key] for key in factor.keys()]  # noqa: SIM118  no dictionary
        groups, columns = [group for group, _ in places], [columns for _, columns in places]
        rows = weight * factor.augmentedJacobian()
        rows[:, -1] *= -1  # GTSAM has the right-hand side there, minus the residual
        is_held = [
            np.isin(np.arange(c.start, c.stop), held.get(g, [])) for g, c in zip(groups, columns, strict=True)
        ]
        rows[:, np.flatnonzero(np.concatenate(is_held))] = 0.0
        out.append((groups, columns, rows))
    return out


def add_factors(
    panels: Panels, linkage: Linkage, linear: gtsam.GaussianFactorGraph, weight: float = 1.0
) -> None:
    """Add factors as GTSAM linearises them, with `weight` times their information."""
    for i in range(linear.size()):
        factor = linear.at(i)
        if factor is None:
            continue
        # The last column is the right-hand side, minus the residual.
        normal = weight * factor.augmentedInformation()
        places, begin = [linkage.place[key] for key in factor.keys()], 0  # noqa: SIM118  no dictionary
        rows = list[slice]()
        for _, columns in places:
            rows.append(slice(begin, begin + columns.stop - columns.start))
            begin = rows[-1].stop
        for a, (group, columns) in enumerate(places):
            panels.add_right(group, columns, -normal[rows[a], -1])
            for (other, others), to in zip(places[a:], rows[a:], strict=True):
                panels.add_block(group, columns, other, others, normal[rows[a], to])
