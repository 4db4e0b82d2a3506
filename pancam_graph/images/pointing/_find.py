"""Pointing from pictures alone: turns between pairs of them, averaged, levelled, and fitted with the head."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from gtsam import Pose3

from pancam_graph.base.choices import some_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, IntArray, wrap_angle
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import in_order
from pancam_graph.cameras import Camera
from pancam_graph.data import UNKNOWN_RAD, Frame, Traverse
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._normalise import usable_mask
from pancam_graph.images._read import PictureFiles, Pictures, read_pictures
from pancam_graph.images.pointing._averaging import averaged, groups_of
from pancam_graph.images.pointing._head_fit import HeadFit, HeadState, Points, Priors, agreeing, fit_head
from pancam_graph.images.pointing._levelling import levelled
from pancam_graph.images.pointing._pair_turns import FocalRange, PairTurn, pair_turn
from pancam_graph.images.pointing._strong_features import StrongFeatures, alike, strong_features
from pancam_graph.rigs import Rig

__all__ = ["FoundPointing", "find_pointing"]

_LOG = logging.getLogger(__name__)
_FIRST = 500
"""Features of the first comparison, of all pictures with all."""
_PARTNERS = 20
"""Pictures that each is compared with in full, those with which the first comparison finds most alike."""
_LEAST_SHARED = 4
_ANY_FOCAL = 0.3
"""Standard deviation, as a share, from which on a focal length counts as not told."""
_ANY_SCALES = (0.4, 8.0)
_RANGE_SIGMAS = 4.0
_GOOD_FOCAL = 0.06
"""Standard deviation, as a share, up to which pairs are turned with the focal length as told: what of it is
wrong bends a narrow overlap by less than a short arm does."""
_FLOOR_RAD = float(np.deg2rad(0.5))
_FOCAL_FLOOR = 0.01
_SAFETY = 3.0
"""Factor of the formal sigmas, as errors of parallax and lens are alike in all points."""
_FEWEST = 12
"""Points with which a pair of pictures counts in the last fit."""
_UNTOLD_ARM_M, _ANY_ARM_M = 0.04, 0.15
"""Standard deviation of a mount's place from which on it counts as not told, and that of one that is not."""
_USUAL_ARM_M = 0.2
"""Length that an arm is taken to have whose direction alone is known."""
_ARM_LEFT_M = 0.02
"""Standard deviation of a mount's place after the fit: the scale of the scene stays as it is taken."""
_ROLL_RAD = 0.02
"""Least standard deviation of how a mount is rolled."""
_UNLIKE_A_HEAD_RAD = 0.2
_OFF_SIGMAS = 4.0

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundPointing:
    """A traverse with the pointing that its pictures tell."""

    traverse: Traverse
    """Frames that pictures join, and their images; its warnings name the others."""
    sources: tuple[str, ...]
    """Sentences about where pans, tilts and focal lengths come from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Matched:
    """Points that look alike in two pictures, on their planes z = 1."""

    a: int
    b: int
    planes: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Group:
    """Frames of one stop that pictures join, and how they point."""

    frames: IntArray
    number: IntArray
    """Of each frame of the traverse its row in `frames`; -1: not of the group."""
    fit: HeadFit
    pairs: Sequence[PairTurn]
    level_told: bool


def find_pointing(
    traverse: Traverse,
    options: FrontEndOptions = FrontEndOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
) -> FoundPointing:
    """The traverse with pans, tilts and focal lengths from its pictures alone, stop by stop.

    Frames whose pointing is known well keep it. What the others say of theirs serves as gauge and as a check:
    of pans told to within a radian or so, the median difference is taken off. Where none is told, the first
    frame of a stop has pan 0. The pan axis is vertical in the mast frame, which tells the tilts. Rigs are
    taken as told within their uncertainty; a focal length is replaced where the pictures know it better.
    Frames that nothing joins to the largest group of their stop are left out with a warning.

    Raises InputError for one of several stops of which no pan is told, for a stop of which no two pictures
    share anything, for pictures that no head can have taken that pans and tilts, and as `read_pictures` does.
    """
    options = options_of(FrontEndOptions, options, "find_pointing")
    tell = progress or (lambda stage, done, total: None)
    _require_gauge(traverse)
    pictures = read_pictures(traverse, partial(tell, "images"))
    features = _features(traverse, pictures, options, tell)
    if not any(map(len, features)):
        raise InputError(f"{traverse.name}: expected pictures with features, found none in any of them")
    if sum(map(bool, map(len, features))) < 2:
        raise InputError(
            f"{traverse.name}: expected two pictures or more, as one picture does not tell where it points; "
            "found one with features"
        )
    planes = [_plane(traverse, row, own) for row, own in enumerate(features)]
    groups, warnings = [], [*pictures.warnings]
    for stop in range(len(traverse.stops)):
        rows = [int(row) for row in np.flatnonzero(traverse.image_stop == stop) if len(features[row])]
        matched = _matched(traverse, rows, features, planes, options, tell)
        groups.append(_found(traverse, stop, rows, matched))
    return _with_groups(traverse, groups, warnings)


def _require_gauge(traverse: Traverse) -> None:
    """Raise InputError for one of several stops of which no pan is told: nothing says how it is turned."""
    for row, stop in enumerate(traverse.stops):
        told = [
            frame.sigma_pan_rad < UNKNOWN_RAD
            for frame, of in zip(traverse.frames, traverse.frame_stop, strict=True)
            if of == row
        ]
        if len(traverse.stops) > 1 and not any(told):
            raise InputError(
                f"stop {stop.id}: expected the pan of one of its pictures at least, as its pictures alone "
                "do not tell how it is turned to other stops; found none"
            )


def _features(
    traverse: Traverse, pictures: Pictures, options: FrontEndOptions, tell: Progress
) -> list[StrongFeatures]:
    files = PictureFiles(traverse, pictures)

    def find(row: int) -> StrongFeatures:
        if not pictures.has(row):
            return StrongFeatures.none()
        image, mask = files.samples(row), files.user_mask(row)
        usable = usable_mask(image)
        return strong_features(image, usable if mask is None else usable & mask, options)

    rows = range(len(traverse.images))
    return in_order(find, rows, lambda row, _: tell("features", row + 1, len(rows)))


def _camera(traverse: Traverse, row: int) -> Camera:
    return traverse.rig.eyes[int(traverse.image_eye[row])].camera


def _plane(traverse: Traverse, row: int, features: StrongFeatures) -> FloatArray:
    """Points (n, 2) of a picture's features on the plane z = 1, by the told camera; nan behind it."""
    rays = _camera(traverse, row).unproject(features.uv_px)
    z = np.where(rays.valid & (rays.direction[:, 2] > 1e-3), rays.direction[:, 2], np.nan)
    return np.asarray(rays.direction[:, :2] / z[:, None])


