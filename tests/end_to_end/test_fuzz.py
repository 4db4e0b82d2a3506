"""Files that are damaged or hostile end in a result or in one sentence that names them, whatever they are.

Each case is a seed: what fails is found again by it. The slow part draws thousands. A reader of a new format
has a place here. What this does not prove: that a result which was read is solved.
"""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pancam_graph import SimulationOptions, Traverse, TraverseSmoother, simulate, write_traverse
from pancam_graph.cameras import CAHVORE
from pancam_graph.data import Freedom, Sharing
from pancam_graph.images._cache import Cache
from pancam_graph.io import (
    cahvor_text,
    read_image,
    read_input,
    read_mask,
    read_pds,
    read_traverse,
    rig_json,
    use_rig,
)
from pancam_graph.io._site_files import site_poses
from pancam_graph.io.plain import PlainOptions, plain_traverse, write_plain
from pancam_graph.io.posed import read_posed
from pancam_graph.rigs import mer_navcam
from pancam_graph.smoother import SmootherOptions
from pancam_graph.smoother._incremental import stops_of
from support import io_samples, plain_pictures
from support.fuzzing import (
    claiming,
    dumped,
    mutated_arrays,
    mutated_bytes,
    mutated_label,
    mutated_text,
    mutated_tree,
    outcome,
    packed,
)
from support.pds4_labels import small_pds4_text
from support.pds_files import pds_file
from support.rover_labels import (
    MARS2020_NAVCAM,
    POINTINGS,
    Shot,
    label_text,
    mars2020_mast,
    msl_mast,
    navcam_b_head,
    turned,
)

Case = Callable[[np.random.Generator], str]
"""Writes a mutated file, reads it, and says what it was refused with; "" for a result."""

_FAST, _SLOW = 8, 300
"""Cases of each kind."""

CASES: dict[str, Callable[[Path], Case]] = {}


def kind_of_case(make: Callable[[Path], Case]) -> Callable[[Path], Case]:
    """Register a kind: a function that makes, in a folder, the case of a seed."""
    CASES[make.__name__] = make
    return make


def run(name: str, folder: Path, count: int) -> None:
    """Cases of a kind. Some of them must be refused: else nothing was tried."""
    case, refused = CASES[name](folder), 0

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.integers(0, 2**32 - 1))
    def drawn(seed: int) -> None:
        nonlocal refused
        refused += bool(case(np.random.default_rng(seed)))

    with np.errstate(all="ignore"):
        drawn()
    if not name.startswith("cache"):
        assert refused


# --- traverse folders ---


@kind_of_case
def traverse_json_entries(folder: Path) -> Case:
    write_traverse(sharing_traverse(), folder)
    path = folder / "traverse.json"
    tree = json.loads(path.read_text())

    def case(rng: np.random.Generator) -> str:
        path.write_bytes(dumped(mutated_tree(rng, tree)))
        return outcome(lambda: read_input(folder), folder)

    return case


@kind_of_case
def traverse_json_bytes(folder: Path) -> Case:
    write_traverse(sharing_traverse(), folder)
    path = folder / "traverse.json"
    good = path.read_bytes()

    def case(rng: np.random.Generator) -> str:
        path.write_bytes(
            mutated_bytes(rng, good) if rng.random() < 0.5 else mutated_text(rng, good.decode()).encode()
        )
        return outcome(lambda: read_input(folder), folder)

    return case


@kind_of_case
def observations_npz_arrays(folder: Path) -> Case:
    return observations_npz(folder, lambda rng, arrays, _: packed(mutated_arrays(rng, arrays)))


@kind_of_case
def observations_npz_bytes(folder: Path) -> Case:
    return observations_npz(folder, lambda rng, _, good: mutated_bytes(rng, good))


@kind_of_case
def observations_npz_counts(folder: Path) -> Case:
    return observations_npz(folder, lambda rng, arrays, _: claimed(rng, arrays))


def observations_npz(folder: Path, change: Callable[[np.random.Generator, Any, bytes], bytes]) -> Case:
    sample = io_samples.traverse()
    assert sample.observations is not None
    observed = sample.observations.with_covariance(io_samples.covariances(len(sample.observations)))
    write_traverse(replace(sample, observations=observed), folder)
    path = folder / "observations.npz"
    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)

    def case(rng: np.random.Generator) -> str:
        path.write_bytes(change(rng, arrays, good))
        return outcome(lambda: read_input(folder), folder)

    return case


