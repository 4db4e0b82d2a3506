"""Rigs as factor templates: chain matrices by differences, what is held, values and states."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import gtsam
import numpy as np
import pytest

from pancam_graph import Frame, Freedom, Image, Sharing, Stop, Traverse
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import ENTRIES, Quantity, RigCorrection, State
from pancam_graph.data._sharing import Scope
from pancam_graph.elimination import Covariance
from pancam_graph.factors import Fixed, Key
from pancam_graph.graph import (
    DEFAULT_FLEX,
    FactorTemplate,
    HardTemplate,
    ProjectiveTemplate,
    SoftTemplate,
    read_variable,
)
from pancam_graph.rigs import Rig, exomars_pancam, mer_navcam
from support.parameters import slow_but_for

PAN_T_TILT = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.2, -0.1, 0.3), np.array([0.03, -0.02, 0.05]))


def bent() -> Rig:
    """A tilt axis that stands askew and off the pan axis."""
    return replace(exomars_pancam(), pan_T_tilt=PAN_T_TILT)


def traverse_of(rig: Rig, stop_sigmas: list[tuple[float, float]], angle_sigmas: list[float]) -> Traverse:
    """Stops of two frames each; frames are listed in turns of the stops, so that no order is natural."""
    rng = np.random.default_rng(0)
    stops = tuple(
        Stop(
            id=f"s{i}",
            world_T_mast=gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 0.5, 3)), rng.normal(0, 5, 3)),
            sigma_rotation_rad=rotation,
            sigma_translation_m=translation,
        )
        for i, (rotation, translation) in enumerate(stop_sigmas)
    )
    n = len(stops)
    frames = tuple(
        Frame(
            id=f"f{i}",
            stop=f"s{i % n}",
            pan_rad=float(rng.uniform(-2, 2)),
            tilt_rad=float(rng.uniform(-0.6, 0.6)),
            sigma_pan_rad=angle_sigmas[2 * i],
            sigma_tilt_rad=angle_sigmas[2 * i + 1],
        )
        for i in range(2 * n)
    )
    images = tuple(Image(id=f"{f.id}{e.name}", frame=f.id, camera=e.name) for e in rig.eyes for f in frames)
    return Traverse(name="t", rig=rig, stops=stops, frames=frames, images=images)


FREE = [1e-3] * 8
TRAVERSES: dict[str, Callable[[], Traverse]] = {
    "all free": lambda: traverse_of(bent(), [(0.01, 0.1), (0.01, 0.1)], FREE),
    "a stop held": lambda: traverse_of(bent(), [(0.0, 0.0), (0.01, 0.1)], FREE),
    "a stop's rotation held": lambda: traverse_of(bent(), [(0.0, 0.1), (0.01, 0.1)], FREE),
    "frames held": lambda: traverse_of(bent(), [(0.01, 0.1)] * 2, [0, 0, 1e-3, 1e-3, 1e-3, 0, 1e-3, 1e-3]),
    "all frames of a stop held": lambda: traverse_of(bent(), [(0.01, 0.1)] * 2, [0, 0, 1e-3, 1e-3] * 2),
    "a stop held with its frames": lambda: traverse_of(bent(), [(0, 0), (0.01, 0.1)], [0, 0, 1e-3, 1e-3] * 2),
    "a tilt held": lambda: traverse_of(mer_navcam(), [(0.01, 0.1)] * 2, [1e-3, 0, *[1e-3] * 6]),
}


def state_of(t: Traverse, seed: int = 1) -> State:
    """Near telemetry, what telemetry holds as it is; cameras on the chain."""
    rng = np.random.default_rng(seed)
    masts = tuple(
        s.world_T_mast.retract(
            np.repeat([s.sigma_rotation_rad, s.sigma_translation_m], 3) * rng.normal(size=6)
        )
        for s in t.stops
    )
    sigmas = np.array([[f.sigma_pan_rad, f.sigma_tilt_rad] for f in t.frames])
    angles = t.pan_tilt_rad + sigmas * rng.normal(size=sigmas.shape)
    rotations, centres = t.camera_poses(masts, angles)
    return State(
        world_T_mast=masts,
        pan_tilt_rad=angles,
        world_R_camera=rotations,
        world_t_camera=centres,
        landmarks_m=np.zeros((0, 3)),
    )


def free(quantity: Quantity, scope: Scope, *entries: str) -> Sharing:
    freedom: dict[str, Any] = {quantity: Freedom(scope=scope, free=entries or None)}
    return Sharing(**freedom)


ALL = Sharing(calibration=Freedom(scope="eye"), mounts=Freedom(scope="eye"), pan_T_tilt=Freedom(scope="all"))
SHARINGS: dict[str, Sharing] = {
    "nothing": Sharing(),
    "all": ALL,
    "per stop": Sharing(
        calibration=Freedom(scope="stop", free=("fx_px", "cy_px")),
        mounts=Freedom(scope="stop", free=("rx_rad", "rz_rad", "z_m")),
        pan_T_tilt=Freedom(scope="stop", free=("ry_rad", "x_m")),
    ),
    "per image": Sharing(
        calibration=Freedom(scope="image", free=("focal",)), mounts=Freedom(scope="image", free=("y_m",))
    ),
    "focal of all": free("calibration", "all", "focal", "skew_px"),
    "mounts": free("mounts", "eye"),
    "axis": free("pan_T_tilt", "all", "rx_rad", "rz_rad", "y_m"),
}
FLEXING: dict[str, Sharing] = {
    "twist alone": free("flex", "frame", "twist_rad"),
    "flex and all": replace(ALL, flex=Freedom(scope="frame")),
}
"""Sharings of a mast with a hard tie."""


def off(t: Traverse, state: State, seed: int = 2) -> State:
    """The state with a rig that is far off; cameras stay where they were."""
    rng = np.random.default_rng(seed)
    n = len(t.images)
    rig = RigCorrection(
        calibration_px=rng.normal(0, 20, (n, 5)),
        mount=rng.normal(0, 0.3, (n, 6)),
        pan_T_tilt=rng.normal(0, 0.3, (len(t.stops), 6)),
        radius_m=rng.normal(0, 0.01, n),
        flex=rng.normal(0, 0.3, (len(t.frames), 4)),
    )
    return replace(state, rig=rig)


def templates(t: Traverse, sharing: Sharing | None = None) -> dict[str, FactorTemplate]:
    given = sharing or Sharing()
    soft = {
        m: SoftTemplate(t, m, DEFAULT_FLEX[m], given.for_model(m) if m == "mast" else None)
        for m in ("mast", "circle", "free")
    }
    projective = ProjectiveTemplate(t, DEFAULT_FLEX["projective"])
    return {"hard": HardTemplate(t, given), **soft, "projective": projective}


@pytest.mark.parametrize(
    ("name", "kind", "sharing"),
    [
        *slow_but_for(
            [("a tilt held", "hard", "nothing")], ((name, "hard", "nothing") for name in TRAVERSES)
        ),
        *slow_but_for(
            [("a stop held with its frames", "hard", "all"), ("a tilt held", "hard", "all")],
            ((name, "hard", "all") for name in TRAVERSES),
        ),
        *slow_but_for(
            [("all free", "hard", "per stop"), ("all free", "hard", "per image")],
            (("all free", "hard", sharing) for sharing in SHARINGS if sharing not in ("nothing", "all")),
        ),
        *slow_but_for(
            [("all free", "hard", "flex and all"), ("frames held", "hard", "twist alone")],
            ((name, "hard", sharing) for name in TRAVERSES for sharing in FLEXING),
        ),
        *slow_but_for(
            [("all free", "mast", "all"), ("all free", "mast", "per stop")],
            (("all free", "mast", sharing) for sharing in SHARINGS),
        ),
        ("a stop held", "circle", "nothing"),
        pytest.param("all free", "projective", "nothing", marks=pytest.mark.slow),
        ("a stop held with its frames", "projective", "nothing"),
    ],
)
def test_chains_move_cameras_as_values_do(name: str, kind: str, sharing: str) -> None:
    """A unit's twist moves all its cameras as one body: world_R (w x (c - base) + v), by differences.

    Calibrations move by the rows after it. The rig is far off, where a derivative at zero would be wrong.
    """
    t = TRAVERSES[name]()
    template = templates(t, (SHARINGS | FLEXING)[sharing])[kind]
    link, values = template.linkage, template.values(off(t, state_of(t)))
    posture = template.posture(values)
    n_rows, h = posture.chain.shape[1], 1e-6
    unit = link.image_unit
    for key, dim in zip(link.key, link.dim, strict=True):
        for k in range(int(dim)):
            views = []
            for sign in (1, -1):
                step = gtsam.VectorValues()
                step.insert(key, sign * h * np.eye(int(dim))[k])
                views.append(template.views(values.retract(step)))
            velocity = (views[0].world_t_camera - views[1].world_t_camera) / (2 * h)
            turning = (views[0].world_R_camera - views[1].world_R_camera) / (2 * h)
            change = (views[0].calibration - views[1].calibration) / (2 * h)
            twist = np.zeros((len(link.segment_begin) - 1, 11))
            for u in range(len(twist)):
                for s in range(link.segment_begin[u], link.segment_begin[u + 1]):
                    column = k - link.segment_column[s]
                    if link.segment_variable[s] == link.row[key] and 0 <= column < link.segment_width[s]:
                        twist[u, :n_rows] += posture.chain[s][:, column]
            R, base = posture.unit_R[unit], posture.unit_t[unit]
            w, v = (np.einsum("nij,nj->ni", R, twist[unit, i : i + 3]) for i in (0, 3))
            expected = v + np.cross(w, posture.views.world_t_camera - base)
            assert velocity == pytest.approx(expected, abs=2e-8)
            spin = np.cross(w[:, None], posture.views.world_R_camera.transpose(0, 2, 1)).transpose(0, 2, 1)
            assert turning == pytest.approx(spin, abs=2e-8)
            rows, columns = [0, 1, 0, 0, 1], [0, 1, 1, 2, 2]
            assert change[:, rows, columns] == pytest.approx(twist[unit, 6:], abs=1e-5)


@pytest.mark.parametrize("name", TRAVERSES)
def test_hard_cameras_stand_where_the_rig_says(name: str) -> None:
    t = TRAVERSES[name]()
    template, state = HardTemplate(t), state_of(t)
    views = template.posture(template.values(state)).views
    assert views.world_R_camera == pytest.approx(state.world_R_camera, abs=1e-14)
    assert views.world_t_camera == pytest.approx(state.world_t_camera, abs=1e-13)
    for i in range(len(t.images)):
        k = t.rig.pinholes[t.image_eye[i]].calibration_matrix
        assert np.array_equal(views.calibration[i], k)


@pytest.mark.parametrize("kind", ["hard", "mast", "circle", "free", "projective"])
@pytest.mark.parametrize("name", TRAVERSES)
def test_values_and_states_are_each_others_inverse(name: str, kind: str) -> None:
    t = TRAVERSES[name]()
    template, state = templates(t, ALL)[kind], state_of(t)
    values = template.values(state)
    back = template.state(values, state.landmarks_m)
    for found, given in zip(back.world_T_mast, state.world_T_mast, strict=True):
        assert found.matrix() == pytest.approx(given.matrix(), abs=1e-14)
    assert back.pan_tilt_rad == pytest.approx(state.pan_tilt_rad, abs=1e-12)
    assert back.world_R_camera == pytest.approx(state.world_R_camera, abs=1e-13)
    assert back.world_t_camera == pytest.approx(state.world_t_camera, abs=1e-13)
    again = template.values(back)
    assert set(again.keys()) == set(values.keys()) == set(template.linkage.key)
    for key in template.linkage.key:
        a, b = read_variable(values, key), read_variable(again, key)
        same = a.equals(b, 1e-12) if isinstance(a, gtsam.Pose3) else np.allclose(a, b, atol=1e-12)
        assert same


@pytest.mark.parametrize("kind", ["hard", "mast"])
@pytest.mark.parametrize("sharing", SHARINGS)
def test_a_state_keeps_what_of_the_rig_is_free_and_only_that(sharing: str, kind: str) -> None:
    t = TRAVERSES["all free"]()
    template = templates(t, SHARINGS[sharing])[kind]
    values = template.values(off(t, state_of(t)))
    state = template.state(values, np.zeros((0, 3)))
    if sharing == "nothing":
        assert state.rig is None
        return
    assert state.rig is not None
    again = template.values(state)
    for v in template.rig_variables.variables:
        assert again.atVector(v.key) == pytest.approx(values.atVector(v.key), rel=1e-12, abs=1e-14)
    found = {
        "calibration": state.rig.calibration_px,
        "mounts": state.rig.mount,
        "pan_T_tilt": state.rig.pan_T_tilt,
    }
    for quantity, corrections in found.items():
        entries = getattr(SHARINGS[sharing], quantity).entries(quantity)
        names = ENTRIES[quantity]  # type: ignore[index]  # a literal
        free_columns = [e in entries or ("focal" in entries and e in {"fx_px", "fy_px"}) for e in names]
        assert corrections.any(axis=0).tolist() == free_columns


def test_what_is_held_of_the_rig_stays_bit_for_bit() -> None:
    t = TRAVERSES["all free"]()
    sharing = replace(SHARINGS["per stop"], pan_T_tilt=Freedom())
    for template in (templates(t, sharing)[kind] for kind in ("hard", "mast")):
        values = template.values(off(t, state_of(t)))
        k = template.rig_variables.calibration(values)
        nominal = np.array([p.calibration_matrix for p in t.rig.pinholes])[t.image_eye]
        held = np.ones((3, 3), dtype=bool)
        held[0, 0] = held[1, 2] = False
        assert np.array_equal(k[:, held], nominal[:, held])
        assert not np.any(k[:, ~held] == nominal[:, ~held])
        assert template.rig_variables.axes(values) is None


@pytest.mark.parametrize("kind", ["hard", "mast"])
def test_who_shares_a_variable(kind: str) -> None:
    """Numbers of variables and their owners, by scope."""
    t = TRAVERSES["all free"]()
    n_eyes, n_stops, n_images = len(t.rig.eyes), len(t.stops), len(t.images)
    scopes: tuple[tuple[Scope, int], ...] = (
        ("all", 1),
        ("eye", n_eyes),
        ("stop", n_eyes * n_stops),
        ("image", n_images),
    )
    for scope, count in scopes:
        template = templates(t, free("calibration", scope))[kind]
        rig, values = template.rig_variables, template.values(state_of(t))
        variables = rig.of["calibration"]
        assert len(variables) == count
        for v in variables:
            step = gtsam.VectorValues()
            step.insert(v.key, np.ones(5))
            moved = rig.calibration(values.retract(step)) != rig.calibration(values)
            own = np.ones(n_images, dtype=bool)
            if v.eye is not None:
                own &= t.image_eye == v.eye
            if v.stop is not None:
                own &= t.image_stop == v.stop
            if v.image is not None:
                own &= np.arange(n_images) == v.image
            assert moved.any(axis=(1, 2)).tolist() == own.tolist()
            group = template.linkage.group[template.linkage.row[v.key]]
            assert group == (n_stops if v.stop is None else v.stop)


@pytest.mark.parametrize("kind", ["hard", "mast", "circle", "free", "projective"])
@pytest.mark.parametrize("name", TRAVERSES)
def test_what_is_held_is_no_variable_or_a_held_column(name: str, kind: str) -> None:
    t = TRAVERSES[name]()
    template = templates(t)[kind]
    link, held = template.linkage, template.held_columns()
    for i, stop in enumerate(t.stops):
        sigmas = np.repeat([stop.sigma_rotation_rad, stop.sigma_translation_m], 3)
        key = gtsam.symbol("M", i)
        assert (key in link.row) == bool(sigmas.any())
        assert isinstance(template.mast(i), Key if sigmas.any() else Fixed)
        if key in link.row:
            assert held[key].tolist() == np.flatnonzero(sigmas == 0).tolist()
    sigmas = np.array([[f.sigma_pan_rad, f.sigma_tilt_rad] for f in t.frames])
    n_angles = sum(int(d) for k, d in zip(link.key, link.dim, strict=True) if chr(gtsam.symbolChr(k)) == "A")
    n_held = sum(len(columns) for k, columns in held.items() if chr(gtsam.symbolChr(k)) == "A")
    assert n_angles == 2 * np.sum(sigmas.any(axis=1))
    assert n_angles - n_held == np.count_nonzero(sigmas)


@pytest.mark.parametrize("kind", ["hard", "mast"])
@pytest.mark.parametrize("name", TRAVERSES)
def test_factors_cost_what_telemetry_says(name: str, kind: str) -> None:
    """On the chain the ties cost nothing; the priors of masts and angles are left, whatever the tie."""
    t = TRAVERSES[name]()
    template, state = templates(t)[kind], state_of(t)
    expected = 0.0
    for stop, found in zip(t.stops, state.world_T_mast, strict=True):
        sigma = np.repeat([stop.sigma_rotation_rad, stop.sigma_translation_m], 3)
        off = stop.world_T_mast.localCoordinates(found)
        expected += 0.5 * float(np.sum((off[sigma > 0] / sigma[sigma > 0]) ** 2))
    sigmas = np.array([[f.sigma_pan_rad, f.sigma_tilt_rad] for f in t.frames])
    off = state.pan_tilt_rad - t.pan_tilt_rad
    expected += 0.5 * float(np.sum((off[sigmas > 0] / sigmas[sigmas > 0]) ** 2))
    assert template.factors().error(template.values(state)) == pytest.approx(expected, rel=1e-6)


class Known(Covariance):
    """Covariances that tell their group and place."""

    def __init__(self, dims: FloatArray) -> None:
        self.dims = dims

    def block(self, g: int, h: int) -> FloatArray:
        return np.diag(100.0 * (g + 1) + np.arange(int(self.dims[g]))) if g == h else np.zeros(0)


@pytest.mark.parametrize("name", TRAVERSES)
def test_sigmas_are_handed_to_their_own_frames_and_stops(name: str) -> None:
    """Frames of a stop do not follow each other, and held ones have no columns."""
    t = TRAVERSES[name]()
    template = HardTemplate(t)
    link, state = template.linkage, state_of(t)
    covariance = Known(np.array(link.group_dim, dtype=np.float64))
    stops, angles = template.stop_covariance(covariance), template.angle_sigma_rad(covariance, state)
    for i in range(len(t.stops)):
        key = gtsam.symbol("M", i)
        begin = link.columns_of(key).start if key in link.row else None
        expected = np.zeros(6) if begin is None else 100.0 * (i + 1) + begin + np.arange(6)
        assert np.array_equal(stops[i], np.diag(expected))
        place = 0
        for f in np.flatnonzero(t.frame_stop == i):
            frame = t.frames[f]
            if frame.sigma_pan_rad == 0 and frame.sigma_tilt_rad == 0:
                assert not angles[f].any()
                continue
            first = link.columns_of(HardTemplate.angles_key(i)).start + 2 * place
            assert angles[f] == pytest.approx(np.sqrt(100.0 * (i + 1) + first + np.arange(2)))
            place += 1


@pytest.mark.parametrize(
    ("name", "kind"),
    slow_but_for(
        [
            *((name, "hard") for name in TRAVERSES),
            *((name, "mast") for name in TRAVERSES),
            ("a stop held with its frames", "circle"),
            ("a stop held with its frames", "free"),
        ],
        product(TRAVERSES, ["hard", "mast", "circle", "free"]),
    ),
)
def test_angles_move_with_their_variables_as_their_rows_say(name: str, kind: str) -> None:
    t = TRAVERSES[name]()
    template, state = templates(t)[kind], state_of(t)
    link, values, h = template.linkage, template.values(state), 1e-6

    def angles(key: int, component: int, step: float) -> FloatArray:
        moved = gtsam.VectorValues()
        for k, dim in zip(link.key, link.dim, strict=True):
            moved.insert(k, step * np.eye(int(dim))[component] if k == key else np.zeros(int(dim)))
        return template.state(values.retract(moved), np.zeros((0, 3))).pan_tilt_rad

    for frame, stop in enumerate(t.frame_stop.tolist()):
        columns, rows = template.angle_rows(frame, state)
        found = np.zeros((2, int(link.group_dim[stop]) if stop < link.n_groups else 0))
        found[:, columns] = rows
        for key, group, dim in zip(link.key, link.group, link.dim, strict=True):
            if group != stop:
                continue
            begin = link.columns_of(key).start
            for c in range(int(dim)):
                derivative = (angles(key, c, h)[frame] - angles(key, c, -h)[frame]) / (2 * h)
                assert found[:, begin + c] == pytest.approx(derivative, abs=1e-6)


@pytest.mark.parametrize("kind", ["hard", "mast", "circle", "free"])
def test_sigma_of_a_difference_is_that_of_draws(kind: str) -> None:
    t = TRAVERSES["all free"]()
    template, state = templates(t)[kind], state_of(t)
    link, rng = template.linkage, np.random.default_rng(0)
    roots = [rng.normal(size=(int(d), int(d))) for d in link.group_dim]

    class Drawn(Covariance):
        def block(self, g: int, h: int) -> FloatArray:
            assert g == h
            return np.asarray(roots[g] @ roots[g].T)

    pairs = np.array([np.flatnonzero(t.frame_stop == s) for s in range(len(t.stops))])
    covariance = Drawn({})
    relative = template.relative_angle_sigma_rad(covariance, state, pairs)
    single = template.angle_sigma_rad(covariance, state)
    for (i, j), stop, sigma in zip(pairs.tolist(), range(len(t.stops)), relative, strict=True):
        draws = roots[stop] @ rng.normal(size=(len(roots[stop]), 20000))
        (columns_i, rows_i), (columns_j, rows_j) = (template.angle_rows(f, state) for f in (i, j))
        angles = rows_i @ draws[columns_i], rows_j @ draws[columns_j]
        assert sigma == pytest.approx((angles[1] - angles[0]).std(axis=1), rel=0.02)
        assert single[[i, j]] == pytest.approx(np.std(angles, axis=2), rel=0.02)


@pytest.mark.parametrize("name", TRAVERSES)
@pytest.mark.parametrize("sharing", FLEXING)
def test_a_state_keeps_how_heads_flex(sharing: str, name: str) -> None:
    t = TRAVERSES[name]()
    template = HardTemplate(t, FLEXING[sharing])
    values = template.values(off(t, state_of(t)))
    state = template.state(values, np.zeros((0, 3)))
    assert state.rig is not None
    assert state.rig.flex is not None
    again = template.values(state)
    for stop, frames in enumerate(t.frame_stop[None, :] == np.arange(len(t.stops))[:, None]):
        key = gtsam.symbol("F", stop)
        moves = frames & np.array([f.sigmas_rad.any() for f in t.frames])
        assert (key in template.linkage.row) == moves.any()
        if moves.any():
            assert again.atVector(key) == pytest.approx(values.atVector(key))
            assert np.all(state.rig.flex[moves, 0] != 0)
        assert not np.any(state.rig.flex[frames & ~moves])


def test_priors_of_pan_and_tilt_are_widened_by_the_flex_about_these_axes() -> None:
    t = TRAVERSES["a tilt held"]()
    sharing = Sharing(flex=Freedom(scope="frame", free=("twist_rad",), sigma={"twist_rad": 2e-3}))
    widened = HardTemplate(t, sharing).angle_sigmas_rad
    stated = np.array([f.sigmas_rad for f in t.frames])
    assert np.allclose(widened[stated > 0], np.hypot(stated[stated > 0], 2e-3))
    assert np.all(widened[stated == 0] == 0)
