"""Matching of one pair of images: match, correct the geometry, match again, verify."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.data import Refusal
from pancam_graph.images._features import Features
from pancam_graph.images._front_end_options import FrontEndOptions
from pancam_graph.images._match import Matches, beyond_chance, match_in_windows
from pancam_graph.images._pairs import PairGeometry, Segments
from pancam_graph.images._verify import PairFit, epipolar_px, fit_pair

__all__ = ["PairMatches", "match_pair"]

_TRUE_PX = 1.0
_HORIZON_RAD = np.deg2rad(3.0)
_DECK_PX = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class PairMatches:
    """Verified matches of two images, and counts of the rejected candidates; see `PairMatching`."""

    matches: Matches
    candidates: int
    rover: int
    off_line: int = 0
    refusal: Refusal = Refusal.NONE

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything as arrays, for the cache."""
        counts = [self.candidates, self.rover, self.off_line, int(self.refusal)]
        return {**vars(self.matches), "counts": np.array(counts)}

    @staticmethod
    def of_arrays(arrays: Mapping[str, NDArray[Any]]) -> "PairMatches":
        """The inverse of `arrays`."""
        candidates, rover, off_line, refusal = arrays["counts"].tolist()
        return PairMatches(
            matches=Matches(**{name: arrays[name] for name in ("a", "b", "distance")}),
            candidates=candidates,
            rover=rover,
            off_line=off_line,
            refusal=Refusal(refusal),
        )


def match_pair(
    pair: PairGeometry, features_a: Features, features_b: Features, options: FrontEndOptions
) -> PairMatches:
    """Verified matches of two images; none where what agrees could as well be chance.

    First the windows are as wide as telemetry is uncertain. The matches found correct the pair's geometry;
    then the windows are as wide as the correction is uncertain, which finds more matches, and the same ones
    wherever the pointing started from.
    """
    start = PairFit(p=pair.no_correction, root=np.diag(pair.sigma))
    segments = pair.segments(features_a.uv_px, start.p, start.root, options.search_slack_px, options)
    matched = _search(pair, features_a, features_b, segments, options)
    matches = matched.matches
    if len(matches) < options.min_pair_matches:
        return _refused(matched, Refusal.FEW_ALIKE)
    half_width = segments.far_radius_px[matches.a]
    uv_a, uv_b = features_a.uv_px[matches.a], features_b.uv_px[matches.b]
    fit = fit_pair(pair, uv_a, uv_b, start, float(half_width.max()), options)
    distance, _ = epipolar_px(pair, fit.p, uv_a, uv_b, options)
    # Wrong matches are spread evenly over their windows: this share of them agrees by chance.
    chance = np.minimum(1.0, _TRUE_PX * np.hypot(1.0, segments.magnification[matches.a]) / half_width)
    if not beyond_chance(distance < _TRUE_PX, chance, options):
        return _refused(matched, Refusal.CHANCE)

    segments = pair.segments(features_a.uv_px, fit.p, fit.root, options.guided_slack_px, options)
    matched = _search(pair, features_a, features_b, segments, options)
    matches = matched.matches
    if len(matches) < options.min_pair_matches:
        return _refused(matched, Refusal.FEW_GUIDED)
    uv_a, uv_b = features_a.uv_px[matches.a], features_b.uv_px[matches.b]
    fit = fit_pair(pair, uv_a, uv_b, fit, options.guided_slack_px, options)
    distance, _ = epipolar_px(pair, fit.p, uv_a, uv_b, options)
    on_line = distance < _threshold_px(distance, options)
    matched = replace(matched, matches=matches.select(on_line), off_line=int(np.count_nonzero(~on_line)))
    if len(matched.matches) < options.min_pair_matches:
        return _refused(matched, Refusal.FEW_ON_LINES)
    return matched


def _refused(matched: PairMatches, refusal: Refusal) -> PairMatches:
    return replace(matched, matches=Matches.none(), refusal=refusal)


def _threshold_px(distance_px: FloatArray, options: FrontEndOptions) -> float:
    # The median of |x| is 0.6745 sigma for a Gaussian. The floor keeps exact matches despite rounding.
    scale = float(np.median(distance_px)) / 0.6745
    return min(max(options.epipolar_scales * scale, options.sigma_px), options.max_epipolar_px)


def _search(
    pair: PairGeometry,
    features_a: Features,
    features_b: Features,
    segments: Segments,
    options: FrontEndOptions,
) -> PairMatches:
    matches = match_in_windows(features_a, features_b, segments, options)
    rover = np.zeros(len(matches), dtype=bool)
    if not pair.same_stop and len(matches):
        rover = _on_rover(pair, features_a.uv_px[matches.a], features_b.uv_px[matches.b], options)
    return PairMatches(
        matches=matches.select(~rover), candidates=len(matches), rover=int(np.count_nonzero(rover))
    )


def _on_rover(pair: PairGeometry, uv_a: FloatArray, uv_b: FloatArray, options: FrontEndOptions) -> BoolArray:
    """Which matches (n,) of two stops stand still relative to the mast: the rover itself.

    A match stands still if, within the pointing's uncertainty, it lies where a point fixed to the mast
    would, at any depth. Distant terrain does so too where the rover has not turned between the stops, so
    a match near or above the horizon is taken for terrain, also one on an antenna that rises so high.
    """
    fixed = replace(pair, rover_fixed=True)
    still = fixed.segments(uv_a, fixed.no_correction, np.diag(fixed.sigma), _DECK_PX, options)
    return np.asarray(still.holds(uv_b) & (pair.elevation_rad(uv_a) < -_HORIZON_RAD))