def claimed(rng: np.random.Generator, arrays: Any) -> bytes:
    """An archive whose header of one array says another shape than it has."""
    name = str(rng.choice(list(arrays)))
    sides = [0, 1, 5, 2**31, 2**40, 2**62, 10**30, -1]
    shape = tuple(int(sides[int(i)]) for i in rng.integers(0, len(sides), int(rng.integers(0, 4))))
    return claiming(arrays, name, shape)


@kind_of_case
def observations_csv(folder: Path) -> Case:
    write_traverse(io_samples.traverse(), folder)
    sample = read_traverse(folder).observations
    assert sample is not None
    rows = zip(sample.image, sample.track, sample.uv_px, sample.sigma_px, strict=True)
    lines = [f"{i},{t},{uv[0]!r},{uv[1]!r},{s}" for i, t, uv, s in rows]
    text = "image,track,u_px,v_px,sigma_px\n" + "\n".join(lines) + "\n"
    path = folder / "traverse.json"
    path.write_text(path.read_text().replace("observations.npz", "observations.csv"))

    def case(rng: np.random.Generator) -> str:
        changed = mutated_text(rng, text).encode()
        (folder / "observations.csv").write_bytes(
            mutated_bytes(rng, changed) if rng.random() < 0.3 else changed
        )
        return outcome(lambda: read_input(folder), folder)

    return case


def sharing_traverse() -> Traverse:
    """A traverse with all lenses, two stops, covariances and a sharing."""
    sharing = Sharing(
        calibration=Freedom(scope="eye", free=("fx_px",), sigma={"fx_px": 2.0}), mounts=Freedom(scope="eye")
    )
    return replace(io_samples.traverse(), sharing=sharing)


@kind_of_case
def rig_json_entries(folder: Path) -> Case:
    return rigs(folder, lambda rng, good: dumped(mutated_tree(rng, json.loads(good))))


@kind_of_case
def rig_json_covariances(folder: Path) -> Case:
    """Matrices that are not symmetric, not positive definite, of another size, or have hostile numbers."""

    def change(rng: np.random.Generator, good: bytes) -> bytes:
        tree = json.loads(good)
        covariance = tree["rig"]["uncertainty"]["covariance"]
        matrix = np.array(covariance["matrix"])
        i, j = rng.integers(0, len(matrix), 2)
        kind = int(rng.integers(0, 6))
        if kind == 0:
            matrix[i, j] += rng.choice([-2.0, 2.0]) * np.sqrt(matrix[i, i] * matrix[j, j])
        elif kind == 1:
            matrix[i, j] = matrix[j, i] = 1.5 * np.sqrt(matrix[i, i] * matrix[j, j])
        elif kind == 2:
            matrix = matrix[:i] if rng.random() < 0.5 else matrix[:, :j]
        elif kind == 3:
            matrix[i, j] = matrix[j, i] = rng.choice([np.nan, np.inf, 0.0, -1.0, 1e308, 1e-320])
        elif kind == 4:
            matrix *= rng.choice([0.0, -1.0, 1e300, 1e-300])
        else:
            covariance["entries"][int(i)] = covariance["entries"][int(j)]
        covariance["matrix"] = matrix.tolist()
        return dumped(tree)

    return rigs(folder, change)


@kind_of_case
def rig_json_bytes(folder: Path) -> Case:
    def change(rng: np.random.Generator, good: bytes) -> bytes:
        return mutated_bytes(rng, good) if rng.random() < 0.5 else mutated_text(rng, good.decode()).encode()

    return rigs(folder, change)


def rigs(folder: Path, change: Callable[[np.random.Generator, bytes], bytes]) -> Case:
    sample = io_samples.traverse()
    rig = io_samples.with_covariance(sample.rig)
    path = folder / "rig.json"
    good = rig_json(rig, name="sample", passed=True)

    def case(rng: np.random.Generator) -> str:
        path.write_bytes(change(rng, good))
        return outcome(lambda: use_rig(sample, path), folder)

    return case


# --- labels ---


@kind_of_case
def labels_of_curiosity(folder: Path) -> Case:
    return labels(folder, label_text(Shot(head=navcam_b_head(), joints=POINTINGS[0]), msl_mast()))


@kind_of_case
def labels_of_perseverance(folder: Path) -> Case:
    shot = Shot(head=MARS2020_NAVCAM, joints=POINTINGS[0], instrument="NAVCAM_LEFT")
    return labels(folder, label_text(shot, mars2020_mast(as_designed=True), host="M20"))


