"""From image files to observations: masks, features, pairs, matches, tracks."""

import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import in_order
from pancam_graph.data import Matching, Observations, PairMatching, StopMatching, Traverse, mean_sigma_px
from pancam_graph.images._between import StopTies
from pancam_graph.images._cache import Cache, digest
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._masks import ImageMask, Reason
from pancam_graph.images._match_pair import PairMatches
from pancam_graph.images._on_workers import Helpers, helped
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._placed import PlacedStops, TiedTracks
from pancam_graph.images._read import image_name, listed
from pancam_graph.images._steps import Progress, Steps

__all__ = ["Masks", "find_masks", "find_observations"]

_LOG = logging.getLogger(__name__)
_SURE_OVERLAP = 0.1
_SURE_DEPTH_M = 3.0
_OVER_EXPOSED = 0.3
_MOST = 0.5
_COLUMNS = ("image", "track", "uv_px", "covariance_px2")
_WHY = {
    Reason.USER: "is black in its mask",
    Reason.MISSING: "has no data",
    Reason.SATURATED: "is over-exposed",
    Reason.SKY: "is sky",
}


def find_observations(
    traverse: Traverse,
    options: FrontEndOptions = FrontEndOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
    cache: Path | None = None,
    client: Any = None,
) -> Traverse:
    """Find the same terrain points in the image files of a traverse.

    Features are matched between images that overlap by the pointing of telemetry (stops, pan, tilt and
    their standard deviations), and only where the camera models leave a place for them; then each pair's
    geometry is corrected by what most of its matches say, the matching is repeated in the narrower
    windows, and what is far from its epipolar line is left out. Stops that see in stereo are tied by the
    terrain that each of them places (see `StopMatcher`). The same files give the same observations to the
    last bit.

    Left out are pixels that the user's masks cover, missing and saturated pixels, and sky (see `find_masks`).
    Between stops the rover itself is left out too, and so are matches that stand still relative to the mast;
    within a stop, where the deck stands still, both are kept.

    `progress` is called with a stage, how many of its parts are done, and how many there are. `cache` is a
    folder in which each part is kept: a part whose inputs have not changed since an earlier run, even an
    interrupted one, is taken from there. The result is the same to the last bit.

    `client`, a distributed.Client, shares the work among the workers of a Dask cluster, which need the files
    of the traverse and the folder `cache` at the same paths. The result is the same to the last bit, whatever
    becomes of them.

    Returns the traverse with observations of origin "images", in place of any that it had, and with
    warnings for images without observations, or whose file cannot be used (missing, truncated, of another
    size than its camera), over-exposed or there twice, and for pairs of images that
    overlap, and of stops that are near, but give no matches.

    Raises InputError if no image has a file or nothing is found, and for a client without a cache, ImageError
    naming the file if none can be used, and for a mask that cannot; ClusterError for workers that cannot do
    the work, and where the scheduler or all workers are gone.
    """
    options = options_of(FrontEndOptions, options, "find_observations")
    work = Steps(traverse, options, progress, Cache(cache))
    with helped(client, work, cache) as helpers:
        return _found(PlacedStops(work), helpers)


def _found(placed: PlacedStops, helpers: Helpers | None) -> Traverse:
    """The traverse with observations; what helpers do before is not done here."""
    work = placed.work
    traverse, options = work.traverse, work.options
    if helpers is not None:
        placed.plan()
        helpers.do_all(placed)
    _make_masks(work)
    placed.plan()
    warnings = [*work.pictures.warnings, *_over_exposed(work)]
    _make_features(work)
    pairs = _match(work)
    far = replace(options, min_depth_m=max(options.min_depth_m, _SURE_DEPTH_M))
    for pair, report in zip(work.pairs, pairs, strict=True):
        if not report.kept and np.mean(pair.overlap(far, widened=False)) > _SURE_OVERLAP:
            names = traverse.images[pair.a].id, traverse.images[pair.b].id
            warnings.append(
                f"images {names[0]} and {names[1]}: no matches, although they overlap by pointing"
            )
    seen = {row for group in range(len(work.groups)) for row in work.tracks(group)["seen"].tolist()}
    unseen = [i for i in range(len(traverse.images)) if i not in seen]
    if not seen:
        why = [f"{image_name(traverse, i)}{_why_nothing(work, i)}" for i in unseen]
        raise InputError(
            f"images of {traverse.name}: expected features that several images share, found none "
            f"({len(work.pairs)} pairs overlap by pointing): {listed(why)}"
        )
    warnings += [
        f"image {image_name(traverse, i)}: no observations were found in it{_why_nothing(work, i)}"
        if traverse.images[i].file is not None
        else f"image {traverse.images[i].id}: it has no file"
        for i in unseen
        if i not in work.pictures.unusable
    ]
    _within_stops(work)
    tied, stops = dict[int, list[TiedTracks]](), list[StopMatching]()
    if work.stop_pairs:
        tied, stops = _between_stops(placed)
        untied = {(a, b) for a, b in work.stop_pairs} - {tuple(sorted((s.a, s.b))) for s in stops if s.kept}
        warnings += [
            f"stops {traverse.stops[a].id} and {traverse.stops[b].id}: no ties, although they may see the "
            "same terrain"
            for a, b in sorted(untied)
        ]
    observations = _observations(work, tied)
    work.cache.forget_others()
    matching = Matching(pairs=tuple(pairs), stops=tuple(stops))
    return traverse.with_observations(observations.with_points(traverse.points), warnings, matching=matching)


