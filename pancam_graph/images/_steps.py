"""The steps of the front end, each done when first asked for, or taken from the cache.

The key of what a step keeps is a digest of its inputs and of the sources of all modules that it runs through,
so that an edit makes anew what it may change, and what follows from that.

A step is a cached property, which two threads must not ask for at once: before a step shares its work among
threads, it takes the steps that it needs into local names.
"""

import logging
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.sources import source_digest
from pancam_graph.base.threads import in_order
from pancam_graph.data import Observations, StopMatching, Traverse
from pancam_graph.images._alignment import Ties
from pancam_graph.images._between import (
    StopMatcher,
    StopTies,
    agreeing,
    joined,
    on_terrain,
    stereo_stops,
)
from pancam_graph.images._cache import Arrays, Cache, digest
from pancam_graph.images._features import Features, find_features
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._masks import ImageMask, Reason, elevation_rad, mask_image, pixels_at
from pancam_graph.images._match_pair import PairMatches, match_pair
from pancam_graph.images._overlap import near_stops, overlap_cells, overlapping_pairs
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._patch_noise import shared_by_tracks
from pancam_graph.images._read import Pictures, image_name, read_pictures
from pancam_graph.images._refine import RefinedTracks, refine_tracks
from pancam_graph.images._rover import find_rover, rover_partners
from pancam_graph.images._splines import Splines
from pancam_graph.images._terrain import terrain_arrays, terrain_from
from pancam_graph.solve import SolveOptions, solve

__all__ = ["Progress", "Steps", "step_key"]

_LOG = logging.getLogger(__name__)
_WORLD_UP = np.array([0.0, 0.0, 1.0])
_PATCH_PX = 8  # half width of the patch that refinement compares
_OVER_EXPOSED = 0.3
_MOST = 0.5
_WHY = {
    Reason.USER: "is black in its mask",
    Reason.MISSING: "has no data",
    Reason.SATURATED: "is over-exposed",
    Reason.SKY: "is sky",
}

Progress = Callable[[str, int, int], None]


_CALLS: dict[str, tuple[Callable[..., Any], ...]] = {
    "mask": (elevation_rad, mask_image, find_rover),
    "features": (find_features,),
    "matches": (overlapping_pairs, match_pair),
    "refined": (Splines, refine_tracks),
    "terrain": (solve, terrain_arrays),
    "ties": (Splines, terrain_from, on_terrain, StopMatcher),
}
"""What each step that keeps something calls: its key depends on all modules that these run through."""