def _matched(
    traverse: Traverse,
    rows: Sequence[int],
    features: Sequence[StrongFeatures],
    planes: Sequence[FloatArray],
    options: FrontEndOptions,
    tell: Progress,
) -> list[_Matched]:
    """Points that look alike in pairs of pictures of different frames, of all pairs that promise some."""
    every = [(a, b) for a, b in combinations(rows, 2) if traverse.image_frame[a] != traverse.image_frame[b]]
    first = [own.first(_FIRST) for own in features]

    def shared(pair: tuple[int, int]) -> int:
        return len(alike(first[pair[0]], first[pair[1]], options)[0])

    counts = in_order(shared, every, lambda k, _: tell("comparing pictures", k + 1, len(every)))
    kept = _promising(every, counts)

    def matched(pair: tuple[int, int]) -> _Matched:
        a, b = pair
        of_a, of_b = alike(features[a], features[b], options)
        two = planes[a][of_a], planes[b][of_b]
        real = np.isfinite(two[0]).all(axis=1) & np.isfinite(two[1]).all(axis=1)
        return _Matched(a=a, b=b, planes=(two[0][real], two[1][real]))

    return in_order(matched, kept, lambda k, _: tell("matching pictures", k + 1, len(kept)))


def _found(traverse: Traverse, stop: int, rows: Sequence[int], matched: Sequence[_Matched]) -> _Group:
    """The largest group of frames of a stop that pictures join.

    Pairs tell the focal length first, each for itself; then the turns are sought at the length on which most
    agree, and again at that with which the whole group comes together.
    """
    sigma = traverse.rig.uncertainty.focal
    width = np.exp(_RANGE_SIGMAS * sigma)
    believed = FocalRange(low=1 / width, high=width)
    if sigma >= _ANY_FOCAL:
        believed = FocalRange(low=_ANY_SCALES[0], high=_ANY_SCALES[1])
    elif sigma <= _GOOD_FOCAL:
        believed = FocalRange(low=1.0, high=1.0)

    def turns(focal: FocalRange) -> list[PairTurn]:
        def turn(two: _Matched) -> PairTurn | None:
            return pair_turn(two.a, two.b, two.planes, focal, _field(traverse, two.a), len(matched))

        found = in_order(turn, matched, lambda *_: None)
        return [pair for pair in found if pair is not None]

    found = turns(believed)
    if not believed.fixed and found:
        scale = _agreed(found)
        _LOG.info("focal length over the told one, by pairs: %.4f", scale)
        found = turns(FocalRange(low=scale, high=scale))
    group = _grouped(traverse, stop, rows, found)
    return _refined(traverse, group, matched)