def labels(folder: Path, text: str) -> Case:
    """Labels alone in their folder, so that what is wrong is said, and images read through them."""

    def case(rng: np.random.Generator) -> str:
        label = mutated_label(rng, text)
        file = folder / "NRB_0.IMG"
        file.write_bytes(label.ljust(8192) + bytes(48))
        said = outcome(lambda: read_pds(folder), folder)
        return said or outcome(lambda: read_image(file), folder)

    return case


@kind_of_case
def labels_of_pds4(folder: Path) -> Case:
    head = replace(MARS2020_NAVCAM, width_px=6, height_px=4)
    rotation, point = mars2020_mast(as_designed=True).head(*POINTINGS[0])
    model = turned(head, rotation, point)
    assert isinstance(model, CAHVORE)
    text = small_pds4_text(model, POINTINGS[0])
    (folder / "a.dat").write_bytes(bytes(range(24)))

    def case(rng: np.random.Generator) -> str:
        (folder / "a.xml").write_bytes(mutated_label(rng, text))
        said = outcome(lambda: read_pds(folder), folder)
        return said or outcome(lambda: read_image(folder / "a.dat"), folder)

    return case


@kind_of_case
def labels_of_vicar(folder: Path) -> Case:
    text = (
        "LBLSIZE=512  FORMAT='HALF'\n ORG='BSQ'\n NL=3  NS=4  NB=1\n RECSIZE=8  N2=3  N3=1  NBB=0  NLB=0 "
        "EOL=1 "
        "INTFMT='HIGH'\n PROPERTY='IMAGE_DATA'\n MISSING_CONSTANT=(0,1)\n ANGLE=(1.5,2.5)  "
        "ANGLE__UNIT=('rad','deg')\n "
        "PROPERTY='IDENTIFICATION'\n INSTRUMENT_HOST_ID='MER1'\n NOTE='it''s'\n"
    )
    file = folder / "a.VIC"

    def case(rng: np.random.Generator) -> str:
        file.write_bytes(
            mutated_label(rng, text).ljust(512, b"\0")
            + bytes(range(24))
            + b"LBLSIZE=40  PROPERTY='X' A=1".ljust(40)
        )
        return outcome(lambda: read_image(file), folder)

    return case


@kind_of_case
def files_of_sites(folder: Path) -> Case:
    text = (
        '<rmc_file>\n<priority>\n<entry solution_id="a"/>\n<entry solution_id="b"/>\n</priority>\n'
        '<solution solution_id="b" name="SITE_FRAME" index1="5">\n'
        '<reference_frame name="SITE_FRAME" index1="4"/>\n'
        '<offset x="1.25" y="-3.5" z="0.1"/>\n<orientation s="1.0" v1="0.0" v2="0.0" v3="0.0"/>\n'
        "</solution>\n</rmc_file>\n"
    )
    file = folder / "a.svf"

    def case(rng: np.random.Generator) -> str:
        file.write_bytes(mutated_label(rng, text))
        return outcome(lambda: site_poses([file]), folder)

    return case


@kind_of_case
def records_of_the_feed(folder: Path) -> Case:
    rotation, point = mars2020_mast(as_designed=True).head(*POINTINGS[0])
    model = turned(MARS2020_NAVCAM, rotation, point)
    vectors = [f"({','.join(repr(float(v)) for v in getattr(model, letter))})" for letter in "CAHVORE"]
    record = {
        "imageid": "NLF_0670_0726421423_362ECM",
        "camera": {
            "instrument": "NAVCAM_LEFT",
            "camera_model_component_list": ";".join([*vectors, "3", "0.37"]),
        },
        "extended": {"mastAz": "1.2", "mastEl": -33.9, "xyz": "(12.8,60.1,0.3)", "dimension": "(8,6)"},
        "attitude": [0.98, 0.02, -0.03, 0.195],
        "site": "32",
        "drive": 604,
    }
    tree = {"images": [record]}
    (folder / "NLF_0670_0726421423_362ECM01.png").write_bytes(plain_pictures.picture(".png", 8, 6))
    file = folder / "a.json"

    def case(rng: np.random.Generator) -> str:
        tried = dumped(mutated_tree(rng, tree))
        file.write_bytes(
            mutated_text(rng, tried.decode()).encode("utf-8", "replace") if rng.random() < 0.5 else tried
        )
        return outcome(lambda: read_input(folder), folder)

    return case


@kind_of_case
def samples_of_labels(folder: Path) -> Case:
    file = pds_file(folder / "a.IMG", bytes(range(24)), extra="  BANDS = 1\r\n  MISSING_CONSTANT = 3\r\n")
    text = file.read_bytes()[:1024].rstrip().decode()

    def case(rng: np.random.Generator) -> str:
        label = mutated_text(rng, text).encode("utf-8", "replace")
        file.write_bytes(label.ljust(1024) + bytes(range(24)))
        return outcome(lambda: read_image(file), folder)

    return case


