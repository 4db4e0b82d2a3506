"""Of the images of a folder those that are solved together: one rover, sites placed by each other."""

from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam

from pancam_graph.io._labelled_image import LabelledImage

__all__ = ["OneGroup", "counted", "named_files", "one_group"]

_NAMED = 30


@dataclass(frozen=True, kw_only=True, eq=False)
class OneGroup:
    """Images that are solved together, and what is said of the others."""

    images: tuple[LabelledImage, ...]
    """In the order in which they were given; rover poses in the frame of the first site of them."""
    warnings: tuple[str, ...]


def named_files(names: Sequence[str]) -> str:
    """Names of files, the first thirty of many."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def counted(count: int) -> str:
    """So many images, in words."""
    return "1 image" if count == 1 else f"{count} images"


def one_group(images: Sequence[LabelledImage], site_poses: Mapping[int, gtsam.Pose3]) -> OneGroup:
    """The largest group of images that can be solved together; the others are named, a warning a group.

    Together are images of one rover, of sites that labels or `site_poses` (`before_T_site`, z up, by site)
    place by each other, and of stops of which a label has the rover's place and attitude; a stop alone may be
    without.
    """
    warnings: list[str] = []

    def largest(
        images: Sequence[LabelledImage], key: Callable[[LabelledImage], Hashable], why: str
    ) -> list[LabelledImage]:
        groups: dict[Hashable, list[LabelledImage]] = defaultdict(list)
        for image in images:
            groups[key(image)].append(image)
        best = max(groups, key=lambda group: len(groups[group]))
        for group, others in groups.items():
            if group != best:
                files = named_files([image.file.name for image in others])
                said = why.format(
                    group=group, best=best, count=counted(len(others)), more=counted(len(groups[best]))
                )
                warnings.append(f"{said}: {files}")
        return groups[best]

    kept = largest(
        images,
        lambda image: image.host,
        "{count} of {group} left out, for a run is of one rover, {best} with {more} here",
    )
    before_T_site = {i.stop[0]: i.site_before_T_site for i in kept if i.site_before_T_site is not None}
    before_T_site |= site_poses
    sites = sorted({image.stop[0] for image in kept})
    firsts = {site: _first_reached(site, sites, before_T_site) for site in sites}
    kept = largest(
        kept,
        lambda image: firsts[image.stop[0]],
        "{count} of site {group} and what is placed by it left out, for nothing says where it is "
        "from site {best}, which has {more}",
    )
    first = firsts[kept[0].stop[0]]
    kept = [_in_site(image, first, before_T_site) for image in kept]
    posed = {image.stop: image for image in reversed(kept) if image.placed and image.levelled}
    if posed:
        without = [image.file.name for image in kept if image.stop not in posed]
        if without:
            warnings.append(
                f"{counted(len(without))} left out, for no label of their stop has the rover's place and "
                f"attitude: {named_files(without)}"
            )
        kept = [_with_pose_of(image, posed[image.stop]) for image in kept if image.stop in posed]
    else:
        kept = largest(
            kept,
            lambda image: image.stop,
            "{count} of site and drive {group} left out, for no label has the rover's attitude "
            "and place, so that stops are solved one by one, here {best} with {more}",
        )
    return OneGroup(images=tuple(kept), warnings=tuple(warnings))


def _first_reached(site: int, sites: Sequence[int], before_T_site: Mapping[int, gtsam.Pose3]) -> int:
    """The first of the sites to which poses lead from a site, step by step."""
    reached, step = site, site
    while step in before_T_site and step > sites[0]:
        step -= 1
        reached = step if step in sites else reached
    return reached


def _in_site(image: LabelledImage, first: int, before_T_site: Mapping[int, gtsam.Pose3]) -> LabelledImage:
    """The image with the rover's pose in the frame of another site."""
    pose = image.world_T_rover
    for site in range(image.stop[0], first, -1):
        pose = before_T_site[site] * pose
    return replace(image, world_T_rover=pose)


def _with_pose_of(image: LabelledImage, posed: LabelledImage) -> LabelledImage:
    if image.placed and image.levelled:
        return image
    return replace(image, world_T_rover=posed.world_T_rover, placed=True, levelled=True)
