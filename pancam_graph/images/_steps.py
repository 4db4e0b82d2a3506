"""The steps of the front end, each done when first asked for, or taken from the cache."""

import logging
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.threads import in_order
from pancam_graph.data import Observations, StopMatching, Traverse
from pancam_graph.images._alignment import Ties
from pancam_graph.images._between import StopMatcher, StopTies, joined, near_stops, on_terrain, stereo_stops
from pancam_graph.images._cache import Arrays, Cache, digest
from pancam_graph.images._features import Features, find_features
from pancam_graph.images._masks import ImageMask, Reason, elevation_rad, mask_image, pixels_at
from pancam_graph.images._match_pair import PairMatches, match_pair
from pancam_graph.images._options import FrontEndOptions
from pancam_graph.images._overlap import overlap_cells, overlapping_pairs
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._read import Pictures, image_name, read_pictures
from pancam_graph.images._refine import refine_tracks
from pancam_graph.images._rover import find_rover, rover_partners
from pancam_graph.images._splines import Splines
from pancam_graph.images._terrain import terrain_arrays, terrain_from
from pancam_graph.solve import solve

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
        there = np.array([image is not None for image in self.pictures.images])
        self.picture_keys  # noqa: B018  made here, by one thread
        return in_order(
            lambda i: self._mask(i, there) if there[i] else None,
            range(len(there)),
            lambda i, _: self.tell("masks", i + 1, len(there)),
        )

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
        self.feature_keys  # noqa: B018  made here, by one thread

        def find(i: int) -> Features:
            image, mask = self.pictures.images[i], self.masks[i]
            if image is None or mask is None:
                return Features.none()
            camera = self.traverse.rig.eyes[int(self.traverse.image_eye[i])].camera
            usable, up = mask.usable(between_stops=False), world_R_camera[i].T @ _WORLD_UP

            def make() -> Arrays:
                return vars(find_features(image, self.wanted[i], camera, up, self.options, usable=usable))

            return Features(**self.cache.recall("features", self.feature_keys[i], make))

        def tell(i: int, found: Features) -> None:
            _LOG.info("%s: %d features", self.traverse.images[i].id, len(found))
            self.tell("features", i + 1, len(self.wanted))

        return in_order(find, range(len(self.wanted)), tell)

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

    @cached_property
    def matches(self) -> list[PairMatches]:
        """Verified matches of each pair; those of two stops without the rover."""
        if any(not pair.same_stop for pair in self.pairs):
            self._off_rover  # noqa: B018  made here, by one thread
        self.features  # noqa: B018  the same

        def tell(k: int, found: PairMatches) -> None:
            pair = self.pairs[k]
            names = self.traverse.images[pair.a].id, self.traverse.images[pair.b].id
            _LOG.info("%s, %s: %d matches %s", *names, len(found.matches), found.refusal.text)
            self.tell("matches", k + 1, len(self.pairs))

        return in_order(self._matches, self.pairs, tell)

    def _matches(self, pair: PairGeometry) -> PairMatches:
        a, b = self.features[pair.a], self.features[pair.b]
        rows = None if pair.same_stop else (self._off_rover[pair.a], self._off_rover[pair.b])

        def make() -> Arrays:
            if rows is None:
                return match_pair(pair, a, b, self.options).arrays()
            found = match_pair(pair, a.select(rows[0]), b.select(rows[1]), self.options).arrays()
            return {**found, "a": rows[0][found["a"]], "b": rows[1][found["b"]]}

        key = digest("matches", self.feature_keys[pair.a], self.feature_keys[pair.b], rows)
        return PairMatches.of_arrays(self.cache.recall("matches", key, make))

    @cached_property
    def _spline(self) -> Splines:
        return Splines(self.pictures.images)

    def refined(self, image: IntArray, track: IntArray, uv_px: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Better positions, and which observations have one; see `refine_tracks`.

        Tracks are refined by the image of their first observation. Where the patch around an observation, or
        around the first of its track, has pixels that are left out, it stays as it was found.
        """
        first = np.searchsorted(track, track)
        firsts = np.unique(image[first])
        rows_of = [np.flatnonzero(image[first] == origin) for origin in firsts]

        def refine(rows: IntArray) -> Arrays:
            columns = image[rows], track[rows], uv_px[rows]

            def make() -> Arrays:
                moved, good = refine_tracks(self.traverse, self._spline, *columns, self.options)
                return {"uv_px": moved, "refined": good}

            pictures = [self.picture_keys[i] for i in np.unique(image[rows])]
            return self.cache.recall("refined", digest("refined", pictures, columns), make)

        self._spline  # noqa: B018  made here, by one thread
        parts = in_order(refine, rows_of, lambda k, _: self.tell("refinement", k + 1, len(firsts)))
        found, refined = uv_px.copy(), np.zeros(len(image), dtype=bool)
        for rows, part in zip(rows_of, parts, strict=True):
            found[rows], refined[rows] = part["uv_px"], part["refined"]
        clear = self._clear(image, track, found) & self._clear(image, track, uv_px)
        moved = refined & clear & clear[first] & (first != np.arange(len(first)))
        good = moved.copy()
        good[first[moved]] = True  # it stays where it was found: the others fit to it
        return np.where(moved[:, None], found, uv_px), good

    def tied(self, observations: Observations, feature: IntArray) -> tuple[Observations, list[StopMatching]]:
        """Observations within stops with what pairs of stops see of each other's terrain added.

        They are sorted by track, then image; `feature` says of which feature each is. A solve of these places
        the terrain of each stop. Each direction of each pair of stops is kept as soon as it is done.
        """
        traverse = self.traverse.with_observations(observations)
        usable = [
            None if mask is None else mask.usable(between_stops=True, margin_px=_PATCH_PX)
            for mask in self.masks
        ]

        def place() -> Arrays:
            self.tell("terrain of the stops", 0, 1)
            solution = solve(traverse)
            # A solve finds one factor for all noise: the ties' is stated in the units of the others'.
            unit = np.median(observations.sigma_px / solution.sigma_px)
            self.tell("terrain of the stops", 1, 1)
            return {**terrain_arrays(solution), "unit": np.array(unit)}

        columns = observations.image, observations.track, observations.uv_px, observations.sigma_px, feature
        key = digest("terrain", self.picture_keys, self.mask_keys, self.traverse.stops, columns)
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
            return StopTies.of_arrays(self.cache.recall("ties", digest("ties", key, stops), make))

        def tell(k: int, found: StopTies) -> None:
            report = found.report
            names = self.traverse.stops[report.a].id, self.traverse.stops[report.b].id
            _LOG.info("%s in %s: %d ties, noise %.2f px", *names, report.kept, report.noise_px)
            self.tell("ties between stops", k + 1, len(directed))

        directed = [d for a, b in self.stop_pairs for d in ((a, b), (b, a))]
        found = in_order(tie, directed, tell)
        ties = Ties.concatenate([f.ties for f in found])
        return joined(observations, terrain, ties, unit * ties.sigma_px), [f.report for f in found]

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


def _as_arrays(matcher: StopMatcher, stops: tuple[int, int]) -> Arrays:
    return matcher.ties(*stops).arrays()