# --- pictures and masks ---


@kind_of_case
def pictures(folder: Path) -> Case:
    suffixes = (".png", ".jpg", ".tif", ".bmp", ".webp", ".jp2", ".pgm", ".ppm")
    made = []
    for seed, suffix in enumerate((*suffixes, ".png", ".tif")):
        deep = seed >= len(suffixes)
        shape = (48, 64, 3) if suffix == ".ppm" else (48, 64)
        rng = np.random.default_rng(seed)
        samples = (
            rng.integers(0, 60_000, shape).astype(np.uint16)
            if deep
            else rng.integers(0, 256, shape).astype(np.uint8)
        )
        made.append((suffix, cv2.imencode(suffix, samples)[1].tobytes()))

    def case(rng: np.random.Generator) -> str:
        suffix, good = made[int(rng.integers(0, len(made)))]
        file = folder / f"a{suffix}"
        file.write_bytes(mutated_bytes(rng, good, reach=200 if rng.random() < 0.7 else None))
        said = outcome(lambda: read_mask(file, 64, 48, "b.png"), folder)
        return said or outcome(lambda: read_image(file), folder)

    return case


# --- plain pictures ---


@kind_of_case
def plain_pointing(folder: Path) -> Case:
    return plain_tables(folder, "pointing.csv")


@kind_of_case
def plain_stops(folder: Path) -> Case:
    return plain_tables(folder, "stops.csv")


def plain_tables(folder: Path, damaged: str) -> Case:
    plain_pictures.pictures(folder, ["s1/a.png", "s1/b.png", "s2/a.png"])
    lines = "s1/a.png,-20,1,0.1,x,f0", "s1/b.png,0,2.5,0.1,x,f1", "s2/a.png,20,-3,,y,f2"
    plain_pictures.table(folder / "pointing.csv", "file,pan_deg,tilt_deg,sigma_pan_deg,camera,frame", *lines)
    plain_pictures.table(
        folder / "stops.csv", "stop,x_m,y_m,z_m,yaw_deg,sigma_m", "s1,0,0,0,0,", "s2,4.5,1,-1,20,0.2"
    )
    path = folder / damaged
    good = path.read_bytes()

    def case(rng: np.random.Generator) -> str:
        path.write_bytes(
            mutated_bytes(rng, good)
            if rng.random() < 0.3
            else mutated_text(rng, good.decode()).encode("utf-8", "replace")
        )
        return outcome(lambda: plain_way(folder), folder)

    return case


@kind_of_case
def plain_exif(folder: Path) -> Case:
    exif = plain_pictures.tiff({plain_pictures.MODEL: "Phone 7", plain_pictures.FOCAL_35MM: 26})
    good = plain_pictures.picture(".jpg", exif=exif)
    plain_pictures.table(folder / "pointing.csv", "file,pan_deg,tilt_deg", "a.jpg,0,0")

    def case(rng: np.random.Generator) -> str:
        (folder / "a.jpg").write_bytes(mutated_bytes(rng, good, 120))
        return outcome(lambda: plain_way(folder), folder)

    return case


def plain_way(folder: Path) -> Traverse:
    """From pictures to what refine reads."""
    stops = folder / "stops.csv" if (folder / "stops.csv").exists() else None
    focal_px = None if stops is None else 20.0
    options = PlainOptions(pointing=folder / "pointing.csv", stops=stops, focal_px=focal_px)
    write_plain(plain_traverse(folder, options), folder, overwrite=True)
    return read_input(folder)


# --- what the package has written itself ---


@kind_of_case
def smoother_arrays(folder: Path) -> Case:
    return smoothers(folder, lambda rng, arrays, _: packed(mutated_arrays(rng, arrays)))


@kind_of_case
def smoother_bytes(folder: Path) -> Case:
    return smoothers(folder, lambda rng, _, good: mutated_bytes(rng, good))


@kind_of_case
def smoother_counts(folder: Path) -> Case:
    return smoothers(folder, lambda rng, arrays, _: claimed(rng, arrays))


@kind_of_case
def smoother_headers(folder: Path) -> Case:
    def change(rng: np.random.Generator, arrays: Any, _: bytes) -> bytes:
        header = dumped(mutated_tree(rng, json.loads(arrays["header"].tobytes())))
        return packed({**arrays, "header": np.frombuffer(header, dtype=np.uint8)})

    return smoothers(folder, change)


