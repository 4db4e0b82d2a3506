"""From image files to observations: features, pairs, matches, tracks."""

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pancam_graph.errors import InputError
from pancam_graph.geometry import BoolArray
from pancam_graph.images._features import Features, find_features
from pancam_graph.images._match import Matches
from pancam_graph.images._match_pair import match_pair
from pancam_graph.images._options import FrontEndOptions
from pancam_graph.images._overlap import overlap_cells, overlapping_pairs
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._refine import refine_tracks
from pancam_graph.images._tracks import Links, join_tracks
from pancam_graph.io.image_files import GreyImage, read_eye_image
from pancam_graph.traverse import Observations, Traverse

__all__ = ["find_observations"]

_LOG = logging.getLogger(__name__)
_SURE_OVERLAP = 0.1
_SURE_DEPTH_M = 3.0
_WORLD_UP = np.array([0.0, 0.0, 1.0])

Progress = Callable[[str, int, int], None]


def find_observations(
    traverse: Traverse,
    options: FrontEndOptions = FrontEndOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
) -> Traverse:
    """Find the same terrain points in the image files of a traverse.

    Features are matched between images that overlap by the pointing of telemetry (stops, pan, tilt and
    their standard deviations), and only where the camera models leave a place for them; then each pair's
    geometry is corrected by what most of its matches say, the matching is repeated in the narrower
    windows, and what is far from its epipolar line is left out. The same files give the same observations
    to the last bit.

    Between stops, matches that stand still relative to the mast are left out, for that is how the rover
    sees its own deck; at one stop, where the deck stands still, they are kept.

    `progress` is called with a stage, how many of its parts are done, and how many there are.

    Returns the traverse with observations of origin "images", in place of any that it had, and with
    warnings for images without observations and for pairs that overlap but give no matches.

    Raises InputError if no image has a file or nothing is found, ImageError naming the file for
    one that cannot be read or has another size than its camera.
    """
    images = _read_images(traverse)
    pairs = [
        pair
        for pair in overlapping_pairs(traverse, options, _staged("overlaps", progress))
        if images[pair.a] is not None and images[pair.b] is not None
    ]
    features = _all_features(traverse, images, overlap_cells(traverse, pairs, options), options, progress)
    parts, warnings = [], []
    far = replace(options, min_depth_m=max(options.min_depth_m, _SURE_DEPTH_M))
    for k, pair in enumerate(pairs):
        matches = match_pair(pair, features[pair.a], features[pair.b], options)
        names = traverse.images[pair.a].id, traverse.images[pair.b].id
        _LOG.info("%s, %s: %d matches", *names, len(matches))
        if len(matches):
            parts.append(_links(pair, matches))
        elif np.mean(pair.overlap(far, widened=False)) > _SURE_OVERLAP:
            warnings.append(
                f"images {names[0]} and {names[1]}: no matches, although they overlap by pointing"
            )
        if progress is not None:
            progress("matches", k + 1, len(pairs))
    image, feature, track = join_tracks(Links.concatenate(parts))
    if not len(track):
        raise InputError(
            f"images of {traverse.name}: expected features that several images share, found none "
            f"({len(pairs)} pairs overlap by pointing)"
        )
    seen = np.unique(image)
    warnings += [
        f"image {im.id}: {'no observations were found in it' if im.file is not None else 'it has no file'}"
        for i, im in enumerate(traverse.images)
        if i not in seen
    ]
    uv_px, size_px = np.empty((len(image), 2)), np.empty(len(image))
    for i in seen:
        rows = image == i
        uv_px[rows] = features[i].uv_px[feature[rows]]
        size_px[rows] = features[i].size_px[feature[rows]]
    uv_px, refined = refine_tracks(traverse, images, image, track, uv_px, options)
    as_found = np.hypot(options.sigma_px, options.sigma_per_size * size_px)
    observations = Observations(
        image=image,
        track=track,
        uv_px=uv_px,
        sigma_px=np.where(refined, options.refined_sigma_px, as_found),
        origin="images",
    )
    return traverse.with_observations(observations, warnings)


def _staged(stage: str, progress: Progress | None) -> Callable[[int, int], None] | None:
    return None if progress is None else partial(progress, stage)


def _read_images(traverse: Traverse) -> list[GreyImage | None]:
    """Images as arrays; None for one without a file."""
    if all(image.file is None for image in traverse.images):
        raise InputError(f"traverse {traverse.name}: expected observations or image files, found neither")
    folder = traverse.folder or Path()
    found: list[GreyImage | None] = []
    for entry, eye in zip(traverse.images, traverse.image_eye, strict=True):
        if entry.file is None:
            found.append(None)
            continue
        found.append(read_eye_image(folder / entry.file, traverse.rig, int(eye)))
    return found


def _all_features(
    traverse: Traverse,
    images: list[GreyImage | None],
    wanted: BoolArray,
    options: FrontEndOptions,
    progress: Progress | None,
) -> list[Features]:
    """Features of every image where it overlaps others; none for an image without a file."""
    world_R_camera, _ = traverse.camera_poses()
    features = []
    for i, (image, eye) in enumerate(zip(images, traverse.image_eye, strict=True)):
        if image is None:
            features.append(Features.none())
        else:
            camera_up = world_R_camera[i].T @ _WORLD_UP
            camera = traverse.rig.eyes[eye].camera
            features.append(find_features(image, wanted[i], camera, camera_up, options))
        _LOG.info("%s: %d features", traverse.images[i].id, len(features[i]))
        if progress is not None:
            progress("features", i + 1, len(images))
    return features


def _links(pair: PairGeometry, matches: Matches) -> Links:
    return Links(
        image_a=np.full(len(matches), pair.a, dtype=np.int64),
        feature_a=matches.a,
        image_b=np.full(len(matches), pair.b, dtype=np.int64),
        feature_b=matches.b,
        distance=matches.distance,
    )
