"""Stage 1, prepare: measurements, the rig as variables and factors, and the values a solve starts from."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError, SolveError
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.data import (
    FIXED,
    FrameDirection,
    Freedom,
    Observations,
    PixelNoise,
    RigCorrection,
    Sharing,
    State,
    Traverse,
    field_within,
    sharing_for,
)
from pancam_graph.graph import (
    RIGID,
    Factors,
    FactorTemplate,
    HardTemplate,
    ProjectiveTemplate,
    SoftTemplate,
    UserFactors,
    check_given,
    given_factors,
)
from pancam_graph.initialise import FreeCameras, Start, in_turns_of_telemetry, start_from_telemetry
from pancam_graph.landmarks import (
    CameraViews,
    Landmarks,
    Measurements,
    lines_of_sight,
    rays_of,
    residuals,
    triangulate,
)
from pancam_graph.solve._alternation import AlternatingSolver
from pancam_graph.solve._constraints import require_constraints
from pancam_graph.solve._eliminated import EliminatedSolver
from pancam_graph.solve._explicit import ExplicitSolver
from pancam_graph.solve._optimise import Iteration
from pancam_graph.solve._options import Method, SolveOptions
from pancam_graph.solve._problem import Problem, Solver, reach_m

__all__ = [
    "Prepared",
    "Reasons",
    "free_numbers",
    "prepare",
    "solver_for",
    "template_for",
    "triangulated",
]

Reasons = NDArray[np.object_]
"""(observations,) why each was left out, in the words of `Solution.reason`; "" where it was not."""

_FEW = 0.1
"""Share of tracks seen from one place alone below which cameras that are variables do without them: their
cameras' distance is no more than a flex, and which way it goes decides where such a point fits."""
_ONE_PLACE_M = 5e-3
"""Largest distance of two cameras that count as being at one place."""

