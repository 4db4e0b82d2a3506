"""The steps of the front end, each done when first asked for, or taken from the cache."""

import logging
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.images._between import near_stops, stereo_stops, tie_stops
from pancam_graph.images._cache import Arrays, Cache, digest
from pancam_graph.images._features import Features, find_features
from pancam_graph.images._masks import ImageMask, Reason, elevation_rad, mask_image, pixels_at
from pancam_graph.images._match import Matches
from pancam_graph.images._match_pair import match_pair
from pancam_graph.images._options import FrontEndOptions
from pancam_graph.images._overlap import overlap_cells, overlapping_pairs
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._read import Pictures, image_name, read_pictures
from pancam_graph.images._refine import refine_tracks
from pancam_graph.images._rover import find_rover, rover_partners
from pancam_graph.traverse import Observations, Traverse

__all__ = ["Progress", "Steps"]

_LOG = logging.getLogger(__name__)
_WORLD_UP = np.array([0.0, 0.0, 1.0])
_PATCH_PX = 8  # how far from its pixel a refined observation looks at the image
_OVER_EXPOSED = 0.3
_MOST = 0.5
_WHY = {
    Reason.USER: "is black in its mask",
    Reason.MISSING: "has no data",
    Reason.SATURATED: "is over-exposed",
    Reason.SKY: "is sky",
}

