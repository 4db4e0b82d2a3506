"""Dense matching of rendered ground, against the depth of every pixel."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Pinhole
from pancam_graph.rigs import Rig, mer_navcam
from pancam_graph.simulate import RenderOptions, render
from pancam_graph.terrain._match import match
from support.small_worlds import smaller_worlds

SIZE_PX = 512


def smaller(rig: Rig) -> Rig:
    """The rig with as many pixels a radian, and a smaller field."""
    eyes = []
    for eye in rig.eyes:
        camera = eye.camera
        assert isinstance(camera, Pinhole)
        middle = (SIZE_PX - 1) / 2
        eyes.append(
            replace(
                eye, camera=replace(camera, width_px=SIZE_PX, height_px=SIZE_PX, cx_px=middle, cy_px=middle)
            )
        )
    return replace(rig, eyes=tuple(eyes))


def robust(off: FloatArray) -> float:
    return float(1.4826 * np.median(np.abs(off - np.median(off))))


@pytest.mark.slow
def test_rendered_ground_is_matched_better_than_semi_globally_and_errs_as_its_sigmas_say() -> None:
    with smaller_worlds():
        options = RenderOptions(stops=1, pans=1, tilts_rad=(-0.35,))
        rendering = render(smaller(mer_navcam()), options, seed=6)
        left, right = (rendering.image(row) for row in (0, 1))
        depths = [rendering.depth_m(row) for row in (0, 1)]
    camera, baseline_m = rendering.truth.rig.pinholes[0], 0.2
    truth, back = (camera.fx_px * baseline_m / depth for depth in depths)
    v, u = np.mgrid[:SIZE_PX, :SIZE_PX].astype(np.float32)
    there = cv2.remap(back.astype(np.float32), (u - truth).astype(np.float32), v, cv2.INTER_NEAREST)
    inner = (u > 4) & (u < SIZE_PX - 5) & (v > 4) & (v < SIZE_PX - 5) & (u - truth > 4)
    both = inner & (np.abs(there - truth) < 1)  # seen by both eyes
    everywhere = np.ones(left.shape, dtype=bool)
    found = match(left.astype(np.float32), right.astype(np.float32), (everywhere, everywhere), (0.0, 150.0))
    plain = cv2.StereoSGBM.create(
        numDisparities=160, blockSize=5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=5
    )
    wide = (cv2.copyMakeBorder(p, 0, 0, 160, 0, cv2.BORDER_REPLICATE) for p in (left, right))
    rough = plain.compute(*wide)[:, 160:].astype(float) / 16
    rough[rough <= 0] = np.nan
    near = both & (depths[0] > 2) & (depths[0] < 20)
    off = found.disparity_px - truth
    assert near.sum() > 50_000
    assert np.isfinite(off[near]).mean() > 0.98
    assert np.nanmean(np.abs(off[near]) > 1.5) < 0.005
    for nearest, farthest, share in ((0, 5, 0.7), (5, 12, 0.75)):
        ring = both & (depths[0] > nearest) & (depths[0] < farthest) & np.isfinite(off) & np.isfinite(rough)
        assert ring.sum() > 10_000
        assert robust(off[ring]) < share * robust((rough - truth)[ring])
    known = near & np.isfinite(off)
    squared = (off[known] / found.sigma_px[known]) ** 2
    assert 0.5 < np.mean(np.minimum(squared, 25)) < 2.0
    phase = truth[known] % 1
    bias = [np.median(off[known][(phase >= k / 8) & (phase < (k + 1) / 8)]) for k in range(8)]
    assert np.abs(bias - np.mean(bias)).max() < 0.015
    assert np.abs(np.mean(bias)) < 0.015