def smoothers(folder: Path, change: Callable[[np.random.Generator, Any, bytes], bytes]) -> Case:
    options = SimulationOptions(
        stops=3, spacing_m=3.0, pans=2, tilts_rad=(-0.2,), sweep_rad=0.8, points_per_image=12, noise_px=0.3
    )
    traverse = simulate(mer_navcam(), options).traverse
    smoother = TraverseSmoother(traverse.rig, SmootherOptions(telemetry="odometry"))
    for part in stops_of(traverse):
        smoother.add_stop(*part)
    path = folder / "drive.npz"
    smoother.save(path)
    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)

    def case(rng: np.random.Generator) -> str:
        path.write_bytes(change(rng, arrays, good))
        return outcome(lambda: TraverseSmoother.load(path), folder)

    return case


@kind_of_case
def colmap_text(folder: Path) -> Case:
    (folder / "cameras.txt").write_text("# a\n7 OPENCV 64 48 50 51 32 24 -0.1 0.02 0.001 -0.002\n")
    image = "1 0.9 0.1 -0.2 0.3 1.5 -2 0.25 7 a b.png\n1.5 2.5 -1 3 4 5\n"
    (folder / "images.txt").write_text(f"# b\n{image}{image.replace('1 0.9', '2 0.8')}")
    return posed(folder, ("cameras.txt", "images.txt"))


@kind_of_case
def colmap_binary(folder: Path) -> Case:
    lens = (50.0, 51.0, 32.0, 24.0, -0.1, 0.02, 0.001, -0.002)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ8d", 1, 7, 4, 64, 48, *lens))
    pose = (0.9, 0.1, -0.2, 0.3, 1.5, -2.0, 0.25)
    image = struct.pack("<I7dI", 1, *pose, 7) + b"a.png\0" + struct.pack("<Qddq", 1, 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + 2 * image)
    return posed(folder, ("cameras.bin", "images.bin"))


@kind_of_case
def bundler(folder: Path) -> Case:
    camera = "500 -0.1 0.02\n1 0 0\n0 1 0\n0 0 1\n0.5 1 -4\n"
    (folder / "bundle.out").write_text(f"# Bundle file v0.3\n2 1\n{camera}{camera}1 2 3\n1 2 3\n1 0 0 1 1\n")
    (folder / "list.txt").write_text("a.jpg\nb.jpg 0 500\n")
    return posed(folder, ("bundle.out", "list.txt"))


@kind_of_case
def cahvor_folder(folder: Path) -> Case:
    (folder / "a.cahvor").write_text(cahvor_text(MARS2020_NAVCAM))
    return posed(folder, ("a.cahvor",))


def posed(folder: Path, names: tuple[str, ...]) -> Case:
    good = {name: (folder / name).read_bytes() for name in names}

    def case(rng: np.random.Generator) -> str:
        for name, content in good.items():
            (folder / name).write_bytes(content)
        name = names[rng.integers(len(names))]
        as_text = not name.endswith(".bin") and rng.random() < 0.6
        text = mutated_text(rng, good[name].decode()).encode(errors="replace") if as_text else None
        (folder / name).write_bytes(mutated_bytes(rng, good[name]) if text is None else text)
        return outcome(lambda: read_posed(folder), folder)

    return case


@kind_of_case
def cache_entries(folder: Path) -> Case:
    made = {"uv_px": np.arange(12.0).reshape(6, 2), "good": np.arange(6) > 2}
    key = "k" * 64
    Cache(folder).recall("refined", key, lambda: made)
    (path,) = folder.glob("refined-*.npz")
    good = path.read_bytes()
    with np.load(path) as archive:
        arrays = dict(archive)

    def case(rng: np.random.Generator) -> str:
        path.write_bytes(
            packed(mutated_arrays(rng, arrays)) if rng.random() < 0.6 else mutated_bytes(rng, good)
        )
        kept = Cache(folder).recall("refined", key, lambda: made)
        assert kept.keys() == made.keys()
        assert all(kept[name].dtype == made[name].dtype for name in made)
        assert all(np.array_equal(kept[name], made[name]) for name in made)
        return ""

    return case


@pytest.mark.parametrize("name", CASES)
def test_every_damaged_file_ends_in_a_result_or_one_sentence(name: str, tmp_path: Path) -> None:
    run(name, tmp_path, _FAST)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_thousands_of_damaged_files_end_in_a_result_or_one_sentence(name: str, tmp_path: Path) -> None:
    run(name, tmp_path, _SLOW)