def _refined(traverse: Traverse, group: _Group, matched: Sequence[_Matched]) -> _Group:
    """The group with all points that come together as it stands, near ones among them."""
    frame, eye = group.number[traverse.image_frame], traverse.image_eye
    inside = [two for two in matched if min(frame[two.a], frame[two.b]) >= 0 and len(two.planes[0])]
    all_points = [
        PairTurn(
            a=two.a,
            b=two.b,
            b_R_a=np.eye(3),
            scale=1.0,
            sigma_scale=np.inf,
            plane_a=two.planes[0],
            plane_b=two.planes[1],
        )
        for two in inside
    ]
    points = Points.of(all_points, frame, eye, max(len(two.planes[0]) for two in inside))
    good = agreeing(traverse.rig, group.fit.state, points)
    pairs = []
    for k, pair in enumerate(all_points):
        rows = good[points.pair == k]
        if rows.sum() >= _FEWEST:
            pairs.append(replace(pair, plane_a=pair.plane_a[rows], plane_b=pair.plane_b[rows]))
    joined = groups_of([(int(frame[p.a]), int(frame[p.b])) for p in pairs], len(group.frames))[0]
    if len(joined) < len(group.frames):
        return group
    points = Points.of(pairs, frame, eye)
    fit = fit_head(traverse.rig, group.fit.state, points, _priors(traverse.rig), near=True)
    _LOG.info("arms over the told ones: %s m", fit.state.shift_m.round(3).tolist())
    return group if len(fit.wrong) else replace(group, fit=fit, pairs=pairs)


def _priors(rig: Rig) -> Priors:
    """How well a rig is known, for the fit of its head."""
    shift_m = float(np.hypot(rig.uncertainty.mount_m, rig.uncertainty.tilt_axis_m))
    return Priors(
        roll_rad=max(_ROLL_RAD, rig.uncertainty.mount_rad),
        scale=rig.uncertainty.focal,
        shift_m=_ANY_ARM_M if _arms_untold(rig) else shift_m,
    )


def _arms_untold(rig: Rig) -> bool:
    return rig.uncertainty.mount_m >= _UNTOLD_ARM_M


def _field(traverse: Traverse, row: int) -> float:
    """Solid angle of a picture."""
    camera = _camera(traverse, row).pinhole
    return camera.width_px * camera.height_px / (camera.fx_px * camera.fy_px)


