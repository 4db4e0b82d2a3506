"""How uncertain a rig is: what templates, own rigs and labels state, and what files say of it."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pancam_graph import read_traverse, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.rigs import TEMPLATES, RigUncertainty, mer_navcam, rig_template
from support import io_samples


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_template_says_how_uncertain_it_is_and_by_which_source(name: str) -> None:
    rig = rig_template(name)
    assert len(rig.uncertainty.source) > 20
    assert rig.uncertainty.focal > 0
    assert rig.uncertainty.mount_rad > 0
    assert (rig.uncertainty.tilt_axis_rad > 0) == rig.turns


def test_a_rig_of_which_nothing_is_known_has_the_usual_uncertainty_for_its_images() -> None:
    rig = io_samples.traverse().rig
    assert rig.uncertainty == RigUncertainty.usual(64)
    assert rig.uncertainty.principal_point_px == pytest.approx(0.32)


@pytest.mark.parametrize("sigma", [-1e-9, math.nan, math.inf])
def test_a_sigma_that_is_none_is_refused(sigma: float) -> None:
    with pytest.raises(InputError, match=r"uncertainty: mount_m: expected 0 \(exact\) or a positive number"):
        RigUncertainty(mount_m=sigma)


def test_a_traverse_is_read_back_with_its_uncertainty(tmp_path: Path) -> None:
    stated = RigUncertainty(focal=0.01, mount_m=0.0, source="a calibration target, 3 August")
    sample = io_samples.traverse()
    write_traverse(replace(sample, rig=replace(sample.rig, uncertainty=stated)), tmp_path)
    assert read_traverse(tmp_path).rig.uncertainty == stated


def written(folder: Path) -> dict[str, Any]:
    write_traverse(io_samples.traverse(), folder)
    entries: dict[str, Any] = json.loads((folder / "traverse.json").read_text())
    return entries


def reread(folder: Path, entries: dict[str, Any]) -> RigUncertainty:
    (folder / "traverse.json").write_text(json.dumps(entries))
    return read_traverse(folder).rig.uncertainty


def test_entries_that_a_file_does_not_name_are_the_usual_ones(tmp_path: Path) -> None:
    entries = written(tmp_path)
    entries["rig"]["uncertainty"] = {"focal": 0.02}
    assert reread(tmp_path, entries) == replace(RigUncertainty.usual(64), focal=0.02)
    del entries["rig"]["uncertainty"]
    assert reread(tmp_path, entries) == RigUncertainty.usual(64)


def test_a_template_in_a_file_may_be_more_uncertain(tmp_path: Path) -> None:
    entries = written(tmp_path)
    entries["rig"] = {"template": "mer-navcam", "uncertainty": {"mount_m": 0.1}}
    for i, image in enumerate(entries["images"]):
        image["frame"], image["camera"] = entries["frames"][i % 4]["id"], ("left", "right")[i // 4 % 2]
    del entries["images"][8:]
    entries["observations"] = "observations.csv"
    (tmp_path / "observations.csv").write_text("image,track,u_px,v_px,sigma_px\n0,0,1,1,1\n1,0,1,1,1\n")
    assert reread(tmp_path, entries) == replace(mer_navcam().uncertainty, mount_m=0.1)


@pytest.mark.parametrize(
    ("entry", "value", "says"),
    [
        ("focal", -0.1, "rig: uncertainty: focal: expected 0 (exact) or a positive number, found -0.1"),
        ("focus", 0.1, "uncertainty.focus"),
        ("mount_rad", "small", "uncertainty.mount_rad"),
    ],
)
def test_a_wrong_entry_is_refused_in_one_sentence(
    entry: str, value: object, says: str, tmp_path: Path
) -> None:
    entries = written(tmp_path)
    entries["rig"]["uncertainty"] = {entry: value}
    with pytest.raises(InputError) as refused:
        reread(tmp_path, entries)
    assert says in str(refused.value)
    assert "traverse.json" in str(refused.value)
    assert "\n" not in str(refused.value)