Progress = Callable[[str, int, int], None]


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
        """Digest of each image, its user's mask, and how it was taken; with the options."""
        traverse, pictures = self.traverse, self.pictures
        rig, options = digest(traverse.rig), digest(self.options)
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
        there = [image is not None for image in self.pictures.images]
        found = overlapping_pairs(self.traverse, self.options, partial(self.tell, "overlaps"), stops=stops)
        return [pair for pair in found if there[pair.a] and there[pair.b]]

    @property
    def pairs(self) -> list[PairGeometry]:
        return self._all_pairs[0]

    @property
    def stop_pairs(self) -> list[tuple[int, int]]:
        return self._all_pairs[1]

    @cached_property
    def masks(self) -> list[ImageMask | None]:
        images = self.pictures.images
        there = np.array([image is not None for image in images])
        found: list[ImageMask | None] = []
        for i in range(len(images)):
            found.append(self._mask(i, there) if there[i] else None)
            self.tell("masks", i + 1, len(images))
        return found

    def _mask(self, row: int, there: BoolArray) -> ImageMask:
        image = self.pictures.images[row]
        assert image is not None  # it is there
        automatic = self.options.masks == "automatic"
        partners = rover_partners(self.traverse, row, available=there) if automatic else []

        def make() -> Arrays:
            elevation = elevation_rad(self.traverse, row)
            mask = mask_image(image, self.pictures.user_masks[row], elevation, automatic=automatic)
            rover = find_rover(self.traverse, row, self.pictures.images, partners, self.options)
            packed = zlib.compress(mask.with_rover(rover).reasons.tobytes(), 1)
            return {"reasons": np.frombuffer(packed, dtype=np.uint8)}

        key = digest("mask", [self.picture_keys[i] for i in (row, *partners)])
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
        """Digest of all that each image's features depend on."""
        sums = zip(self.picture_keys, self.masks, self.wanted, strict=True)
        return [
            digest("features", key, None if mask is None else mask.usable(between_stops=False), wanted)
            for key, mask, wanted in sums
        ]

    @cached_property
    def features(self) -> list[Features]:
        """Of every image where it overlaps others; none for an image without a file."""
        world_R_camera, _ = self.traverse.camera_poses()
        features = []
        for i, (image, mask) in enumerate(zip(self.pictures.images, self.masks, strict=True)):
            if image is None or mask is None:
                features.append(Features.none())
            else:
                camera = self.traverse.rig.eyes[int(self.traverse.image_eye[i])].camera
                usable = mask.usable(between_stops=False)
                up = world_R_camera[i].T @ _WORLD_UP
                make = partial(
                    _as_arrays, find_features, image, self.wanted[i], camera, up, self.options, usable=usable
                )
                features.append(Features(**self.cache.recall("features", self.feature_keys[i], make)))
            _LOG.info("%s: %d features", self.traverse.images[i].id, len(features[i]))
            self.tell("features", i + 1, len(self.wanted))
        return features

    @cached_property
    def _off_rover(self) -> list[IntArray]:
        """Rows of each image's features that may be matched with those of other stops."""
        rows = []
        for found, mask in zip(self.features, self.masks, strict=True):
            keep = np.zeros(len(found), dtype=bool)
            if mask is not None:
                keep = pixels_at(mask.usable(between_stops=True), found.uv_px)
            rows.append(np.flatnonzero(keep))
        return rows

    def matches(self, pair: PairGeometry) -> Matches:
        """Verified matches of a pair; those of two stops without the rover."""
        a, b = self.features[pair.a], self.features[pair.b]

        def make() -> Arrays:
            if pair.same_stop:
                return _as_arrays(match_pair, pair, a, b, self.options)
            rows_a, rows_b = self._off_rover[pair.a], self._off_rover[pair.b]
            found = match_pair(pair, a.select(rows_a), b.select(rows_b), self.options)
            return {"a": rows_a[found.a], "b": rows_b[found.b], "distance": found.distance}

        rows = () if pair.same_stop else (self._off_rover[pair.a], self._off_rover[pair.b])
        key = digest("matches", self.feature_keys[pair.a], self.feature_keys[pair.b], rows)
        return Matches(**self.cache.recall("matches", key, make))

    def refined(self, image: IntArray, track: IntArray, uv_px: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Better positions, and which observations have one; see `refine_tracks`.

        Tracks are refined by the image of their first observation. Where the patch around an observation, or
        around the first of its track, has pixels that are left out, it stays as it was found.
        """
        first = np.searchsorted(track, track)
        found, refined = uv_px.copy(), np.zeros(len(image), dtype=bool)
        firsts = np.unique(image[first])
        for k, origin in enumerate(firsts):
            rows = np.flatnonzero(image[first] == origin)
            columns = image[rows], track[rows], uv_px[rows]

            def make(columns: tuple[IntArray, IntArray, FloatArray] = columns) -> Arrays:
                moved, good = refine_tracks(self.traverse, self.pictures.images, *columns, self.options)
                return {"uv_px": moved, "refined": good}

            pictures = [self.picture_keys[i] for i in np.unique(image[rows])]
            kept = self.cache.recall("refined", digest("refined", pictures, columns), make)
            found[rows], refined[rows] = kept["uv_px"], kept["refined"]
            self.tell("refinement", k + 1, len(firsts))
        clear = self._clear(image, track, found) & self._clear(image, track, uv_px)
        moved = refined & clear & clear[first] & (first != np.arange(len(first)))
        good = moved.copy()
        good[first[moved]] = True  # it stays where it was found: the others fit to it
        return np.where(moved[:, None], found, uv_px), good

    def tied(self, observations: Observations, feature: IntArray) -> tuple[Observations, list[str]]:
        """Observations within stops and those that `tie_stops` adds, and its warnings."""
        usable = [
            None if mask is None else mask.usable(between_stops=True, margin_px=_PATCH_PX)
            for mask in self.masks
        ]

        def make() -> Arrays:
            found, warnings = tie_stops(
                self.traverse.with_observations(observations),
                self.pictures.images,
                usable,
                self.features,
                feature,
                self.stop_pairs,
                self.options,
                partial(self.tell, "ties between stops"),
            )
            names = ("image", "track", "uv_px", "sigma_px")
            columns = {name: np.asarray(getattr(found, name)) for name in names}
            return {**columns, "warnings": np.array(warnings, dtype=str)}

        columns = observations.image, observations.track, observations.uv_px, observations.sigma_px, feature
        key = digest("ties", self.picture_keys, self.mask_keys, self.traverse.stops, columns)
        kept = self.cache.recall("ties", key, make)
        warnings = [str(text) for text in kept.pop("warnings")]
        return Observations(**kept, origin="images"), warnings

    def _clear(self, image: IntArray, track: IntArray, uv_px: FloatArray) -> BoolArray:
        """Whether no pixel is left out within a patch around each observation."""
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
        found = len(self.features[row].uv_px)
        return f" (none of its {found} features was found in another image)"


def _as_arrays(function: Callable[..., Features | Matches], *arguments: Any, **more: Any) -> Arrays:
    return dict(vars(function(*arguments, **more)))