def _promising(pairs: Sequence[tuple[int, int]], counts: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of which either picture has the other among its best partners."""
    kept: set[tuple[int, int]] = set()
    of_picture: dict[int, list[tuple[int, tuple[int, int]]]] = {}
    for pair, count in zip(pairs, counts, strict=True):
        if count >= _LEAST_SHARED:
            for row in pair:
                of_picture.setdefault(row, []).append((-count, pair))
    for partners in of_picture.values():
        kept |= {pair for _, pair in sorted(partners)[:_PARTNERS]}
    return sorted(kept)


def _agreed(pairs: Sequence[PairTurn]) -> float:
    """The focal length, over the told one, of most pairs: the median, weighted by what each knows."""
    log_scale = np.log([pair.scale for pair in pairs])
    weight = np.array([1 / np.hypot(pair.sigma_scale, 0.01) for pair in pairs])
    return float(np.exp(_median(log_scale, weight)))


def _grouped(traverse: Traverse, stop: int, rows: Sequence[int], pairs: list[PairTurn]) -> _Group:
    """The largest group of frames of a stop that pairs join, pairs that do not fit left out."""
    frame, eye = traverse.image_frame, traverse.image_eye
    name = traverse.stops[stop].id
    while pairs:
        joins = [(int(frame[p.a]), int(frame[p.b])) for p in pairs]
        frames = np.array(groups_of(joins, len(traverse.frames))[0])
        inside = [p for p, (a, _) in zip(pairs, joins, strict=True) if a in set(frames.tolist())]
        number = np.full(len(traverse.frames), -1)
        number[frames] = np.arange(len(frames))
        heads, turns, weight = _head_turns(traverse.rig, eye, number[frame], inside)
        level = levelled(averaged(heads, turns, weight, len(frames)))
        off = float(np.median(level.off_rad))
        if off > _UNLIKE_A_HEAD_RAD:
            raise InputError(
                f"stop {name}: expected pictures of a head that pans and tilts, which keeps its tilt axis "
                f"level; found it {np.rad2deg(off):.0f} degrees off: are the cameras rolled otherwise than "
                "the rig says?"
            )
        points = Points.of(inside, number[frame], eye)
        uncertainty = traverse.rig.uncertainty
        scale = np.log([np.median([p.scale for p in inside])] * len(traverse.rig.eyes))
        start = HeadState.of(level.pan_rad, level.tilt_rad, scale if uncertainty.focal > 0 else 0 * scale)
        fit = fit_head(traverse.rig, start, points, replace(_priors(traverse.rig), shift_m=0.0))
        if not len(fit.wrong):
            return _Group(frames=frames, number=number, fit=fit, pairs=inside, level_told=level.told)
        wrong = {id(inside[k]) for k in fit.wrong}
        _LOG.info("stop %s: %d pairs of %d do not fit the others", name, len(wrong), len(inside))
        pairs = [p for p in pairs if id(p) not in wrong]
    named = some_of([str(traverse.images[row].file) for row in rows])
    raise InputError(
        f"stop {name}: expected pictures that overlap, found no two that show the same things among {named}"
    )


def _head_turns(
    rig: Rig, eye: IntArray, frame: IntArray, pairs: Sequence[PairTurn]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Pairs (n, 2) of frames, turns (n, 3, 3) between their heads by the told mounts, and weights (n,)."""
    mounts = np.array([e.head_T_camera.rotation().matrix() for e in rig.eyes])
    a, b = (np.array([getattr(p, name) for p in pairs]) for name in ("a", "b"))
    turns = mounts[eye[b]] @ np.array([p.b_R_a for p in pairs]) @ np.swapaxes(mounts[eye[a]], 1, 2)
    weight = np.sqrt([len(p.plane_a) for p in pairs])
    return np.column_stack([frame[a], frame[b]]), turns, weight


def _with_groups(traverse: Traverse, groups: Sequence[_Group], warnings: list[str]) -> FoundPointing:
    frames: dict[int, Frame] = {}
    sources: list[str] = []
    for row, (stop, group) in enumerate(zip(traverse.stops, groups, strict=True)):
        told = [traverse.frames[k] for k in group.frames]
        pointed, more = _pointed(told, group)
        warnings += [f"stop {stop.id}: {sentence}" for sentence in more]
        frames |= dict(zip(group.frames.tolist(), pointed, strict=True))
        of_stop = np.flatnonzero(traverse.frame_stop == row).tolist()
        told_well = [k for k in of_stop if k not in frames and not traverse.frames[k].is_vague]
        frames |= {k: traverse.frames[k] for k in told_well}
        sources.append(
            f"pointing of stop {stop.id}: {len(pointed)} frames, from {len(group.pairs)} pairs of pictures "
            f"that overlap{_gauge(told)}"
        )
    images = [row for row in range(len(traverse.images)) if int(traverse.image_frame[row]) in frames]
    lost = [str(image.file) for row, image in enumerate(traverse.images) if row not in images]
    if lost:
        warnings.append(f"pictures that overlap with none of the largest group are left out: {some_of(lost)}")
    rig, about = _with_rig(traverse.rig, groups)
    return FoundPointing(
        traverse=replace(
            traverse,
            rig=rig,
            frames=tuple(frames[row] for row in sorted(frames)),
            images=tuple(traverse.images[row] for row in images),
            warnings=(*traverse.warnings, *warnings),
        ),
        sources=(*sources, *about),
    )


def _gauge(told: Sequence[Frame]) -> str:
    if all(frame.sigma_pan_rad >= UNKNOWN_RAD for frame in told):
        return f"; pan 0 is where {told[0].id} looks"
    return "; their common pan as told"


def _pointed(told: Sequence[Frame], group: _Group) -> tuple[list[Frame], list[str]]:
    """Frames as the pictures have them, turned to the pans that are told; and what does not fit these."""
    state, sigma = group.fit.state, group.fit.sigma
    pan = state.pan_rad - state.pan_rad[0]
    known = np.array([frame.sigma_pan_rad < UNKNOWN_RAD for frame in told])
    warnings = []
    if known.any():
        off = wrap_angle(np.array([frame.pan_rad for frame in told]) - pan)
        weight = np.array([1 / max(frame.sigma_pan_rad, _FLOOR_RAD) for frame in told])
        pan = pan + _circular_median(off[known], weight[known])
        odd = [
            f"{frame.id} ({np.rad2deg(wrap_angle(frame.pan_rad - p)):.0f} degrees)"
            for frame, p, k in zip(told, pan, known, strict=True)
            if k
            and abs(wrap_angle(frame.pan_rad - p)) > _OFF_SIGMAS * np.hypot(frame.sigma_pan_rad, _FLOOR_RAD)
        ]
        if odd:
            warnings.append(f"told pans disagree with the pictures, which are used: {some_of(odd)}")
    if not group.level_told:
        warnings.append(
            "the pictures look so nearly the same way that they do not tell which way the pan axis points; "
            "the mean tilt is taken as 0"
        )
    wide_pan, wide_tilt = (np.hypot(_FLOOR_RAD, _SAFETY * s) for s in (sigma.pan_rad, sigma.tilt_rad))
    frames = [
        replace(
            frame,
            pan_rad=float(wrap_angle(p)),
            tilt_rad=float(wrap_angle(t)),
            sigma_pan_rad=float(sp),
            sigma_tilt_rad=float(st),
        )
        if frame.is_vague
        else frame
        for frame, p, t, sp, st in zip(told, pan, state.tilt_rad, wide_pan, wide_tilt, strict=True)
    ]
    return frames, warnings


def _circular_median(angles: FloatArray, weight: FloatArray) -> float:
    """The angle with the least weighted sum of differences to the others."""
    apart = np.abs(wrap_angle(angles[:, None] - angles))
    nearest = float(angles[np.argmin(apart @ weight)])
    return nearest + _median(wrap_angle(angles - nearest), weight)


def _median(values: FloatArray, weight: FloatArray) -> float:
    """The weighted median of values (n,)."""
    order = np.argsort(values)
    below = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(below, below[-1] / 2)])


