"""Simulated clusters and traverses: the mast of MER's Navcam, with one eye or both."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pancam_graph import SimulationOptions, simulate
from pancam_graph.rigs import Rig, mer_navcam
from pancam_graph.simulate import Simulation

__all__ = ["LOOSE_PAN_RAD", "NOISES_PX", "Eyes", "Scenario", "navcam"]

NOISES_PX = (0.1, 0.2, 0.5, 1.0, 2.0)
Eyes = Literal["one eye", "both eyes"]

LOOSE_PAN_RAD = 0.02
"""Sigma of pan that solvers are given: fifteen times that of its errors, so that images decide."""
_FOCAL_ERROR, _MOUNT_ERROR_RAD, _MOUNT_ERROR_M = 3e-3, 5e-3, 2e-3
"""Sigmas of the errors of a slightly wrong rig: those of the package's priors."""
_STEP_RAD = np.deg2rad(20.0)
"""Pan from frame to frame. The field is 45 degrees: most points are seen by two frames, a strip by three;
that strip alone ties the depths of one pair of frames to those of the next. The centres are 5 cm apart."""
_TILT_RAD = float(np.deg2rad(-15.0))
"""Tilt of all frames, which shows the ground from 2 m on and the horizon."""


def navcam(eyes: Eyes) -> Rig:
    """MER's Navcam, or its left eye alone: 0.14 m from the pan axis."""
    rig = mer_navcam()
    return rig if eyes == "both eyes" else replace(rig, eyes=rig.eyes[:1])


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A simulated experiment; the same for all models and noises."""

    name: str
    eyes: Eyes
    stops: int = 1
    images: int = 18
    """Number of images of each stop."""
    spacing_m: float = 8.0
    points_per_image: int = 25
    reach_m: float = 20.0
    """Distance of the farthest points: two centres 5 cm apart see a parallax of 3 pixels there."""
    odometry: float = 0.06
    """Sigma of each component of a stop's place, as a share of the spacing."""
    rig_off: bool = False
    """Whether solvers are given a slightly wrong rig (focal lengths and mounts)."""

    def simulate(self, noise_px: float, seed: int) -> Simulation:
        """The simulation; between noises only the noise differs.

        Telemetry has errors of the rig's encoders (1.3 mrad) and of coarse odometry. Solvers are given the
        sigmas of these errors, except for pan (LOOSE_PAN_RAD).
        """
        frames = self.images // (2 if self.eyes == "both eyes" else 1)
        simulation = simulate(
            navcam(self.eyes),
            SimulationOptions(
                stops=self.stops,
                spacing_m=self.spacing_m,
                pans=frames,
                sweep_rad=min(frames * _STEP_RAD, 2 * np.pi),
                tilts_rad=(_TILT_RAD,),
                points_per_image=self.points_per_image,
                detection=0.8,
                reach_m=self.reach_m,
                noise_px=noise_px,
                sigma_stop_m=self.odometry * self.spacing_m,
                sigma_stop_rad=0.03,
                focal_error=_FOCAL_ERROR * self.rig_off,
                mount_error_rad=_MOUNT_ERROR_RAD * self.rig_off,
                mount_error_m=_MOUNT_ERROR_M * self.rig_off,
            ),
            seed=seed,
        )
        t = simulation.traverse
        loose = tuple(replace(f, sigma_pan_rad=LOOSE_PAN_RAD) for f in t.frames)
        return replace(simulation, traverse=replace(t, frames=loose))
