"""`stereo.npz`: written beside the results, read again for terrain, refused where it is damaged."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pancam_graph import (
    SimulationOptions,
    Solution,
    SolveOptions,
    read_traverse,
    simulate,
    solve,
    write_results,
    write_traverse,
)
from pancam_graph.base.errors import InputError
from pancam_graph.data import StereoCovariance
from pancam_graph.results._refined_drive import read_drive
from pancam_graph.results._stereo import STEREO_FILE, read_stereo
from pancam_graph.rigs import rig_template
from pancam_graph.terrain import drive_of

DRIVE = SimulationOptions(
    stops=1, pans=3, sweep_rad=None, tilts_rad=(-0.3,), points_per_image=8, rig_error="none"
)


@pytest.fixture(scope="module")
def solution(tmp_path_factory: pytest.TempPathFactory) -> Solution:
    traverse = simulate(rig_template("mer-navcam"), DRIVE, seed=5).traverse
    folder = tmp_path_factory.mktemp("drive")
    write_traverse(traverse, folder)
    return solve(read_traverse(folder), SolveOptions(rig="held", loss="none", stereo_covariances=True))


@pytest.fixture(scope="module")
def out(solution: Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "out"
    write_results(solution, folder, report=False)
    return folder


def test_terrain_made_later_has_the_same_errors_in_common(solution: Solution, out: Path) -> None:
    read, made = read_drive(out).stereo, drive_of(solution).stereo
    assert read is not None and made is not None
    for name in ("left", "right", "extent", "depth_m"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    np.testing.assert_allclose(read.covariance, made.covariance, rtol=1e-6)
    nodes = read.of(int(made.left[1]), int(made.right[1]))
    assert nodes is not None
    np.testing.assert_array_equal(nodes.extent, made.extent[1])
    assert read.of(int(made.right[1]), int(made.left[1])) is None


def test_results_of_older_versions_have_none(solution: Solution, tmp_path: Path) -> None:
    assert read_stereo(tmp_path / STEREO_FILE, solution.traverse) is None


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("left", lambda a: a + 7, r"stereo\.npz: left: expected 3 rows of 6 images, found other numbers"),
        ("image_names", lambda a: a[::-1], r"image_names: expected those of .*, found others"),
        ("right", lambda a: a[::-1], r"left, right: expected pairs of images of one frame"),
        ("covariance", lambda a: -a, r"covariance: expected covariances, found numbers that are none"),
        ("right", lambda a: a[:2], r"right: expected 3 rows"),
        ("right", lambda a: a.astype(float), r"right: expected 3 rows"),
        ("covariance", lambda a: a[..., :5], r"covariance: expected 3 pairs of nodes .* found the shape"),
        ("covariance", lambda a: a * np.nan, r"covariance: expected finite numbers"),
        ("depth_m", lambda a: a[::-1], r"extent, depth_m: expected ascending numbers"),
        ("extent", lambda a: a[:, ::-1], r"extent, depth_m: expected ascending numbers"),
        ("extent", lambda a: a[:, :3], r"extent: expected the shape \(3, 4\), found \(3, 3\)"),
    ],
)
def test_a_damaged_file_is_refused(  # type: ignore[no-untyped-def]  # change: of any array
    solution: Solution, out: Path, tmp_path: Path, name: str, change, says: str
) -> None:
    with np.load(out / STEREO_FILE) as file:
        arrays = dict(file)
    arrays[name] = change(arrays[name])
    np.savez(tmp_path / STEREO_FILE, **arrays)
    with pytest.raises(InputError, match=says):
        read_stereo(tmp_path / STEREO_FILE, solution.traverse)


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_any_bytes_are_read_or_refused_with_a_sentence(
    solution: Solution, out: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray((out / STEREO_FILE).read_bytes())
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(0, 2000))] = data.draw(st.integers(0, 255))
    file = tmp_path_factory.mktemp("fuzz") / STEREO_FILE
    file.write_bytes(content[: data.draw(st.sampled_from([len(content), 700, 0]))])
    try:
        read = read_stereo(file, solution.traverse)
    except InputError as error:
        assert str(file) in str(error)
    else:
        assert isinstance(read, StereoCovariance)
