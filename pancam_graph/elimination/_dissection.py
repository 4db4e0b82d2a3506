"""Nested dissection of a drive: stretches of stops that meet in a few stops alone.

Stops that hold two stretches together are *joints*. No landmark and no factor joins the interiors of two
stretches, so that a stretch meets others only in joints and in what all stops share. Eliminating one interior
after the other, and then the joints, solves the system of the whole drive (George 1973).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import IntArray
from pancam_graph.elimination._linkage import Linkage
from pancam_graph.landmarks import Measurements

__all__ = ["Dissection"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Dissection:
    """Groups of variables and landmarks of a drive, by stretches."""

    n: int
    """Number of stretches."""
    stage: IntArray
    """(groups,) stretch of each group of an interior; n for joints, n + 1 for what all stops share"""
    landmark: IntArray
    """(landmarks,) stretch of each"""

    @staticmethod
    def of(
        linkage: Linkage, m: Measurements, cliques: Iterable[Iterable[int]], *, n: int, n_stops: int
    ) -> "Dissection":
        """Some n stretches of successive stops, with about as many observations each.

        Groups from `n_stops` on are shared by all. `cliques` are sets of groups that factors join. Of what is
        seen from several stretches, or joined by a factor, stops of all but the first of these are joints.
        """
        n_groups = linkage.n_groups
        of_image = _stops_of_images(linkage, n_stops)
        seen = np.bincount(m.image, minlength=len(of_image))
        counts = np.zeros(n_groups)
        for stop in of_image.T:
            np.add.at(counts, stop[stop >= 0], seen[stop >= 0])
        middle = np.cumsum(counts) - 0.5 * counts
        stretch = (n * middle / max(counts.sum(), 1.0)).astype(np.int64).clip(max=n - 1)
        is_joint = np.zeros(n_groups, dtype=bool)
        home = np.full(m.n_landmarks, n, dtype=np.int32)
        by_image = [np.where(stop >= 0, stretch[stop], n).astype(np.int32) for stop in of_image.T]
        for own in by_image:
            np.minimum(home, np.minimum.reduceat(own[m.image], m.starts), out=home)
        for stop, own in zip(of_image.T, by_image, strict=True):
            is_later = (own[m.image] > home[m.landmark]) & (stop[m.image] >= 0)
            is_joint[stop[m.image[is_later]]] = True
        for clique in cliques:
            own = np.array([g for g in clique if g < n_stops], dtype=np.int64)
            if len(own):
                is_joint[own[stretch[own] > stretch[own].min()]] = True
        stage = np.where(is_joint, n, stretch)
        stage[n_stops:] = n + 1
        # Landmarks of constant cameras depend on no stop.
        return Dissection(n=n, stage=stage, landmark=np.where(home == n, 0, home).astype(np.int64))


def _stops_of_images(linkage: Linkage, n_stops: int) -> IntArray:
    """(images, most) groups of stops that each image depends on; -1 where it depends on fewer."""
    of_unit = [[g for g in groups if g < n_stops] for groups in linkage.unit_groups]
    most = max((len(groups) for groups in of_unit), default=0)
    out = np.full((len(of_unit), max(most, 1)), -1)
    for unit, groups in enumerate(of_unit):
        out[unit, : len(groups)] = groups
    return out[linkage.image_unit]
