"""A drive that grows: a smoother that has its first stops goes on, and ends where all at once would."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph import SimulationOptions, SolveOptions, Traverse, TraverseSmoother, simulate
from pancam_graph.base.errors import InputError
from pancam_graph.cli import main
from pancam_graph.io import write_traverse
from pancam_graph.results import SMOOTHER_FILE
from pancam_graph.rigs import rig_template
from pancam_graph.smoother import continued, smoother_for, solve_incrementally
from support.small_drives import some_stops

DRIVE = SimulationOptions(
    stops=4, pans=4, sweep_rad=None, tilts_rad=(-0.25,), points_per_image=8, outliers=0.03
)
HELD = SolveOptions(rig="held")


@pytest.fixture(scope="module")
def drive() -> Traverse:
    return simulate(rig_template("mer-navcam"), DRIVE, seed=77).traverse


def kept(drive: Traverse, path: Path, options: SolveOptions = HELD) -> Path:
    smoother = smoother_for(drive, options)
    solve_incrementally(drive, options, smoother=smoother)
    smoother.save(path)
    return path


@pytest.mark.parametrize("options", [HELD, SolveOptions()], ids=["held", "estimated"])
def test_stops_that_are_added_later_end_where_all_at_once_do(
    drive: Traverse, tmp_path: Path, options: SolveOptions
) -> None:
    smoother, why = continued(kept(some_stops(drive, slice(2)), tmp_path / "s.npz", options), drive, options)
    assert smoother is not None, why
    assert smoother.stops == tuple(stop.id for stop in drive.stops[:2])
    added = list[str]()
    found = solve_incrementally(
        drive, options, smoother=smoother, on_stop=lambda u: added.append(str(u.stop))
    )
    expected = solve_incrementally(drive, options)
    assert added == [stop.id for stop in drive.stops[2:]]
    np.testing.assert_array_equal(found.used, expected.used)
    assert found.cost_final == pytest.approx(expected.cost_final, rel=1e-6)
    for a, b, covariance in zip(
        found.final.world_T_mast, expected.final.world_T_mast, expected.stop_covariance, strict=True
    ):
        sigma = np.sqrt(np.diag(covariance))
        assert np.all(np.abs(b.localCoordinates(a)) <= 1e-2 * sigma + 1e-9)
    assert found.incremental is not None
    assert found.incremental.seconds_per_stop[:2] == (0.0, 0.0)
    assert min(found.incremental.seconds_per_stop[2:]) > 0


def test_what_has_changed_of_old_stops_is_brought_up_to_date(drive: Traverse, tmp_path: Path) -> None:
    """Ties may be found in old pictures too, and others be lost."""
    whole = drive.observations
    assert whole is not None
    of_old = np.flatnonzero(drive.image_stop[whole.image] < 2)
    fewer = replace(drive, observations=whole.select(np.delete(np.arange(len(whole)), of_old[5::40])))
    before = some_stops(fewer, slice(2))
    after = replace(drive, observations=whole.select(np.delete(np.arange(len(whole)), of_old[9::50])))
    smoother, why = continued(kept(before, tmp_path / "s.npz"), after, HELD)
    assert smoother is not None, why
    found = solve_incrementally(after, HELD, smoother=smoother)
    expected = solve_incrementally(after, HELD)
    np.testing.assert_array_equal(found.used, expected.used)
    assert found.cost_final == pytest.approx(expected.cost_final, rel=1e-6)


def moved_frame(drive: Traverse) -> Traverse:
    frames = (replace(drive.frames[0], pan_rad=drive.frames[0].pan_rad + 0.1), *drive.frames[1:])
    return replace(drive, frames=frames)


def other_noise(drive: Traverse) -> Traverse:
    assert drive.observations is not None
    return replace(drive, observations=replace(drive.observations, sigma_px=2 * drive.observations.sigma_px))


@pytest.mark.parametrize(
    ("change", "options", "says"),
    [
        (lambda d: replace(d, stops=d.stops[::-1], rig=rig_template("msl-navcam")), HELD, "has another rig"),
        (lambda d: d, SolveOptions(rig="held", outlier_sigma=5.0), "has other options"),
        (moved_frame, HELD, "has another frame frame00000"),
        (other_noise, HELD, "other observations"),
    ],
)
def test_a_smoother_of_another_drive_is_refused_and_said(  # type: ignore[no-untyped-def]  # change: any lambda
    drive: Traverse, tmp_path: Path, change, options: SolveOptions, says: str
) -> None:
    path = kept(some_stops(drive, slice(2)), tmp_path / "s.npz")
    if "rig" in says:
        rig = replace(
            drive.rig,
            eyes=(
                drive.rig.eyes[0],
                replace(drive.rig.eyes[1], head_T_camera=drive.rig.eyes[0].head_T_camera),
            ),
        )
        changed = replace(drive, rig=rig)
    else:
        changed = change(drive)
    smoother, why = continued(path, changed, options)
    assert smoother is None
    assert says in why
    with pytest.raises(InputError, match="smoother: expected one with the first stops"):
        solve_incrementally(changed, options, smoother=TraverseSmoother.load(path))


def test_a_damaged_file_is_said(drive: Traverse, tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    path.write_bytes(b"no archive")
    smoother, why = continued(path, drive, HELD)
    assert smoother is None
    assert why.startswith(f"{path}: expected")


def test_the_command_adds_the_new_stops_alone(
    drive: Traverse, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new, out = tmp_path / "old", tmp_path / "new", tmp_path / "out"
    write_traverse(some_stops(drive, slice(3)), old)
    write_traverse(some_stops(drive, slice(3, 4)), new)
    base = ["refine", str(old), "--out", str(out), "--incremental", "--rig", "held", "--no-report"]
    assert main(base) == 0
    assert (out / SMOOTHER_FILE).exists()
    capsys.readouterr()
    assert main([*base, "--add", str(new)]) == 0
    said = capsys.readouterr()
    text = said.out + said.err
    assert drive.stops[3].id in text
    assert "added anew" not in text
    assert main([*base, "--add", str(new), "--rig", "estimated"]) in {0, 1}
    said = capsys.readouterr()
    assert "all stops are added anew" in said.out + said.err