def find_masks(
    traverse: Traverse,
    options: FrontEndOptions = FrontEndOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
    cache: Path | None = None,
    client: Any = None,
) -> "Masks":
    """Which pixels of each image are left out, and why; None for an image without a file or a repeated one.

    Sky, saturated pixels and the rover are found in the images, unless `options.masks` is "user". The rover
    is what stands still relative to the mast between stops, in images in which an eye looks the same way at
    both. Memory holds them packed. Workers find them with a `client`. Raises as `find_observations` does.
    """
    options = options_of(FrontEndOptions, options, "find_masks")
    work = Steps(traverse, options, progress, Cache(cache))
    with helped(client, work, cache) as helpers:
        if helpers is not None:
            work.begin()
            helpers.do_masks(work)
        _make_masks(work)
    return Masks(work)


class Masks(Sequence[ImageMask | None]):
    """The masks of a drive by row, each unpacked when it is asked for.

    Another process gets them by pickling where they are in a cache.
    """

    def __init__(self, work: Steps) -> None:
        self._work = work

    def __len__(self) -> int:
        return len(self._work.traverse.images)

    def digest_of(self, row: int) -> str:
        """A digest of a picture and its mask."""
        return digest(self._work.pictures.digests[row], self._work.reasons(row))

    @overload
    def __getitem__(self, row: int) -> ImageMask | None: ...

    @overload
    def __getitem__(self, row: slice) -> Sequence[ImageMask | None]: ...

    def __getitem__(self, row: int | slice) -> ImageMask | Sequence[ImageMask | None] | None:
        rows = range(len(self))[row]
        return self._work.mask(rows) if isinstance(rows, int) else [self._work.mask(each) for each in rows]


def _make_masks(work: Steps) -> None:
    work.begin()
    in_order(work.figures, work.rows, lambda k, _: work.tell("masks", k + 1, len(work.rows)))


def _make_features(work: Steps) -> None:
    rows = work.rows

    def tell(k: int, found: int) -> None:
        _LOG.info("%s: %d features", work.traverse.images[rows[k]].id, found)
        work.tell("features", k + 1, len(rows))

    in_order(lambda row: len(work.features(row)), rows, tell)


def _match(work: Steps) -> list[PairMatching]:
    """Match all pairs; a report of each."""
    pairs, stop = work.pairs, work.traverse.image_stop
    # Stop by stop: features of neighbours are in memory together.
    order = sorted(range(len(pairs)), key=lambda k: (*sorted(stop[[pairs[k].a, pairs[k].b]])[::-1], k))

    def tell(k: int, report: PairMatching) -> None:
        names = work.traverse.images[report.a].id, work.traverse.images[report.b].id
        _LOG.info("%s, %s: %d matches %s", *names, report.kept, report.refusal.text)
        work.tell("matches", k + 1, len(pairs))

    reports = in_order(lambda k: _report(pairs[k], work.matches(pairs[k])), order, tell)
    return [report for _, report in sorted(zip(order, reports, strict=True), key=lambda each: each[0])]


def _within_stops(work: Steps) -> None:
    """Refine the tracks of all groups of stops."""
    parts = [(group, origin) for group in range(len(work.groups)) for origin in work.origins(group)]

    def refine(part: tuple[int, int]) -> None:
        work.refined(*part)

    in_order(refine, parts, lambda k, _: work.tell("refinement", k + 1, len(parts)))