_SOLVERS: dict[Method, type[EliminatedSolver]] = {
    "joint": EliminatedSolver,
    "alternation": AlternatingSolver,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A traverse as a problem to solve: nothing is screened or adjusted yet."""

    traverse: Traverse
    """The input; it has observations."""
    options: SolveOptions
    sharing: Sharing
    """Which numbers of the rig are free, as the model takes them; fields in the final least squares alone."""
    problem: Problem
    """Cameras at the start, each landmark where it fits them best, every measurement accepted."""
    landmark_track: IntArray
    """(landmarks,) track number of each landmark of the problem."""
    noise: PixelNoise
    """Noise of all observations, as the traverse states it."""
    reason: Reasons
    """Observations that are no measurements of the problem: `outside` a camera's domain, or `single`."""
    is_near: bool
    """Whether the cameras of the start were given one by one, so that no rigid mast is fitted first."""
    warnings: tuple[str, ...]
    on_iteration: Callable[[Iteration], None] | None
    """Told of every iteration of the stages to come."""

    @property
    def observations(self) -> Observations:
        """The traverse's observations."""
        assert self.traverse.observations is not None  # `prepare` has looked
        return self.traverse.observations

    @property
    def given_sharing(self) -> Sharing | None:
        """What of the rig the user said is free; None where that is left to the rig's treatment."""
        return self.options.sharing or self.traverse.sharing

    @property
    def rescales_noise(self) -> bool:
        """Whether residuals decide how large the noise is, not the sigmas that observations came with."""
        wanted = self.options.rescale_noise
        return self.observations.origin == "images" if wanted is None else wanted


def prepare(
    traverse: Traverse,
    options: SolveOptions,
    start: Start | None = None,
    on_iteration: Callable[[Iteration], None] | None = None,
    factors: UserFactors | None = None,
) -> Prepared:
    """Observations of tracks that are seen twice or more as measurements, and first values of everything.

    `start` gives the first stops, angles and cameras; default: telemetry's. `factors` are the caller's own,
    on keys of `graph_keys`. Raises InputError for a traverse without observations, for given cameras that are
    not one an image, for sigmas too uneven, options that the traverse cannot serve, and for factors and
    constraints that fail; SolveError where no track is seen twice.
    """
    if traverse.observations is None:
        raise InputError(
            "observations: expected some, found none; find them in the images first (find_observations)"
        )
    traverse.observations.noise.require_even()
    start = in_turns_of_telemetry(start, traverse) if start else start_from_telemetry(traverse)
    cameras = start.cameras if options.model in {"free", "projective"} else None
    sharing = free_numbers(traverse, options)
    # Fields are far below what outliers are judged by, and have many columns: `fit` adds them at its end.
    template = template_for(traverse, options, replace(sharing, field=FIXED))
    solver_for(options).require(template)
    values = template.values(_first_state(traverse, start, cameras))
    few = _FEW if options.firm_tie == "soft" else 0.0
    views = template.views(values)
    measurements, track, reason, left_out = _measure(traverse.observations, views, from_one_place=few)
    n = measurements.n_landmarks
    problem = Problem(
        template=template,
        factors=_factors(template, values, factors),
        measurements=measurements,
        accepted=np.ones(len(measurements.row), dtype=bool),
        values=values,
        landmarks=Landmarks(vector=np.zeros((n, 4)), origin_m=np.zeros((n, 3))),
        stretches=_stretches(traverse, options),
    ).seen_by(views)
    require_constraints(traverse, options, problem)
    return Prepared(
        traverse=traverse,
        options=options,
        sharing=sharing,
        problem=triangulated(problem).placed(),
        landmark_track=track,
        noise=traverse.observations.noise,
        reason=reason,
        is_near=cameras is not None,
        warnings=(*traverse.warnings, *start.warnings, *left_out, *_turned_by_pans(traverse)),
        on_iteration=on_iteration,
    )


def solver_for(
    options: SolveOptions,
    on_iteration: Callable[[Iteration], None] | None = None,
    *,
    is_near: bool = False,
) -> Solver:
    """A new solver of the kind that the options ask for; `is_near`: its first fit starts near the optimum."""
    if options.landmarks == "explicit":
        return ExplicitSolver(on_iteration)
    return _SOLVERS[options.method](on_iteration, is_near=is_near)


def triangulated(problem: Problem) -> Problem:
    """Landmarks by linear triangulation; one behind a camera starts far off, where its cameras look."""
    m, views, weight = problem.measurements, problem.views, problem.accepted.astype(float)
    landmarks = triangulate(*rays_of(m, views), m.landmark, weight)
    _, in_front = residuals(landmarks, m, views)
    behind = np.bincount(m.landmark, ~in_front & (weight > 0), minlength=m.n_landmarks) > 0
    problem = problem.having(landmarks=landmarks)
    if not behind.any():
        return problem
    _, direction = rays_of(m, views)
    mean = np.add.reduceat(weight[:, None] * direction, m.starts)
    ahead = landmarks.moved_to(landmarks.origin_m + reach_m(problem)[:, None] * mean)
    vector = np.where(behind[:, None], ahead.vector, landmarks.vector)
    return problem.having(landmarks=replace(landmarks, vector=vector))


def free_numbers(traverse: Traverse, options: SolveOptions) -> Sharing:
    """Which numbers of the rig are free in the final least squares, as the model takes them.

    Raises InputError for a sharing that the model does not take, and for a rig that is to be considered where
    numbers of it are free.
    """
    given = options.sharing or traverse.sharing
    if options.rig == "considered" and given is not None and given.any_free:
        raise InputError(
            "rig: expected estimated or held where a sharing says what is free, found considered: it counts "
            "numbers that are not moved"
        )
    sharing = sharing_for(traverse.rig, options.model, options.rig, given)
    sharing = replace(sharing, field=_field(traverse, options, given))
    if sharing.flex == FIXED or options.firm_tie == "hard":
        return sharing
    if given is not None:
        raise InputError(
            "sharing: flex: expected fixed with a soft tie, whose sigma is another flex; "
            f"found {sharing.flex.scope}"
        )
    return replace(sharing, flex=FIXED)


def _field(traverse: Traverse, options: SolveOptions, given: Sharing | None) -> Freedom:
    """The freedom of smooth distortion fields. Raises InputError where the options cannot have one."""
    stated = FIXED if given is None else given.field
    if stated != FIXED and not options.takes_field:
        raise InputError(
            "sharing: field: expected fixed but with the model mast, a hard tie, eliminated landmarks and "
            f"the joint method; found {stated.scope}"
        )
    wanted = options.field
    if wanted is None:
        measured = traverse.observations is not None and traverse.observations.origin == "images"
        wanted = stated != FIXED or (
            given is None and options.rig == "estimated" and measured and options.takes_field
        )
    if not wanted:
        return FIXED
    return field_within(traverse.rig.uncertainty) if stated == FIXED else stated


def template_for(traverse: Traverse, options: SolveOptions, sharing: Sharing) -> FactorTemplate:
    """The rig as variables and factors, as the options have it."""
    if options.model == "projective":
        return ProjectiveTemplate(traverse, options.firm_flex, normalise=options.normalise)
    if options.firm_tie == "soft":
        return SoftTemplate(traverse, options.model, options.firm_flex, sharing)
    if options.landmarks == "eliminated":
        return HardTemplate(traverse, sharing)
    # GTSAM's projections want camera poses: a tie far below what images can tell makes them rigid.
    return SoftTemplate(traverse, options.model, RIGID, sharing)


def _first_state(traverse: Traverse, start: Start, cameras: FreeCameras | None) -> State:
    """The state at the start: cameras where they are given, or else where masts and angles put them."""
    rotations, centres = traverse.camera_poses(start.world_T_mast, start.pan_tilt_rad)
    rig = None
    if cameras is not None:
        if len(cameras.centre_m) != len(traverse.images):
            raise InputError(
                f"start: cameras: expected {len(traverse.images)}, one for each image, "
                f"found {len(cameras.centre_m)}"
            )
        rotations, centres = cameras.world_R_camera, cameras.centre_m
        rig = RigCorrection.to_calibrations(traverse, cameras.calibration)
    return State(
        world_T_mast=start.world_T_mast,
        pan_tilt_rad=start.pan_tilt_rad,
        world_R_camera=rotations,
        world_t_camera=centres,
        landmarks_m=np.zeros((0, 3)),
        rig=rig,
    )


def _stretches(traverse: Traverse, options: SolveOptions) -> int:
    """The number of stretches. Raises InputError where stops are fewer."""
    if options.stretches > max(len(traverse.stops), 1):
        raise InputError(
            f"stretches: expected no more than there are stops ({len(traverse.stops)}), "
            f"found {options.stretches}"
        )
    return options.stretches


def _factors(template: FactorTemplate, values: gtsam.Values, factors: UserFactors | None) -> Factors:
    """Priors and ties of the rig, and the caller's factors, each evaluated once at the start."""
    given = given_factors(factors, template.keys)
    check_given(given, template.seats(given), values)
    return template.factors(given)


def _measure(
    observations: Observations, views: CameraViews, *, from_one_place: float
) -> tuple[Measurements, IntArray, Reasons, list[str]]:
    """Observations of tracks seen twice or more, and the track of each landmark; of others reasons, warnings.

    Tracks seen from one place alone are left out where their share is below `from_one_place`. Raises
    SolveError where no track is seen twice.
    """
    valid = lines_of_sight(observations.image, observations.uv_px, views)[2]  # the lines are large
    order = _by_track(observations)
    tracks, valid = observations.track[order], valid[order]
    number: IntArray = np.cumsum(np.diff(tracks, prepend=tracks[:1]) > 0, dtype=np.int64)
    seen = np.bincount(number, valid)
    too_few = seen < 2
    if from_one_place > 0:
        centre_m = views.world_t_camera[observations.image[order[valid]]]
        at_one_place = (seen >= 2) & (_extent_m(centre_m, number[valid], len(seen)) < _ONE_PLACE_M)
        if np.count_nonzero(at_one_place) < from_one_place * np.count_nonzero(seen >= 2):
            too_few |= at_one_place
    single = valid & too_few[number]
    reason = np.full(len(observations), "", dtype=object)
    reason[order[~valid]], reason[order[single]] = "outside", "single"
    kept = np.flatnonzero(valid & ~single)
    if len(kept) == 0:
        raise SolveError("observations: expected tracks seen in two or more images, found none")
    rows, tracks = order[kept], tracks[kept]
    is_new = np.diff(tracks, prepend=tracks[:1]) > 0
    measurements = Measurements(
        row=rows,
        image=observations.image[rows],
        landmark=np.cumsum(is_new),
        uv_px=observations.uv_px.take(rows, axis=0),
        whitening=observations.noise.select(rows).whitening,
    )
    warnings = _left_out_warnings(number[single], int(np.count_nonzero(~valid)))
    return measurements, tracks[measurements.starts], reason, warnings


def _by_track(observations: Observations) -> IntArray:
    """Rows of observations (n,) sorted by track, and by image within a track."""
    track, image = observations.track, observations.image
    if np.all(image[1:] >= image[:-1]):
        return _ascending(track)
    by_image = _ascending(image)
    return by_image[_ascending(track[by_image])]


def _ascending(numbers: IntArray) -> IntArray:
    """Rows (n,) of whole numbers in ascending order, those of equal ones as they come.

    By 16 bits at a time, which NumPy sorts by counting: in a third of the time of comparisons.
    """
    if not len(numbers):
        return np.zeros(0, dtype=np.int64)
    # Unsigned differences are right whatever the numbers are.
    above = numbers.astype(np.uint64) - np.uint64(int(numbers.min()) % 2**64)
    order: IntArray = np.argsort(above.astype(np.uint16), kind="stable")
    for shift in range(16, int(above.max()).bit_length(), 16):
        digit = (above[order] >> np.uint64(shift)).astype(np.uint16)
        order = order[np.argsort(digit, kind="stable")]
    return order


def _extent_m(centre_m: FloatArray, track: IntArray, n_tracks: int) -> FloatArray:
    """Diagonal (tracks,) of the box about all cameras (n, 3) that see each track (n,), metres.

    Infinite for a track that none sees.
    """
    low, high = (np.full((n_tracks, 3), fill) for fill in (np.inf, -np.inf))
    np.minimum.at(low, track, centre_m)
    np.maximum.at(high, track, centre_m)
    return np.asarray(np.linalg.norm(high - low, axis=1))


def _turned_by_pans(traverse: Traverse) -> list[str]:
    """A warning of directions that cannot turn the drive, since the stop of their frame is held."""
    stop_of = {frame.id: frame.stop for frame in traverse.frames}
    seen = [stop_of[one.frame] for one in traverse.constraints if isinstance(one, FrameDirection)]
    held = [stop.id for stop in traverse.stops if stop.id in seen and not stop.sigma_rotation_rad]
    if not held:
        return []
    return [
        f"stop {', '.join(held)}: a frame-direction there turns pans, tilts and the rig, not the drive, "
        "which the stop holds (sigma_rotation_rad 0): a sigma above 0 lets the direction tell the heading"
    ]


def _left_out_warnings(single: IntArray, n_outside: int) -> list[str]:
    """Warnings of observations that are no measurements; `single` are the tracks of those that are alone."""
    warnings = []
    _, times = np.unique(single, return_counts=True)
    for n, text in (
        (int(np.count_nonzero(times == 1)), "seen once: left out, one ray places nothing"),
        (
            int(np.count_nonzero(times > 1)),
            "seen from one place alone: left out, free cameras make up its range",
        ),
    ):
        if n:
            warnings.append(f"{n} track{'s' if n != 1 else ''} {text}")
    if n_outside:
        warnings.append(f"{n_outside} observations outside the domain of their camera model: left out")
    return warnings