def _with_rig(rig: Rig, groups: Sequence[_Group]) -> tuple[Rig, list[str]]:
    """The rig with what pictures know better of it than was told: focal lengths, and arms that nobody told.

    Pans and tilts that pictures tell are no readings, and have no scale of their own.
    """
    largest = max(groups, key=lambda group: len(group.frames))
    uncertainty = replace(rig.uncertainty, pan_scale=0.0, tilt_scale=0.0)
    if rig.uncertainty.covariance is not None:
        return replace(rig, uncertainty=uncertainty), []
    eyes, sentences = list(rig.eyes), list[str]()
    sigma = float(np.hypot(_FOCAL_FLOOR, _SAFETY * largest.fit.sigma.log_scale.max()))
    if sigma < rig.uncertainty.focal:
        uncertainty = replace(uncertainty, focal=sigma)
        for row, scale in enumerate(np.exp(largest.fit.state.log_scale)):
            K = eyes[row].camera.pinhole.calibration_matrix.copy()
            K[:2, :2] *= scale
            eyes[row] = replace(eyes[row], camera=eyes[row].camera.with_calibration(K))
            sentences.append(
                f"camera {eyes[row].name}: focal length {K[0, 0]:.1f} px +- {100 * sigma:.1f} %, from the "
                "pictures"
            )
    if _arms_untold(rig):
        uncertainty = replace(uncertainty, mount_m=_ARM_LEFT_M, tilt_axis_m=_ARM_LEFT_M / 2)
        for row, shift_m in enumerate(_scaled(rig, largest.fit)):
            told = eyes[row].head_T_camera
            place_m = told.translation() + shift_m
            eyes[row] = replace(eyes[row], head_T_camera=Pose3(told.rotation(), place_m))
            forward_m, left_m, up_m = place_m
            sentences.append(
                f"camera {eyes[row].name}: {forward_m:.3f} m before, {left_m:.3f} m left of and {up_m:.3f} "
                f"m above the axes, +- {_ARM_LEFT_M:g} m, from the pictures, which tell the directions of "
                "arms and not their lengths: these are taken, and all distances go with them"
            )
    return replace(rig, eyes=tuple(eyes), uncertainty=uncertainty), sentences


def _scaled(rig: Rig, fit: HeadFit) -> FloatArray:
    """Shifts of mounts (eyes, 3), metres; where no place is told, the longest is of the usual length.

    0 where none is sure.
    """
    if any(np.any(eye.head_T_camera.translation()) for eye in rig.eyes):
        return fit.state.shift_m
    length = np.linalg.norm(fit.state.shift_m, axis=1)
    longest = int(np.argmax(length))
    if length[longest] <= _SAFETY * np.max(fit.sigma.shift_m[longest, :2]):
        return np.zeros_like(fit.state.shift_m)
    return np.asarray(fit.state.shift_m * (_USUAL_ARM_M / length[longest]))