def _between_stops(placed: PlacedStops) -> tuple[dict[int, list[TiedTracks]], list[StopMatching]]:
    """What ties between stops add to the tracks of each group, and a report of each pair of stops.

    A solve of its own places the terrain of each stop, which is then sought in the images of other stops. The
    result for each direction of each pair of stops is kept in the cache as soon as it is done.
    """
    work, directed = placed.work, placed.directed

    def place(group: int) -> None:
        placed.placed(group)

    in_order(place, placed.groups, lambda k, _: work.tell("terrain of the stops", k + 1, len(placed.groups)))

    def tell(k: int, tied: StopTies) -> None:
        report = tied.report
        names = work.traverse.stops[report.a].id, work.traverse.stops[report.b].id
        _LOG.info("%s in %s: %d ties, noise %.2f px", *names, report.kept, report.noise_px)
        work.tell("ties between stops", k + 1, len(directed))

    found = in_order(lambda stops: placed.ties(*stops), directed, tell)
    unit, tied, reports = placed.unit(), defaultdict[int, list[TiedTracks]](list), list[StopMatching]()
    for there, back in zip(found[::2], found[1::2], strict=True):
        for each in placed.agreeing(there, back):
            group, ties = placed.tied(each, unit)
            tied[group].append(ties)
            reports.append(each.report)
    return tied, reports


def _observations(work: Steps, tied: Mapping[int, Sequence[TiedTracks]]) -> Observations:
    """All observations, sorted by track, then image; tracks are numbered by the images in which they begin.

    `tied` has what images of other stops see of the tracks of a group. Memory holds the columns once, and
    those of one group more.
    """
    lengths, begins = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for group in range(len(work.groups)):
        own = work.observed(group)
        _, first, length = np.unique(own["track"], return_index=True, return_counts=True)
        for ties in tied.get(group, ()):
            np.add.at(length, ties.track, 1)
        lengths.append(length)
        begins.append(own["image"][first])
    length, begin = np.concatenate(lengths), np.concatenate(begins)
    order = np.argsort(begin, kind="stable")
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    start = np.cumsum(np.concatenate([[0], length[order]]))
    image, track = (np.empty(start[-1], dtype=np.int64) for _ in range(2))
    uv_px, covariance_px2 = np.empty((start[-1], 2)), np.empty((start[-1], 2, 2))
    n_tracks = 0
    for group in range(len(work.groups)):
        parts = [work.observed(group), *(vars(each) for each in tied.get(group, ()))]
        columns = {n: np.concatenate([p[n] for p in parts]) for n in _COLUMNS}
        by_track = np.lexsort((columns["image"], columns["track"]))
        columns = {n: column[by_track] for n, column in columns.items()}
        one = columns["track"]
        place = start[number[n_tracks + one]] + np.arange(len(one)) - np.searchsorted(one, one)
        image[place], track[place] = columns["image"], number[n_tracks + one]
        uv_px[place], covariance_px2[place] = columns["uv_px"], columns["covariance_px2"]
        n_tracks += 1 + int(one.max(initial=-1))
    return Observations(
        image=image,
        track=track,
        uv_px=uv_px,
        sigma_px=mean_sigma_px(covariance_px2),
        covariance_px2=covariance_px2,
        origin="images",
    )


def _over_exposed(work: Steps) -> list[str]:
    """A warning for each image of which much is saturated."""
    known = [(row, work.figures(row)) for row in range(len(work.traverse.images))]
    return [
        f"image {image_name(work.traverse, row)}: over-exposed, {figures.share[Reason.SATURATED]:.0%} of its "
        "pixels are saturated"
        for row, figures in known
        if figures is not None and figures.share[Reason.SATURATED] > _OVER_EXPOSED
    ]


def _why_nothing(work: Steps, row: int) -> str:
    """Why an image may have no observations, as the end of a sentence; empty where nothing is known."""
    if row in work.pictures.unusable:
        return f" ({work.pictures.unusable[row]})"
    figures = work.figures(row)
    if figures is None:
        return ""
    for reason, text in _WHY.items():
        if figures.share[reason] > _MOST:
            return f" ({figures.share[reason]:.0%} of it {text})"
    if not any(row in {pair.a, pair.b} for pair in work.pairs):
        return " (it overlaps no other image by pointing)"
    return f" (none of its {len(work.features(row))} features was found in another image)"


def _report(pair: PairGeometry, matched: PairMatches) -> PairMatching:
    return PairMatching(
        a=pair.a,
        b=pair.b,
        candidates=matched.candidates,
        rover=matched.rover,
        off_line=matched.off_line,
        kept=len(matched.matches),
        refusal=matched.refusal,
    )
