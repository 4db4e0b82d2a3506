"""What files for other programs are made from."""

from dataclasses import dataclass, field

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Solution
from pancam_graph.io.vicar import PictureIdentity, picture_identities
from pancam_graph.results._ply import worst_sigma_m

__all__ = ["Source", "row_text", "source_of"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """A solution, or a drive as telemetry has it, and what else files of other programs say of it."""

    solution: Solution
    identities: tuple[PictureIdentity, ...]
    """Who each image is to the mission's programs."""
    point_sigma_m: FloatArray
    """(landmarks,) standard deviation of each landmark along its worst direction; NaN where unknown."""
    is_solved: bool
    """Whether it is a solution, and not telemetry alone."""
    warnings: list[str] = field(default_factory=list)
    """What writers could not say in their files, in sentences for the user; they add to it."""

    @property
    def name(self) -> str:
        """Name of the drive."""
        return self.solution.traverse.name

    def placed(self) -> list[int]:
        """Rows of the images that have a finite pose."""
        final = self.solution.final
        good = np.isfinite(final.world_R_camera).all(axis=(1, 2)) & np.isfinite(final.world_t_camera).all(
            axis=1
        )
        return np.flatnonzero(good).tolist()

    def body_T_camera(self, image: int) -> gtsam.Pose3:
        """The pose of an image's camera in the body's own frame, where the drive has a place on one.

        Else in the world.
        """
        final, site = self.solution.final, self.solution.traverse.site
        pose = gtsam.Pose3(gtsam.Rot3(final.world_R_camera[image]), final.world_t_camera[image])
        if site is None:
            return pose
        rotation, origin = site.body_frame
        return gtsam.Pose3(gtsam.Rot3(rotation), origin) * pose

    def range_m(self, image: int) -> float:
        """Median range of the landmarks that an image's camera sees in all its images; 10 m without any."""
        solution = self.solution
        observations = solution.traverse.observations
        if observations is None or not len(solution.landmark_track):
            return _USUAL_RANGE_M
        camera = solution.image_cameras[image]
        alike = np.array([c is camera for c in solution.image_cameras])
        rows = np.flatnonzero(solution.used & alike[observations.image] & (solution.landmark_row >= 0))
        points = solution.final.landmarks_m[solution.landmark_row[rows]]
        away = np.linalg.norm(points - solution.final.world_t_camera[observations.image[rows]], axis=1)
        away = away[np.isfinite(away)]
        return float(np.median(away)) if len(away) else _USUAL_RANGE_M


_USUAL_RANGE_M = 10.0


def row_text(values: FloatArray) -> str:
    """Numbers with all the digits of a double, with blanks between them."""
    return " ".join(repr(float(value)) for value in np.asarray(values).ravel())


def source_of(solution: Solution) -> Source:
    """The source of a solution that is in memory."""
    covariance = solution.landmark_covariance_m2
    n = len(solution.landmark_track)
    return Source(
        solution=solution,
        identities=picture_identities(solution.traverse),
        point_sigma_m=np.full(n, np.nan) if covariance is None else worst_sigma_m(covariance),
        is_solved=True,
    )
