"""Opportunity's five Navcam frames with each model: residuals, the circle, formal and honest sigmas."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.running import Sample, attempt
from pancam_graph import (
    Solution,
    SolveOptions,
    Traverse,
    cross_validate,
    find_observations,
    read_input,
    solve,
)
from pancam_graph.base.geometry import FloatArray, pose_arrays
from pancam_graph.data import Splitting
from pancam_graph.graph import Model

__all__ = ["NAME", "OpportunityTask", "opportunity_folder"]

NAME = "Opportunity, sol 4087"


def opportunity_folder() -> Path | None:
    """The images, in the folder that PANCAM_GRAPH_SHARED names or in ../shared beside the checkout."""
    named = os.environ.get("PANCAM_GRAPH_SHARED")
    roots = [Path(named)] if named else []
    for root in (*roots, Path(__file__).resolve().parents[2].parent / "shared"):
        if (root / "data/opportunity_navcam_sol4087").is_dir():
            return root / "data/opportunity_navcam_sol4087"
    return None


@dataclass(frozen=True, kw_only=True)
class OpportunityTask:
    """All models on the same observations; options are the package's defaults but for the model."""

    folder: Path
    models: tuple[Model, ...]

    def run(self) -> list[Sample]:
        """Match the images once, solve and cross-validate with each model."""
        traverse = find_observations(read_input(self.folder))
        samples = []
        for model in self.models:
            options = SolveOptions(model=model, rig="held")
            metrics, failure = attempt(lambda o=options: _measured(traverse, o))  # type: ignore[misc]  # bound now
            samples.append(
                Sample(
                    experiment=NAME,
                    model=model,
                    sharing="fixed",
                    noise_px=None,
                    seed=0,
                    metrics=metrics,
                    failure=failure,
                )
            )
        return samples


def _measured(traverse: Traverse, options: SolveOptions) -> dict[str, float]:
    solution = solve(traverse, options)
    validated = cross_validate(traverse, options, solution=solution)
    length = np.linalg.norm(solution.residual_final_px[solution.used], axis=1)
    off = _off_circle_m(solution)
    metrics = {
        "observations_used": float(solution.used.sum()),
        "residual_rms_px": solution.rms_final_px,
        "residual_median_px": float(np.median(length)),
        "off_circle_radial_mm": 1e3 * float(np.abs(off[:, 0]).max()),
        "off_circle_out_of_plane_mm": 1e3 * float(np.abs(off[:, 1]).max()),
    }
    splittings: tuple[Splitting, ...] = ("random", "upper_lower")
    for splitting in splittings:
        measured, expected = validated.score_px(splitting)
        metrics[f"held_out_{splitting}_px"] = measured
        metrics[f"held_out_{splitting}_expected_px"] = expected
    sigmas = validated.relative_pointing
    for (i, j), formal, honest in zip(validated.pairs, sigmas.formal, sigmas.honest, strict=True):
        for k, angle in enumerate(("pan", "tilt")):
            metrics[f"relative_{angle}_formal_{i + 1}_{j + 1}_mrad"] = 1e3 * float(formal[k])
            metrics[f"relative_{angle}_honest_{i + 1}_{j + 1}_mrad"] = 1e3 * float(honest[k])
    return metrics


def _off_circle_m(solution: Solution) -> FloatArray:
    """(images, 2) how far each centre is outside its circle at the frame's tilt, and above its plane."""
    t, final = solution.traverse, solution.final
    masts_R, masts_t = (part[t.image_stop] for part in pose_arrays(final.world_T_mast))
    centre = np.einsum("iba,ib->ia", masts_R, final.world_t_camera - masts_t)
    tilt = final.pan_tilt_rad[t.image_frame, 1]
    circles = np.array([t.rig.circle(int(e), float(a)) for e, a in zip(t.image_eye, tilt, strict=True)])
    return np.column_stack(
        [np.hypot(centre[:, 0], centre[:, 1]) - circles[:, 0], centre[:, 2] - circles[:, 2]]
    )
