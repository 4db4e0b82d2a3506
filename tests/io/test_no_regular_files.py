"""Pipes, devices, folders, links to nothing and names too long, wherever a file is expected: one sentence."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pancam_graph import Traverse, read_traverse, write_traverse
from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.regular_files import instead_of_file, is_missing
from pancam_graph.io import read_image, read_input, read_pds
from pancam_graph.smoother import TraverseSmoother
from support import io_samples
from support.rover_labels import POINTINGS, Shot, label_text, msl_mast, navcam_b_head, write

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")

KINDS: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a folder": Path.mkdir,
    "a link to nothing": lambda path: path.symlink_to("nowhere"),
    "nothing there": lambda path: None,
}
every_kind = pytest.mark.parametrize("kind", KINDS)
inside = pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "a device"])
"""Kinds that may lie in a traverse folder: a link to a device leads out of it, which is refused before."""


@every_kind
def test_the_kind_is_told(tmp_path: Path, kind: str) -> None:
    KINDS[kind](tmp_path / "a")
    assert instead_of_file(tmp_path / "a") == kind
    assert is_missing(tmp_path / "a") == (kind in {"a link to nothing", "nothing there"})


def test_a_regular_file_is_one_and_an_impossible_name_is_told_in_the_systems_words(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"")
    (tmp_path / "b").symlink_to("a")
    assert instead_of_file(tmp_path / "a") is None
    assert instead_of_file(tmp_path / "b") is None
    assert instead_of_file(tmp_path / ("n" * 300)) == "File name too long"
    # The words are those of the version of Python.
    assert "embedded null" in str(instead_of_file(tmp_path / "a\0b"))


def pictured(folder: Path) -> Traverse:
    """A traverse folder with observations and two pictures, the second of which tests replace."""
    sample = io_samples.traverse()
    names = ("a.png", "b.png")
    images = tuple(replace(i, file=n) for i, n in zip(sample.images, names, strict=False))
    for name in names:
        cv2.imwrite(str(folder / name), np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8))
    made = replace(sample, images=(*images, *sample.images[2:]), folder=folder)
    write_traverse(made, folder)
    return made


@inside
def test_a_picture(tmp_path: Path, kind: str) -> None:
    made = pictured(tmp_path)
    (tmp_path / "b.png").unlink()
    KINDS[kind](tmp_path / "b.png")
    said = f"{tmp_path}/b.png: expected an image file, found {kind}"
    assert read_traverse(tmp_path).warnings == (f"image {made.images[1].id} is left out: {said}",)
    with pytest.raises(ImageError) as caught:
        read_image(tmp_path / "b.png")
    assert str(caught.value) == said


def test_a_picture_whose_name_is_too_long(tmp_path: Path) -> None:
    pictured(tmp_path)
    path = tmp_path / "traverse.json"
    path.write_text(path.read_text().replace("b.png", "b" * 300 + ".png"))
    (warning,) = read_traverse(tmp_path).warnings
    assert warning.endswith("b.png: expected an image file, found File name too long")
    path.write_text(path.read_text().replace("a.png", "a" * 300 + ".png"))
    with pytest.raises(ImageError, match="expected an image file, found File name too long"):
        read_traverse(tmp_path)


@inside
@pytest.mark.parametrize("place", ["named.png", "masks/pinhole.png"])
def test_a_mask_is_never_passed_over(tmp_path: Path, kind: str, place: str) -> None:
    if kind == "nothing there" and place != "named.png":
        pytest.skip("there is then no mask")
    made = pictured(tmp_path)
    (tmp_path / "masks").mkdir()
    KINDS[kind](tmp_path / place)
    mask = place if place == "named.png" else None
    images = (replace(made.images[0], mask=mask), *made.images[1:])
    text = (tmp_path / "traverse.json").read_text()
    if mask is not None:
        text = text.replace('"file": "a.png"', f'"file": "a.png", "mask": "{mask}"')
    (tmp_path / "traverse.json").write_text(text)
    with pytest.raises(
        ImageError, match=rf"images\[0\] \({images[0].id}\): .*{place}: expected an image file, found {kind}$"
    ):
        read_traverse(tmp_path)


@pytest.mark.parametrize("kind", ["a pipe", "a link to nothing"])
def test_the_folder_of_masks_is_never_passed_over(tmp_path: Path, kind: str) -> None:
    pictured(tmp_path)
    KINDS[kind](tmp_path / "masks")
    with pytest.raises(ImageError, match="masks: expected a folder of masks, found: "):
        read_traverse(tmp_path)


@inside
@pytest.mark.parametrize("name", ["traverse.json", "observations.npz"])
def test_a_file_of_the_traverse(tmp_path: Path, kind: str, name: str) -> None:
    pictured(tmp_path)
    (tmp_path / name).unlink()
    KINDS[kind](tmp_path / name)
    with pytest.raises(InputError, match=rf"{name}: expected a file, found {kind}$"):
        read_traverse(tmp_path)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "nothing there"])
def test_a_label_and_a_detached_label(tmp_path: Path, kind: str) -> None:
    shot = Shot(head=navcam_b_head(), joints=POINTINGS[0])
    good = write(tmp_path, "NRB_0", label_text(shot, msl_mast()))
    KINDS[kind](tmp_path / "NRB_1.IMG")
    said = f"NRB_1.IMG: expected an image file, found {kind}"
    assert read_input(tmp_path).warnings == (f"image NRB_1 is left out: {tmp_path}/{said}",)
    good.unlink()
    with pytest.raises(InputError, match=f"{said}$"):
        read_pds(tmp_path)
    bad = tmp_path / "NRB_1.IMG"
    shutil.rmtree(bad) if kind == "a folder" else bad.unlink()
    bad.write_bytes(bytes(48))
    if kind != "a link to nothing":
        KINDS[kind](tmp_path / "NRB_1.LBL")
        with pytest.raises(InputError, match=rf"NRB_1\.LBL: expected an image file, found {kind}$"):
            read_pds(tmp_path)


@every_kind
def test_a_saved_smoother(tmp_path: Path, kind: str) -> None:
    KINDS[kind](tmp_path / "smoother.npz")
    with pytest.raises(InputError, match=rf"smoother\.npz: expected a file, found {kind}$"):
        TraverseSmoother.load(tmp_path / "smoother.npz")
