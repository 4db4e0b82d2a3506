"""The steps of the front end within stops: of an image, a pair of images, and stops that are compared.

Each is asked for by its item alone, and is made when it is first asked for, or taken from the cache. It
loads the pictures, masks and features that it needs, and lets go of them: memory holds a bounded part of
them, however long the drive is (see `Held`). The key of what a step keeps is a digest of its inputs and of
the sources of all modules that it runs through, so that an edit makes anew what it may change, and what
follows from that.

Several threads may ask for items at once. What is known of the drive as a whole (`pictures`, `pairs`,
`wanted` and other cached properties) must be there before; see `Steps.plan`.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.sources import source_digest
from pancam_graph.data import Traverse
from pancam_graph.images._between import stereo_stops
from pancam_graph.images._cache import Arrays, Cache, digest, key_of
from pancam_graph.images._features import Features, find_features
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._held import Held
from pancam_graph.images._masks import ImageMask, Reason, elevation_rad, mask_image
from pancam_graph.images._match_pair import PairMatches, match_pair
from pancam_graph.images._overlap import near_stops, overlap_cells, overlapping_pairs
from pancam_graph.images._pairs import PairGeometry
from pancam_graph.images._patch_noise import shared_by_tracks
from pancam_graph.images._read import PictureFiles, Pictures, for_workers, read_pictures
from pancam_graph.images._refine import RefinedTracks, refine_tracks
from pancam_graph.images._rover import find_rover, rover_partners
from pancam_graph.images._splines import Splines
from pancam_graph.images._tracks import Links, apart_tracks, join_tracks, shared_still, spread_tracks
from pancam_graph.images._usable import pixels_at

__all__ = ["MaskFigures", "Progress", "Steps", "step_key"]

_WORLD_UP = np.array([0.0, 0.0, 1.0])
_PATCH_PX = 8  # half width of the patch that refinement compares
_HELD_MASK_BYTES = 64 << 20

Progress = Callable[[str, int, int], None]


_CALLS: dict[str, tuple[Callable[..., Any], ...]] = {
    "mask": (elevation_rad, mask_image, find_rover),
    "features": (find_features,),
    "matches": (overlapping_pairs, match_pair),
    "tracks": (join_tracks,),
    "refined": (Splines, refine_tracks),
    "observed": (pixels_at, shared_by_tracks, shared_still),
}
"""What each step that keeps something calls: its key depends on all modules that these run through."""


def step_key(kind: str, *inputs: Any) -> str:
    """The key of a step with these inputs. Of this module only its own text counts."""
    return key_of(kind, _CALLS[kind], (__name__,), *inputs)


@dataclass(frozen=True, kw_only=True)
class MaskFigures:
    """What is known of an image's mask without its pixels."""

    reasons: str
    """Digest of all of it."""
    within_stops: str
    """Digest of the pixels that are usable within a stop."""
    between_stops: str
    """Digest of the pixels that are usable between stops."""
    share: dict[Reason, float]
    """Share of the pixels that are left out, by the reason."""


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps for the items of one drive.

    Another process gets it by pickling: with the plan of the drive, without what memory holds.
    """

    traverse: Traverse
    options: FrontEndOptions
    progress: Progress | None
    cache: Cache
    _mask_keys: dict[int, str] = field(default_factory=dict)
    _figures: dict[int, MaskFigures] = field(default_factory=dict)
    _feature_keys: dict[int, str] = field(default_factory=dict)
    _track_keys: dict[int, str] = field(default_factory=dict)
    _observed_keys: dict[int, str] = field(default_factory=dict)

    def tell(self, stage: str, done: int, total: int) -> None:
        """Tell the caller that so many of the items of a stage are done."""
        if self.progress is not None:
            self.progress(stage, done, total)

    # The drive as a whole

    def begin(self) -> None:
        """Find out what masks need to know of the drive as a whole, so that threads may ask for them."""
        self.picture_keys, self.rows, self.has_picture, self._files  # noqa: B018  made when asked for

    def plan(self) -> None:
        """Find out what all steps need to know of the drive as a whole, so that threads may ask for items."""
        self.begin()
        self.wanted, self.groups, self._spline, self._usable  # noqa: B018  made when asked for

    def __getstate__(self) -> dict[str, Any]:
        """All but the caller's progress and what memory holds, with paths that hold in any folder."""
        left = ("_files", "_spline", "_usable")
        state = {**{k: v for k, v in vars(self).items() if k not in left}, "progress": None}
        state["traverse"] = for_workers(self.traverse)
        if "pictures" in state:
            masks = tuple(None if path is None else path.resolve() for path in self.pictures.masks)
            state["pictures"] = replace(self.pictures, masks=masks)
        return state

    @cached_property
    def pictures(self) -> Pictures:
        """What is known of the image files."""
        return read_pictures(self.traverse, partial(self.tell, "images"))

    @cached_property
    def rows(self) -> list[int]:
        """Rows of the images that have a picture, stop by stop: the order in which they are worked on."""
        order = np.argsort(self.traverse.image_stop, kind="stable").tolist()
        return [row for row in order if self.pictures.has(row)]

    @cached_property
    def has_picture(self) -> BoolArray:
        """Which images (images,) have a picture that is used."""
        return np.array([self.pictures.has(row) for row in range(len(self.traverse.images))])

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
                pictures.digests,
                pictures.mask_digests,
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
        has = self.pictures.has
        pairs = overlapping_pairs(self.traverse, self.options, partial(self.tell, "overlaps"), stops=stops)
        return [pair for pair in pairs if has(pair.a) and has(pair.b)]

    @property
    def pairs(self) -> list[PairGeometry]:
        """Pairs of images whose features are compared."""
        return self._all_pairs[0]

    @property
    def spline(self) -> Splines:
        """Spline coefficients of the pictures, by row and half octaves of blur."""
        return self._spline

    @property
    def stop_pairs(self) -> list[tuple[int, int]]:
        """Pairs of stops that the terrain of each ties."""
        return self._all_pairs[1]

    @cached_property
    def wanted(self) -> BoolArray:
        """Pieces of each image that any pair overlaps on."""
        return overlap_cells(self.traverse, self.pairs, self.options)

    @cached_property
    def groups(self) -> list[list[int]]:
        """Numbers of the pairs among stops that they connect, most often of one stop; by the first stop."""
        stop, n = self.traverse.image_stop, len(self.traverse.stops)
        ends = np.array([(stop[p.a], stop[p.b]) for p in self.pairs], dtype=np.int64).reshape(-1, 2)
        joined = scipy.sparse.coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(n, n))
        _, label = scipy.sparse.csgraph.connected_components(joined, directed=False)
        of_pair = label[ends[:, 0]]
        return [
            np.flatnonzero(of_pair == group).tolist() for group in dict.fromkeys(label) if group in of_pair
        ]

    @cached_property
    def _files(self) -> PictureFiles:
        return PictureFiles(self.traverse, self.pictures)

    @cached_property
    def _spline(self) -> Splines:
        return Splines(self._files.samples)

    # An image

    def mask(self, row: int) -> ImageMask | None:
        """Which pixels of an image are left out, and why; None without a picture."""
        if not self.pictures.has(row):
            return None
        camera = self.traverse.rig.eyes[int(self.traverse.image_eye[row])].camera
        packed = self._mask_arrays(row)["reasons"]
        reasons = np.frombuffer(zlib.decompress(packed.tobytes()), dtype=np.uint8)
        return ImageMask(reasons=reasons.reshape(camera.height_px, camera.width_px))

    def _mask_arrays(self, row: int) -> Arrays:
        def make() -> Arrays:
            automatic, samples = self.options.masks == "automatic", self._files.samples
            elevation, image = elevation_rad(self.traverse, row), samples(row)
            alone = mask_image(image, self._files.user_mask(row), elevation, automatic=automatic)
            rover = find_rover(self.traverse, row, image, samples, self._partners(row), self.options)
            mask = alone.with_rover(rover)
            digests = (mask.reasons, *(mask.usable(between_stops=between) for between in (False, True)))
            return {
                "reasons": np.frombuffer(zlib.compress(mask.reasons.tobytes(), 1), dtype=np.uint8),
                "digests": np.array([digest(each) for each in digests]),
                "share": np.array(list(mask.shares().values())),
            }

        if row not in self._mask_keys:
            pictures = [self.picture_keys[i] for i in (row, *self._partners(row))]
            self._mask_keys[row] = step_key("mask", pictures)
        return self.cache.recall("mask", self._mask_keys[row], make)

    def _partners(self, row: int) -> list[int]:
        """Images with which the rover is found in an image."""
        if self.options.masks != "automatic":
            return []
        return rover_partners(self.traverse, row, available=self.has_picture)

    def figures(self, row: int) -> MaskFigures | None:
        """What is known of an image's mask without its pixels; None without a picture."""
        if row not in self._figures and self.pictures.has(row):
            arrays = self._mask_arrays(row)
            reasons, within, between = arrays["digests"].tolist()
            share = dict(zip(Reason, arrays["share"].tolist(), strict=True))
            self._figures[row] = MaskFigures(
                reasons=reasons, within_stops=within, between_stops=between, share=share
            )
        return self._figures.get(row)

    def feature_key(self, row: int) -> str:
        """Key of an image's features."""
        if row not in self._feature_keys:
            figures = self.figures(row)
            within = None if figures is None else figures.within_stops
            self._feature_keys[row] = step_key("features", self.picture_keys[row], within, self.wanted[row])
        return self._feature_keys[row]

    def features(self, row: int) -> Features:
        """Features of an image where it overlaps others; none for an image without a picture."""
        if not self.pictures.has(row):
            return Features.none()

        def make() -> Arrays:
            camera = self.traverse.rig.eyes[int(self.traverse.image_eye[row])].camera
            world_R_camera, _ = self.traverse.camera_poses()
            mask, up = self.mask(row), world_R_camera[row].T @ _WORLD_UP
            assert mask is not None  # it has a picture
            usable = mask.usable(between_stops=False)
            samples, wanted = self._files.samples(row), self.wanted[row]
            return vars(find_features(samples, wanted, camera, up, self.options, usable=usable))

        return Features(**self.cache.recall("features", self.feature_key(row), make))

    def _off_rover(self, row: int, features: Features) -> IntArray:
        """Rows of an image's features that may be matched with those of other stops."""
        mask = self.mask(row)
        assert mask is not None  # it has a picture
        return np.flatnonzero(pixels_at(mask.usable(between_stops=True), features.uv_px))

    @cached_property
    def _usable(self) -> Held[int, BoolArray]:
        return Held[int, BoolArray](_HELD_MASK_BYTES, lambda usable: usable.nbytes)

    def usable(self, row: int) -> BoolArray:
        """Which pixels (height, width) of an image show terrain, a patch around them too."""

        def make() -> BoolArray:
            mask = self.mask(row)
            assert mask is not None  # it has observations
            return mask.usable(between_stops=True, margin_px=_PATCH_PX)

        return self._usable.get(row, make)

    # A pair of images

    def match_key(self, pair: PairGeometry) -> str:
        """Key of the matches of a pair."""
        between = None if pair.same_stop else [self._between(row) for row in (pair.a, pair.b)]
        return step_key("matches", self.feature_key(pair.a), self.feature_key(pair.b), between)

    def _between(self, row: int) -> str | None:
        figures = self.figures(row)
        return None if figures is None else figures.between_stops

    def matches(self, pair: PairGeometry) -> PairMatches:
        """Verified matches of a pair; those of two stops without the rover."""

        def make() -> Arrays:
            a, b = self.features(pair.a), self.features(pair.b)
            if pair.same_stop:
                return match_pair(pair, a, b, self.options).arrays()
            rows = self._off_rover(pair.a, a), self._off_rover(pair.b, b)
            selected = match_pair(pair, a.select(rows[0]), b.select(rows[1]), self.options).arrays()
            return {**selected, "a": rows[0][selected["a"]], "b": rows[1][selected["b"]]}

        return PairMatches.of_arrays(self.cache.recall("matches", self.match_key(pair), make))

    # Stops whose images are compared with each other

    def tracks(self, group: int) -> Arrays:
        """Tracks of the features of a group (see `groups`), as columns sorted by track, then image.

        `image`, `feature` (row among the image's features), `track` from 0 on, `origin` (the image in which
        the track begins), `uv_px` (n, 2) and `size_px`; and `seen`: rows of all images with features that
        another one shares, also where no track was kept.
        """
        pairs, options = [self.pairs[k] for k in self.groups[group]], self.options

        def make() -> Arrays:
            found = [_links(pair, self.matches(pair)) for pair in pairs]
            image, feature, track = join_tracks(Links.concatenate([links for links in found if links]))
            seen = np.unique(image)
            uv_px, size_px = np.empty((len(image), 2)), np.empty(len(image))
            for i in seen.tolist():
                rows, features = image == i, self.features(i)
                uv_px[rows], size_px[rows] = features.uv_px[feature[rows]], features.size_px[feature[rows]]
            kept = np.flatnonzero(apart_tracks(image, track, uv_px, options.min_apart_px))
            cameras = [self.traverse.rig.eyes[eye].camera for eye in self.traverse.image_eye]
            extent_px = np.array([[c.width_px, c.height_px] for c in cameras])
            spread = spread_tracks(image[kept], track[kept], uv_px[kept], extent_px, options.max_ties)
            kept = kept[spread]
            own = np.unique(track[kept], return_inverse=True)[1]
            return {
                "image": image[kept],
                "feature": feature[kept],
                "track": own,
                "origin": image[kept][np.searchsorted(own, own)],
                "uv_px": uv_px[kept],
                "size_px": size_px[kept],
                "seen": seen,
            }

        return self.cache.recall("tracks", self._track_key(group), make)

    def _track_key(self, group: int) -> str:
        if group not in self._track_keys:
            keys = [self.match_key(self.pairs[k]) for k in self.groups[group]]
            # The same pictures may have other rows in another drive.
            self._track_keys[group] = step_key("tracks", keys, self.rows_of(group))
        return self._track_keys[group]

    def origins(self, group: int) -> list[int]:
        """Rows of the images of a group in which tracks begin."""
        return [int(row) for row in np.unique(self.tracks(group)["origin"])]

    def refined(self, group: int, origin: int) -> Arrays:
        """The tracks of a group that begin in an image, after least-squares matching; see `refine_tracks`.

        Columns of `RefinedTracks`, and `row`: the rows of their observations among the group's.
        """
        rows, columns, key = self._to_refine(group, origin)

        def make() -> Arrays:
            return vars(refine_tracks(self.traverse, self._spline, *columns, self.options))

        return {**self.cache.recall("refined", key, make), "row": rows}

    def _to_refine(
        self, group: int, origin: int
    ) -> tuple[IntArray, tuple[IntArray, IntArray, FloatArray, FloatArray], str]:
        """Rows of a group's tracks that begin in an image, what is refined, and the key of the result."""
        tracks = self.tracks(group)
        rows = np.flatnonzero(tracks["origin"] == origin)
        own = {name: tracks[name][rows] for name in ("image", "track", "uv_px", "size_px")}
        number = np.unique(own["track"], return_inverse=True)[1]
        columns = own["image"], number, own["uv_px"], self._as_found_px(own)
        pictures = [self.picture_keys[i] for i in np.unique(own["image"])]
        return rows, columns, step_key("refined", pictures, columns)

    def _as_found_px(self, tracks: Arrays) -> FloatArray:
        return np.asarray(np.hypot(self.options.sigma_px, self.options.sigma_per_size * tracks["size_px"]))

    def observed(self, group: int) -> Arrays:
        """Observations within a group, as columns sorted by track, then image.

        `image`, `feature`, `track`, `uv_px` (n, 2), `sigma_px`, and `covariance_px2` (n, 2, 2). Points that
        look unlike are left out where two images share enough others. An observation keeps its position as it
        was found if the patch around it, or around the first of its track, has pixels that are left out.
        """

        def make() -> Arrays:
            tracks = self.tracks(group)
            image, track, uv_px = tracks["image"], tracks["track"], tracks["uv_px"]
            if not len(track):
                none = {"sigma_px": np.empty(0), "covariance_px2": np.empty((0, 2, 2))}
                return {**{name: tracks[name] for name in ("image", "feature", "track", "uv_px")}, **none}
            parts = [self.refined(group, origin) for origin in self.origins(group)]
            order = np.argsort(np.concatenate([part.pop("row") for part in parts]))
            fitted = RefinedTracks(**{n: np.concatenate([p[n] for p in parts])[order] for n in parts[0]})
            clear = self._clear(image, track, fitted.uv_px) & self._clear(image, track, uv_px)
            clear &= clear[np.searchsorted(track, track)]
            moved, unlike = fitted.moved & clear, fitted.unlike & clear
            as_found_px = self._as_found_px(tracks)
            as_found = as_found_px[:, None, None] ** 2 * np.eye(2)
            covariance = np.where((moved | unlike)[:, None, None], fitted.covariance_px2, as_found)
            frame = self.traverse.image_frame[image]
            covariance = shared_by_tracks(covariance, fitted.in_first_px2, moved, track, frame)
            used = shared_still(track, ~(fitted.spare & clear))
            return {
                "image": image[used],
                "feature": tracks["feature"][used],
                "track": np.unique(track[used], return_inverse=True)[1],
                "uv_px": np.where(moved[:, None], fitted.uv_px, uv_px)[used],
                "sigma_px": as_found_px[used],
                "covariance_px2": covariance[used],
            }

        return self.cache.recall("observed", self.observed_key(group), make)

    def observed_key(self, group: int) -> str:
        """Key of the observations within a group."""
        if group not in self._observed_keys:
            refined = [self._to_refine(group, origin)[2] for origin in self.origins(group)]
            masks = [self.reasons(row) for row in self.rows_of(group)]
            self._observed_keys[group] = step_key("observed", self._track_key(group), refined, masks)
        return self._observed_keys[group]

    def reasons(self, row: int) -> str | None:
        """Digest of an image's mask; None without a picture."""
        figures = self.figures(row)
        return None if figures is None else figures.reasons

    def rows_of(self, group: int) -> list[int]:
        """Rows of the images of a group that are compared with others, ascending."""
        return sorted({row for k in self.groups[group] for row in (self.pairs[k].a, self.pairs[k].b)})

    def _clear(self, image: IntArray, track: IntArray, uv_px: Any) -> BoolArray:
        """Which observations (n,) have no left-out pixel in the patch around them."""
        stop = self.traverse.image_stop[image]
        low, high = (np.full(int(track.max()) + 1, fill) for fill in (len(self.traverse.stops), -1))
        np.minimum.at(low, track, stop)
        np.maximum.at(high, track, stop)
        linking = (low < high)[track]
        clear = np.ones(len(image), dtype=bool)
        for i in np.unique(image).tolist():
            mask = self.mask(i)
            assert mask is not None  # it has observations
            for between in (False, True):
                rows = np.flatnonzero((image == i) & (linking == between))
                if len(rows):
                    usable = mask.usable(between_stops=between, margin_px=_PATCH_PX)
                    clear[rows] = pixels_at(usable, uv_px[rows])
        return clear


def _links(pair: PairGeometry, matched: PairMatches) -> Links | None:
    """The matches of a pair as links; None where there are none."""
    matches = matched.matches
    if not len(matches):
        return None
    return Links(
        image_a=np.full(len(matches), pair.a, dtype=np.int64),
        feature_a=matches.a,
        image_b=np.full(len(matches), pair.b, dtype=np.int64),
        feature_b=matches.b,
        distance=matches.distance,
    )
