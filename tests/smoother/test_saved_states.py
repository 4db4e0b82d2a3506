"""Saved drives whose entries contradict each other are refused by name; nothing is ever unpickled."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pancam_graph import SimulationOptions, SmootherOptions, TraverseSmoother, simulate
from pancam_graph.base.errors import InputError
from pancam_graph.rigs import mer_navcam
from pancam_graph.smoother._incremental import stops_of
from support.fuzzing import Arrays, claiming, packed


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = SimulationOptions(
        stops=3, spacing_m=3.0, pans=2, tilts_rad=(-0.2,), sweep_rad=0.8, points_per_image=12, noise_px=0.3
    )
    traverse = simulate(mer_navcam(), options).traverse
    smoother = TraverseSmoother(traverse.rig, SmootherOptions(rig="held"))
    for part in stops_of(traverse):
        smoother.add_stop(*part)
    path = tmp_path_factory.mktemp("saved") / "drive.npz"
    smoother.save(path)
    return path


def put(name: str, row: int | tuple[int, int], value: float) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[name] = arrays[name].copy()
        arrays[name][row] = value

    return change


def header(*path: str, to: object) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        data: Any = json.loads(arrays["header"].tobytes())
        inner = data
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = to
        arrays["header"] = np.frombuffer(json.dumps(data).encode(), dtype=np.uint8)

    return change


def swapped_images(arrays: Arrays) -> None:
    images = json.loads(arrays["header"].tobytes())["traverse"]["images"]
    header("traverse", "images", to=images[::-1])(arrays)


CHANGES: dict[str, tuple[Callable[[Arrays], object], str]] = {
    "stop after itself": (put("after", 1, 1), "after, row 1: expected the number of a stop before, or -1"),
    "fate of no meaning": (put("fate", 3, 9), "fate, row 3: expected a number from 0 to "),
    "a landmark twice": (lambda a: a.update(track=a["track"] * 0), "track: expected different numbers"),
    "a landmark that nobody sees": (put("track", 2, 10**6), "track, row 2: expected a track with two"),
    "a track without a landmark": (
        lambda a: a.update({n: a[n][1:] for n in ("track", "home", "vector", "origin_m")}),
        "track: expected all tracks of observations in use",
    ),
    "home at no stop": (put("home", 0, 3), "home, row 0: expected the number of a stop"),
    "vector of length 0": (lambda a: a.update(vector=a["vector"] * 0), "vector, row 0: expected a vector of"),
    "vector of NaN": (put("vector", (4, 1), np.nan), "vector, row 4: expected a vector of length 1"),
    "origin beyond all": (put("origin_m", (4, 1), 1e300), "origin_m, row 4: expected a position in metres"),
    "another key": (put("key", 0, 7), "key: expected the keys of the drive's"),
    "another width": (put("width", 0, 5), "width, row 0: expected as many as the variable has"),
    "a mirrored mast": (put("value", -12, -3.0), "value: expected a rotation in each mast pose"),
    "an infinite value": (put("value", 0, np.inf), "value, row 0: expected a finite number"),
    "fewer landmarks": (lambda a: a.update(home=a["home"][1:]), r"home: expected shape \(\d+,\), found"),
    "pickled": (lambda a: a.update(home=a["home"].astype(object)), "home: expected numbers, found pickled"),
    "texts": (lambda a: a.update(home=a["home"].astype(str)), "home: expected integers, found <U"),
    "complex": (lambda a: a.update(value=a["value"] + 1j), "value: expected numbers, found complex128"),
    "an option": (header("options", "max_rounds", to=0), "options: max_rounds: expected 1 or more, found 0"),
    "an unknown option": (header("options", "x", to=0), "options.x: expected only keys of the format"),
    "an option of another type": (
        header("options", "telemetry", to=["odometry"]),
        "options.telemetry: expec",
    ),
    "a count below 0": (header("n_given", to=-1), "n_given: "),
    "a pixel that is none": (put("observations_uv_px", (0, 0), np.nan), "observations: uv_px, row 0"),
    "images out of order": (swapped_images, "traverse.images: expected those of one stop after another"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_a_state_that_contradicts_itself_is_refused_by_name(saved: Path, tmp_path: Path, case: str) -> None:
    change, said = CHANGES[case]
    with np.load(saved) as archive:
        arrays: Arrays = dict(archive)
    change(arrays)
    path = tmp_path / "drive.npz"
    path.write_bytes(packed(arrays))
    with pytest.raises(InputError, match=rf"^{path}: {said}"):
        TraverseSmoother.load(path)


@pytest.mark.parametrize("count", [10**6, 2**40, 2**62, 10**30])
def test_a_header_that_promises_too_much_is_refused(saved: Path, tmp_path: Path, count: int) -> None:
    with np.load(saved) as archive:
        arrays: Arrays = dict(archive)
    path = tmp_path / "drive.npz"
    path.write_bytes(claiming(arrays, "value", (count,)))
    with pytest.raises(
        InputError, match=rf"drive\.npz: value: expected a whole array, found .* \({count},\)"
    ):
        TraverseSmoother.load(path)


@pytest.mark.slow
def test_an_archive_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "drive.npz"
    np.savez_compressed(path, header=np.zeros(300_000_000, np.uint8))
    assert path.stat().st_size < 1_000_000
    with pytest.raises(
        InputError, match=r"expected an \.npz archive .* of at most 268435456 bytes, found 3000"
    ):
        TraverseSmoother.load(path)


def test_a_state_in_memory_is_checked_too(saved: Path) -> None:
    state = TraverseSmoother.load(saved).state()
    with pytest.raises(InputError, match="home, row 0: expected the number of a stop"):
        TraverseSmoother.of(replace(state, home=state.home + 100))


def test_a_drive_is_saved_with_what_becomes_of_its_rig(tmp_path: Path) -> None:
    options = SimulationOptions(
        stops=3, spacing_m=3.0, pans=2, tilts_rad=(-0.2,), sweep_rad=0.8, points_per_image=12
    )
    traverse = simulate(mer_navcam(), options).traverse
    parts = list(stops_of(traverse))
    whole = TraverseSmoother(traverse.rig, SmootherOptions(rig="estimated"))
    for part in parts[:2]:
        whole.add_stop(*part)
    whole.save(tmp_path / "drive.npz")
    read = TraverseSmoother.load(tmp_path / "drive.npz")
    assert read.options.rig == "estimated"
    assert read.rig.uncertainty == traverse.rig.uncertainty
    for smoother in (whole, read):
        smoother.add_stop(*parts[2])
    found, expected = read.estimate().pan_tilt_rad, whole.estimate().pan_tilt_rad
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_drive_of_an_older_version_goes_on_with_its_rig_held(saved: Path, tmp_path: Path) -> None:
    with np.load(saved) as archive:
        arrays: Arrays = dict(archive)
    data: Any = json.loads(arrays["header"].tobytes())
    held = TraverseSmoother.load(saved)
    del data["options"]["rig"], data["traverse"]["rig"]["uncertainty"]
    arrays["header"] = np.frombuffer(json.dumps(data).encode(), dtype=np.uint8)
    path = tmp_path / "drive.npz"
    path.write_bytes(packed(arrays))
    older = TraverseSmoother.load(path)
    assert older.options.rig == "held"
    np.testing.assert_array_equal(older.estimate().pan_tilt_rad, held.estimate().pan_tilt_rad)