def step_key(kind: str, *inputs: Any) -> str:
    """The key of a step with these inputs. Of this module and the cache's, only their own text counts."""
    return digest(kind, source_digest(*_CALLS[kind], alone=(__name__, digest.__module__)), *inputs)


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps, each computed when first asked for, or taken from the cache."""

    traverse: Traverse
    options: FrontEndOptions
    progress: Progress | None
    cache: Cache

    def tell(self, stage: str, done: int, total: int) -> None:
        if self.progress is not None:
            self.progress(stage, done, total)

    @cached_property
    def pictures(self) -> Pictures:
        return read_pictures(self.traverse, partial(self.tell, "images"))

    @cached_property
    def picture_keys(self) -> list[str]:
        """Digest of each image, its user's mask, and how it was taken; with the options and the rig.

        The rig counts with the sources of its lenses, which steps call without importing them.
        """
        traverse, pictures = self.traverse, self.pictures
        lenses = source_digest(*(type(eye.camera) for eye in traverse.rig.eyes))
        rig, options = digest(lenses, traverse.rig), digest(self.options)
        return [
            digest(rig, options, image, mask, entry.camera, traverse.frames[frame], traverse.stops[stop])
            for image, mask, entry, frame, stop in zip(
                pictures.images,
                pictures.user_masks,
                traverse.images,
                traverse.image_frame,
                traverse.image_stop,
                strict=True,
            )
        ]

    @cached_property
    def _all_pairs(self) -> tuple[list[PairGeometry], list[tuple[int, int]]]:
        """Pairs of images whose features are compared, and pairs of stops that their terrain ties."""
        pairs = self._overlapping(np.eye(len(self.traverse.stops), dtype=bool))
        stereo = stereo_stops(self.traverse, [(p.a, p.b) for p in pairs])
        near = near_stops(self.traverse, self.options)
        placed = near & stereo[:, None] & stereo
        if (near & ~placed).any():
            pairs += self._overlapping(near & ~placed)
        return pairs, [(a, b) for a, b in np.argwhere(np.triu(placed, 1)).tolist()]

    def _overlapping(self, stops: BoolArray) -> list[PairGeometry]:
        usable = [image is not None for image in self.pictures.images]
        pairs = overlapping_pairs(self.traverse, self.options, partial(self.tell, "overlaps"), stops=stops)
        return [pair for pair in pairs if usable[pair.a] and usable[pair.b]]

    @property
    def pairs(self) -> list[PairGeometry]:
        return self._all_pairs[0]

    @property
    def stop_pairs(self) -> list[tuple[int, int]]:
        return self._all_pairs[1]

    @cached_property
    def masks(self) -> list[ImageMask | None]:
        usable = np.array([image is not None for image in self.pictures.images])
        keys = self.picture_keys
        return in_order(
            lambda row: self._mask(row, usable, keys) if usable[row] else None,
            range(len(usable)),
            lambda row, _: self.tell("masks", row + 1, len(usable)),
        )

    def _mask(self, row: int, usable: BoolArray, picture_keys: list[str]) -> ImageMask:
        """Mask of an image; `usable` (images,) says which images have a picture."""
        image = self.pictures.images[row]
        assert image is not None  # it is usable
        automatic = self.options.masks == "automatic"
        partners = rover_partners(self.traverse, row, available=usable) if automatic else []

        def make() -> Arrays:
            elevation = elevation_rad(self.traverse, row)
            mask = mask_image(image, self.pictures.user_masks[row], elevation, automatic=automatic)
            rover = find_rover(self.traverse, row, self.pictures.images, partners, self.options)
            packed = zlib.compress(mask.with_rover(rover).reasons.tobytes(), 1)
            return {"reasons": np.frombuffer(packed, dtype=np.uint8)}

        key = step_key("mask", [picture_keys[i] for i in (row, *partners)])
        packed = self.cache.recall("mask", key, make)["reasons"]
        reasons = np.frombuffer(zlib.decompress(packed.tobytes()), dtype=np.uint8)
        return ImageMask(reasons=reasons.reshape(image.shape))

    @cached_property
    def mask_keys(self) -> list[str]:
        return [digest(None if mask is None else mask.reasons) for mask in self.masks]

    @cached_property
    def wanted(self) -> BoolArray:
        """Pieces of each image that any pair overlaps on."""
        return overlap_cells(self.traverse, self.pairs, self.options)

    @cached_property
    def feature_keys(self) -> list[str]:
        """Key of each image's features."""
        return [
            step_key(
                "features",
                picture_key,
                None if mask is None else mask.usable(between_stops=False),
                wanted,
            )
            for picture_key, mask, wanted in zip(self.picture_keys, self.masks, self.wanted, strict=True)
        ]

    @cached_property
    def features(self) -> list[Features]:
        """Features of each image where it overlaps others; none for an image without a file."""
        world_R_camera, _ = self.traverse.camera_poses()
        keys, masks, all_wanted = self.feature_keys, self.masks, self.wanted

        def find(i: int) -> Features:
            image, mask = self.pictures.images[i], masks[i]
            if image is None or mask is None:
                return Features.none()
            camera = self.traverse.rig.eyes[int(self.traverse.image_eye[i])].camera
            usable, up = mask.usable(between_stops=False), world_R_camera[i].T @ _WORLD_UP

            def make() -> Arrays:
                return vars(find_features(image, all_wanted[i], camera, up, self.options, usable=usable))

            return Features(**self.cache.recall("features", keys[i], make))

        def tell(i: int, features: Features) -> None:
            _LOG.info("%s: %d features", self.traverse.images[i].id, len(features))
            self.tell("features", i + 1, len(all_wanted))

        return in_order(find, range(len(all_wanted)), tell)

    @cached_property
    def _off_rover(self) -> list[IntArray]:
        """Rows of each image's features that may be matched with those of other stops."""
        rows = []
        for features, mask in zip(self.features, self.masks, strict=True):
            keep = np.zeros(len(features), dtype=bool)
            if mask is not None:
                keep = pixels_at(mask.usable(between_stops=True), features.uv_px)
            rows.append(np.flatnonzero(keep))
        return rows

    @cached_property
    def matches(self) -> list[PairMatches]:
        """Verified matches of each pair; those of two stops without the rover."""
        pairs, features, keys = self.pairs, self.features, self.feature_keys
        linking = any(not pair.same_stop for pair in pairs)
        off_rover = self._off_rover if linking else []

        def match(pair: PairGeometry) -> PairMatches:
            a, b = features[pair.a], features[pair.b]
            rows = None if pair.same_stop else (off_rover[pair.a], off_rover[pair.b])

            def make() -> Arrays:
                if rows is None:
                    return match_pair(pair, a, b, self.options).arrays()
                selected = match_pair(pair, a.select(rows[0]), b.select(rows[1]), self.options).arrays()
                return {**selected, "a": rows[0][selected["a"]], "b": rows[1][selected["b"]]}

            key = step_key("matches", keys[pair.a], keys[pair.b], rows)
            return PairMatches.of_arrays(self.cache.recall("matches", key, make))

        def tell(k: int, matched: PairMatches) -> None:
            pair = pairs[k]
            names = self.traverse.images[pair.a].id, self.traverse.images[pair.b].id
            _LOG.info("%s, %s: %d matches %s", *names, len(matched.matches), matched.refusal.text)
            self.tell("matches", k + 1, len(pairs))

        return in_order(match, pairs, tell)

    @cached_property
    def _spline(self) -> Splines:
        return Splines(self.pictures.images)

    def refined(
        self, image: IntArray, track: IntArray, uv_px: FloatArray, as_found_px: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Positions (n, 2) after least-squares matching, covariances (n, 2, 2), and which (n,) to leave out.

        See `refine_tracks`; left out are points that look unlike, where two images share enough others.

        One part of the work are the tracks that begin in one image. An observation keeps its position, to
        `as_found_px` (n,), if the patch around it, or around the first of its track, has pixels that are left
        out.
        """
        first = np.searchsorted(track, track)
        firsts = np.unique(image[first])
        rows_of = [np.flatnonzero(image[first] == origin) for origin in firsts]
        spline, picture_keys = self._spline, self.picture_keys

        def refine(rows: IntArray) -> Arrays:
            columns = image[rows], track[rows], uv_px[rows], as_found_px[rows]

            def make() -> Arrays:
                return vars(refine_tracks(self.traverse, spline, *columns, self.options))

            pictures = [picture_keys[i] for i in np.unique(image[rows])]
            key = step_key("refined", pictures, columns)
            return self.cache.recall("refined", key, make)

        parts = in_order(refine, rows_of, lambda k, _: self.tell("refinement", k + 1, len(firsts)))
        order = np.argsort(np.concatenate(rows_of))
        fitted = RefinedTracks(**{n: np.concatenate([p[n] for p in parts])[order] for n in parts[0]})
        clear = self._clear(image, track, fitted.uv_px) & self._clear(image, track, uv_px)
        clear &= clear[first]
        moved, unlike = fitted.moved & clear, fitted.unlike & clear
        as_found = as_found_px[:, None, None] ** 2 * np.eye(2)
        covariance = np.where((moved | unlike)[:, None, None], fitted.covariance_px2, as_found)
        frame = self.traverse.image_frame[image]
        covariance = shared_by_tracks(covariance, fitted.in_first_px2, moved, track, frame)
        return np.where(moved[:, None], fitted.uv_px, uv_px), covariance, fitted.spare & clear

    def tied(self, observations: Observations, feature: IntArray) -> tuple[Observations, list[StopMatching]]:
        """Observations within stops, with ties between stops added, and a report of each pair of stops.

        The observations are sorted by track, then image; `feature` (n,) is the row of each in its image's
        features. A solve of them places the terrain of each stop, which is then sought in the images of other
        stops. The result for each direction of each pair of stops is kept in the cache as soon as it is done.
        """
        traverse = replace(self.traverse, constraints=(), points=None).with_observations(observations)
        usable = [
            None if mask is None else mask.usable(between_stops=True, margin_px=_PATCH_PX)
            for mask in self.masks
        ]

        def place() -> Arrays:
            self.tell("terrain of the stops", 0, 1)
            # A rig that is off as its uncertainty says puts terrain where other stops do not see it;
            # fields are too small for that.
            solution = solve(traverse, SolveOptions(field=False))
            # A solve scales all noise by one factor, and the ties' noise must be in the same unit.
            unit = np.median(observations.sigma_px / solution.sigma_px)
            self.tell("terrain of the stops", 1, 1)
            return {**terrain_arrays(solution), "unit": np.array(unit)}

        noise = observations.covariance_px2
        columns = observations.image, observations.track, observations.uv_px, noise, feature
        inputs = self.picture_keys, self.mask_keys, self.traverse.stops, columns
        key = step_key("terrain", *inputs)
        placed = self.cache.recall("terrain", key, place)
        unit = float(placed.pop("unit"))
        terrain = terrain_from(traverse, **placed)
        terrain = terrain.select(on_terrain(usable, terrain.image, terrain.uv_px))
        matcher = StopMatcher(
            terrain=terrain,
            spline=self._spline,
            usable=usable,
            features=self.features,
            feature_of=feature,
            options=self.options,
        )

        def tie(stops: tuple[int, int]) -> StopTies:
            make = partial(_as_arrays, matcher, stops)
            tie_key = step_key("ties", key, stops)
            return StopTies.of_arrays(self.cache.recall("ties", tie_key, make))

        def tell(k: int, tied: StopTies) -> None:
            report = tied.report
            names = self.traverse.stops[report.a].id, self.traverse.stops[report.b].id
            _LOG.info("%s in %s: %d ties, noise %.2f px", *names, report.kept, report.noise_px)
            self.tell("ties between stops", k + 1, len(directed))

        directed = [d for a, b in self.stop_pairs for d in ((a, b), (b, a))]
        found = in_order(tie, directed, tell)
        both = [agreeing(terrain, *pair) for pair in zip(found[::2], found[1::2], strict=True)]
        stop_ties = [each for pair in both for each in pair]
        ties = Ties.concatenate([each.ties for each in stop_ties])
        ties = ties.scaled(np.full(len(ties), unit))
        return joined(observations, terrain, ties), [each.report for each in stop_ties]

    def _clear(self, image: IntArray, track: IntArray, uv_px: FloatArray) -> BoolArray:
        """Which observations (n,) have no left-out pixel in the patch around them."""
        stop = self.traverse.image_stop[image]
        low, high = (np.full(int(track.max()) + 1, fill) for fill in (len(self.traverse.stops), -1))
        np.minimum.at(low, track, stop)
        np.maximum.at(high, track, stop)
        linking = (low < high)[track]
        clear = np.ones(len(image), dtype=bool)
        for i in np.unique(image):
            mask = self.masks[i]
            assert mask is not None  # it has observations
            for between in (False, True):
                rows = np.flatnonzero((image == i) & (linking == between))
                if len(rows):
                    usable = mask.usable(between_stops=between, margin_px=_PATCH_PX)
                    clear[rows] = pixels_at(usable, uv_px[rows])
        return clear

    def over_exposed(self) -> list[str]:
        """A warning for each image of which much is saturated."""
        shares = [0.0 if mask is None else mask.share(Reason.SATURATED) for mask in self.masks]
        return [
            f"image {image_name(self.traverse, i)}: over-exposed, {share:.0%} of its pixels are saturated"
            for i, share in enumerate(shares)
            if share > _OVER_EXPOSED
        ]

    def why_nothing(self, row: int) -> str:
        """Why an image may have no observations, as the end of a sentence; empty where nothing is known."""
        if row in self.pictures.unusable:
            return f" ({self.pictures.unusable[row]})"
        mask = self.masks[row]
        if mask is None:
            return ""
        for reason, text in _WHY.items():
            share = mask.share(reason)
            if share > _MOST:
                return f" ({share:.0%} of it {text})"
        if not any(row in {pair.a, pair.b} for pair in self.pairs):
            return " (it overlaps no other image by pointing)"
        n_features = len(self.features[row].uv_px)
        return f" (none of its {n_features} features was found in another image)"


def _as_arrays(matcher: StopMatcher, stops: tuple[int, int]) -> Arrays:
    return matcher.ties(*stops).arrays()
