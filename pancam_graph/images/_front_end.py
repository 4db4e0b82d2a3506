"""From image files to observations: masks, features, pairs, matches, tracks."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.options import options_of
from pancam_graph.data import Matching, Observations, PairMatching, StopMatching, Traverse
from pancam_graph.images._cache import Cache
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._masks import ImageMask
from pancam_graph.images._match import Matches
from pancam_graph.images._match_pair import PairMatches
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._read import image_name, listed
from pancam_graph.images._steps import Progress, Steps
from pancam_graph.images._tracks import Links, apart_tracks, join_tracks, shared_still, spread_tracks

__all__ = ["find_masks", "find_observations"]

_SURE_OVERLAP = 0.1
_SURE_DEPTH_M = 3.0


def find_observations(
    traverse: Traverse,
    options: FrontEndOptions = FrontEndOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
    cache: Path | None = None,
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

    Returns the traverse with observations of origin "images", in place of any that it had, and with
    warnings for images without observations, or whose file cannot be used (missing, truncated, of another
    size than its camera), over-exposed or there twice, and for pairs of images that
    overlap, and of stops that are near, but give no matches.

    Raises InputError if no image has a file or nothing is found, ImageError naming the file if none can be
    used, and for a mask that cannot.
    """
    options = options_of(FrontEndOptions, options, "find_observations")
    work = Steps(traverse, options, progress, Cache(cache))
    warnings = [*work.pictures.warnings, *work.over_exposed()]
    parts: list[Links] = []
    far = replace(options, min_depth_m=max(options.min_depth_m, _SURE_DEPTH_M))
    for pair, matched in zip(work.pairs, work.matches, strict=True):
        if len(matched.matches):
            parts.append(_links(pair, matched.matches))
        elif np.mean(pair.overlap(far, widened=False)) > _SURE_OVERLAP:
            names = traverse.images[pair.a].id, traverse.images[pair.b].id
            warnings.append(
                f"images {names[0]} and {names[1]}: no matches, although they overlap by pointing"
            )
    image, feature, track = join_tracks(Links.concatenate(parts))
    unseen = [i for i in range(len(traverse.images)) if i not in set(image.tolist())]
    if not len(track):
        why = [f"{image_name(traverse, i)}{work.why_nothing(i)}" for i in unseen]
        raise InputError(
            f"images of {traverse.name}: expected features that several images share, found none "
            f"({len(work.pairs)} pairs overlap by pointing): {listed(why)}"
        )
    warnings += [
        f"image {image_name(traverse, i)}: no observations were found in it{work.why_nothing(i)}"
        if traverse.images[i].file is not None
        else f"image {traverse.images[i].id}: it has no file"
        for i in unseen
        if i not in work.pictures.unusable
    ]
    uv_px, size_px = np.empty((len(image), 2)), np.empty(len(image))
    for i in np.unique(image):
        rows = image == i
        uv_px[rows] = work.features[i].uv_px[feature[rows]]
        size_px[rows] = work.features[i].size_px[feature[rows]]
    kept = np.flatnonzero(apart_tracks(image, track, uv_px, options.min_apart_px))
    cameras = [traverse.rig.eyes[eye].camera for eye in traverse.image_eye]
    extent_px = np.array([[c.width_px, c.height_px] for c in cameras])
    kept = kept[spread_tracks(image[kept], track[kept], uv_px[kept], extent_px, options.max_ties)]
    image, feature, uv_px, size_px = image[kept], feature[kept], uv_px[kept], size_px[kept]
    track = np.unique(track[kept], return_inverse=True)[1]
    as_found_px = np.hypot(options.sigma_px, options.sigma_per_size * size_px)
    uv_px, covariance, spare = work.refined(image, track, uv_px, as_found_px)
    used = shared_still(track, ~spare)
    image, feature, uv_px, as_found_px = image[used], feature[used], uv_px[used], as_found_px[used]
    track = np.unique(track[used], return_inverse=True)[1]
    observations = Observations(
        image=image, track=track, uv_px=uv_px, sigma_px=as_found_px, origin="images"
    ).with_covariance(covariance[used])
    stops: list[StopMatching] = []
    if work.stop_pairs:
        observations, stops = work.tied(observations, feature)
        untied = {(a, b) for a, b in work.stop_pairs} - {tuple(sorted((s.a, s.b))) for s in stops if s.kept}
        warnings += [
            f"stops {traverse.stops[a].id} and {traverse.stops[b].id}: no ties, although they may see the "
            "same terrain"
            for a, b in sorted(untied)
        ]
    work.cache.forget_others()
    pairs = tuple(_report(*each) for each in zip(work.pairs, work.matches, strict=True))
    matching = Matching(pairs=pairs, stops=tuple(stops))
    return traverse.with_observations(observations.with_points(traverse.points), warnings, matching=matching)


def find_masks(
    traverse: Traverse,
    options: FrontEndOptions = FrontEndOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> tuple[ImageMask | None, ...]:
    """Which pixels of each image are left out, and why; None for an image without a file or a repeated one.

    Sky, saturated pixels and the rover are found in the images, unless `options.masks` is "user". The rover
    is what stands still relative to the mast between stops, in images in which an eye looks the same way at
    both. Raises as `find_observations` does.
    """
    options = options_of(FrontEndOptions, options, "find_masks")
    return tuple(Steps(traverse, options, progress, Cache(cache)).masks)


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


def _links(pair: PairGeometry, matches: Matches) -> Links:
    return Links(
        image_a=np.full(len(matches), pair.a, dtype=np.int64),
        feature_a=matches.a,
        image_b=np.full(len(matches), pair.b, dtype=np.int64),
        feature_b=matches.b,
        distance=matches.distance,
    )
