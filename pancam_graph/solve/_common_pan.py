"""What hangs on telemetry's word that pans of a stop err independently of each other.

Images tell where cameras point: heading and pan in sum. A common error of all pans of a stop and the opposite
error of its heading look alike, so that only telemetry tells them apart; n pans that err independently say
their mean to a root of n of their sigma. An error d that all of them share moves the solution by C S^-1 a d:
a is 1 for pans, S the covariance of telemetry's errors, and C that of the solution.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pancam_graph.solve._telemetry_tests import StopTelemetry

__all__ = ["CommonPan", "common_pans"]


@dataclass(frozen=True, kw_only=True)
class CommonPan:
    """What a common error of all pans of a stop, as large as the sigma of one, would do unseen."""

    stop: int
    """Row of the stop."""
    sigma_rad: float
    """Of one pan, as telemetry states it (RMS over the frames): the size of the common error."""
    pan_rad: float
    """How far the pans would move, in the mean."""
    pan_sigma_rad: float
    """What the solution states of a pan (RMS)."""
    heading_rad: float
    """How far the heading would move; 0 where telemetry holds it."""
    heading_sigma_rad: float
    """What the solution states of the heading; 0 where telemetry holds it."""
    pointing_rad: float
    """How far cameras would turn: heading and pan in sum."""
    pointing_sigma_rad: float
    """What the solution states of that sum (RMS)."""

    @property
    def sigmas(self) -> float:
        """The larger move of pan and heading, in the solution's sigmas."""
        pan = abs(self.pan_rad) / self.pan_sigma_rad if self.pan_sigma_rad > 0 else 0.0
        is_known = self.heading_sigma_rad > 0
        return max(pan, abs(self.heading_rad) / self.heading_sigma_rad if is_known else 0.0)


def common_pans(telemetry: Sequence[StopTelemetry]) -> Iterator[CommonPan]:
    """Those of all stops with two pans or more that telemetry does not hold."""
    for one in telemetry:
        pans = np.flatnonzero(np.array(one.entry) == "pan")
        if len(pans) < 2:
            continue
        along = np.zeros(len(one.entry))
        along[pans] = sigma = float(np.sqrt(np.mean(one.sigma[pans] ** 2)))
        moved, C = one.posterior @ one.told(along), one.posterior
        variance = np.diag(C)[pans]
        heading = heading_variance = 0.0
        pointing_variance = variance
        if "heading" in one.entry:
            h = one.entry.index("heading")
            heading, heading_variance = float(moved[h]), float(C[h, h])
            pointing_variance = variance + 2 * C[pans, h] + heading_variance
        pan = float(np.mean(moved[pans]))
        yield CommonPan(
            stop=one.stop,
            sigma_rad=sigma,
            pan_rad=pan,
            pan_sigma_rad=float(np.sqrt(np.mean(variance))),
            heading_rad=heading,
            heading_sigma_rad=float(np.sqrt(heading_variance)),
            pointing_rad=pan + heading,
            pointing_sigma_rad=float(np.sqrt(np.mean(pointing_variance).clip(0.0))),
        )
