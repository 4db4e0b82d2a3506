"""Drives whose rig is calibrated in another drive of the same unit (scripts/uncertain_rigs.py)."""

import numpy as np
import pytest

pytest.importorskip("uncertain_rigs", reason="the script is part of the repository, not of the package")
from uncertain_rigs import measure  # isort: skip

from pancam_graph import SimulationOptions, SolveOptions
from pancam_graph.rigs import mer_navcam


@pytest.mark.slow
def test_a_drive_of_few_points_gains_by_the_rig_of_another() -> None:
    """Over 20 units: errors are smaller than without, and as large as their sigmas say."""
    few = SimulationOptions(stops=2, pans=4, points_per_image=10, sweep_rad=None)
    many = SimulationOptions(stops=1, points_per_image=60, sweep_rad=2 * np.pi)
    solving = SolveOptions(landmark_covariances=True)
    plain, calibrated = (
        [measure(mer_navcam(), "drawn", few, 5000 + i, solving, first) for i in range(20)]
        for first in (None, many)
    )
    for kind in ("pan", "tilt", "stop"):
        of_drives = [np.concatenate([d.errors[kind] for d in drives]) for drives in (plain, calibrated)]
        errors = [np.sqrt(np.mean(found**2)) for found in of_drives]
        assert errors[1] < (1.0 if kind == "stop" else 0.8) * errors[0]
        assert 0.8 < np.mean([np.mean(d.sigmas[kind] ** 2) for d in calibrated]) < 1.25
