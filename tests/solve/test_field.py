"""A smooth distortion field in a solve: found, told in every sigma, and estimated where it should be."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pancam_graph import SolveOptions, build_graph, cross_validate, simulate, solve
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, wrap_angle
from pancam_graph.cameras import FIELD_SHAPE, FieldCamera, fields_of, with_field
from pancam_graph.data import FIXED, Freedom, Sharing, Solution, Traverse
from pancam_graph.graph import Model
from pancam_graph.rigs import rig_template
from pancam_graph.simulate import Simulation, SimulationOptions
from pancam_graph.smoother import solve_incrementally
from pancam_graph.solve import free_numbers

OPTIONS = SimulationOptions(stops=1, pans=4, points_per_image=60, field_error="drawn", prior="truth")
WITH_FIELD = SolveOptions(field=True)


@cache
def drive(noise_px: float = 0.05, seed: int = 1) -> Simulation:
    """One stop of four Navcam frames with a field of which the traverse does not know."""
    rig = rig_template("msl-navcam")
    rig = replace(rig, eyes=rig.eyes[:2], uncertainty=replace(rig.uncertainty, field_px=0.3))
    return simulate(rig, replace(OPTIONS, noise_px=noise_px), seed=seed)


@cache
def solved() -> Solution:
    return solve(drive().traverse, WITH_FIELD)


def from_images(traverse: Traverse) -> Traverse:
    """The same observations as if this package had measured them."""
    assert traverse.observations is not None
    return traverse.with_observations(replace(traverse.observations, origin="images"))


def field_of(solution: Solution) -> FloatArray | None:
    return None if solution.final.rig is None else solution.final.rig.field_px


def test_a_field_is_found_and_explains_the_residuals() -> None:
    made, found = drive(), solved()
    held = solve(made.traverse, SolveOptions(field=False))
    assert found.passed
    assert found.rms_final_px < 0.6 * held.rms_final_px
    field, truth = field_of(found), made.truth.field_px
    assert field is not None and truth is not None
    assert field.shape == (2, *FIELD_SHAPE) == truth.shape
    # What is constant or linear over the image is the calibration's as well as the field's.
    assert np.corrcoef(_curved(field), _curved(truth))[0, 1] > 0.6
    assert field_of(held) is None


def _curved(field: FloatArray) -> FloatArray:
    """Second differences along both sides of the middle of each field."""
    middle = field[:, :, 1:-1, 1:-1]
    return np.concatenate([np.diff(middle, 2, axis=2).ravel(), np.diff(middle, 2, axis=3).ravel()])


def is_free(traverse: Traverse, options: SolveOptions) -> bool:
    return free_numbers(traverse, options).field != FIXED


def test_where_it_is_estimated_unasked() -> None:
    given, measured = drive().traverse, from_images(drive().traverse)
    assert not is_free(given, SolveOptions())
    assert is_free(measured, SolveOptions())
    assert not is_free(measured, SolveOptions(rig="held"))
    assert not is_free(measured, SolveOptions(sharing=Sharing(calibration=Freedom(scope="eye"))))
    exact = replace(given.rig, uncertainty=replace(given.rig.uncertainty, field_px=0.0))
    assert not is_free(replace(measured, rig=exact), SolveOptions())
    assert is_free(given, SolveOptions(rig="held", field=True))


@pytest.mark.slow
def test_a_sharing_frees_it_alone() -> None:
    sharing = Sharing(field=Freedom(scope="eye", sigma={"field_px": 0.3}))
    found = solve(drive().traverse, SolveOptions(sharing=sharing))
    assert found.converged
    assert field_of(found) is not None
    assert not found.refined


@pytest.mark.parametrize(
    "options",
    [
        {"model": "circle"},
        {"tie": "soft"},
        {"method": "alternation"},
        {"landmarks": "explicit"},
        {"rig": "considered"},
    ],
)
def test_other_solves_have_none(options: dict[str, str]) -> None:
    with pytest.raises(InputError, match="field: expected none but with the model mast"):
        SolveOptions(field=True, **options)  # type: ignore[arg-type]  # parameters of the test
    measured = from_images(drive().traverse)
    assert not is_free(measured, SolveOptions(**options))  # type: ignore[arg-type]  # parameters of the test
    if "rig" not in options:
        sharing = Sharing(field=Freedom(scope="eye"))
        with pytest.raises(InputError, match="field: expected fixed"):
            free_numbers(measured, SolveOptions(**options, sharing=sharing))  # type: ignore[arg-type]  # same


def test_stop_by_stop_ends_with_the_field_of_the_whole() -> None:
    step = solve_incrementally(drive().traverse, replace(WITH_FIELD, loss="none"))
    whole = solve(drive().traverse, replace(WITH_FIELD, loss="none"))
    a, b = field_of(step), field_of(whole)
    assert a is not None and b is not None
    assert a == pytest.approx(b, abs=0.02)
    assert step.passed


@cache
def known() -> tuple[Traverse, Traverse]:
    """A drive whose rig has the true fields, and the same with these taken out of rig and observations."""
    made = drive()
    traverse, field_px = made.traverse, made.truth.field_px
    observed = traverse.observations
    assert observed is not None and field_px is not None
    eyes = [
        replace(eye, camera=with_field(eye.camera, px))
        for eye, px in zip(traverse.rig.eyes, field_px, strict=True)
    ]
    fields = fields_of([eye.camera for eye in eyes], traverse.image_eye)
    assert fields is not None
    plain = replace(observed, uv_px=observed.uv_px - fields.at(observed.image, observed.uv_px))
    return replace(traverse, rig=replace(traverse.rig, eyes=tuple(eyes))), traverse.with_observations(plain)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"model": "circle"},
        pytest.param({"model": "projective"}, marks=pytest.mark.slow),
        pytest.param({"method": "alternation"}, marks=pytest.mark.slow),
        {"rig": "considered"},
    ],
)
def test_a_field_that_the_rig_has_is_as_none_in_the_observations(options: dict[str, str]) -> None:
    chosen = SolveOptions(loss="none", **options)  # type: ignore[arg-type]  # parameters of the test
    with_it, without = (solve(traverse, chosen) for traverse in known())
    assert with_it.cost_final == pytest.approx(without.cost_final, rel=1e-6)
    assert with_it.final.pan_tilt_rad == pytest.approx(without.final.pan_tilt_rad, abs=1e-9)
    assert with_it.angle_sigma_rad == pytest.approx(without.angle_sigma_rad, rel=1e-6)
    for camera, plain in zip(with_it.image_cameras, without.image_cameras, strict=True):
        assert isinstance(camera, FieldCamera)
        assert camera.lens.pinhole == plain.pinhole


def test_stop_by_stop_a_field_of_the_rig_counts() -> None:
    with_it, without = (solve_incrementally(traverse, SolveOptions(loss="none")) for traverse in known())
    assert with_it.cost_final == pytest.approx(without.cost_final, rel=1e-6)


@pytest.mark.parametrize("model", ["mast", "circle"])
def test_in_a_graph_a_field_of_the_rig_counts(model: Model) -> None:
    errors = []
    for traverse in known():
        observed = traverse.observations
        assert observed is not None
        few = traverse.with_observations(observed.select(np.flatnonzero(observed.track % 20 == 0)))
        graph, values = build_graph(few, SolveOptions(loss="none", model=model))
        errors.append(graph.error(values))
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)


def test_a_field_is_estimated_about_that_of_the_rig() -> None:
    """Where the rig has the true field, what is found is less than its uncertainty, and all is in the rig."""
    with_it, _ = known()
    found = solve(with_it, WITH_FIELD)
    change, told = field_of(found), with_it.rig.eyes[0].camera
    assert change is not None and isinstance(told, FieldCamera)
    assert np.sqrt(np.mean(change**2)) < 0.5 * np.sqrt(np.mean(told.field_px**2))
    refined = found.rig.eyes[0].camera
    assert isinstance(refined, FieldCamera)
    assert refined.field_px == pytest.approx(told.field_px + change[0])


@pytest.mark.slow
def test_halves_have_the_field_of_the_whole() -> None:
    traverse, found = drive().traverse, solved()
    checked = cross_validate(traverse, WITH_FIELD, solution=found, halvings=1)
    held = cross_validate(traverse, SolveOptions(field=False), halvings=1)
    assert checked.relative_pointing.upper_lower.overall < 2.0
    assert checked.relative_pointing.upper_lower.overall < held.relative_pointing.upper_lower.overall


def test_a_field_beyond_its_uncertainty_is_said() -> None:
    t = drive().traverse
    narrow = replace(t, rig=replace(t.rig, uncertainty=replace(t.rig.uncertainty, field_px=0.05)))
    told, silent = solve(narrow, WITH_FIELD).verdict, solved().verdict
    assert told is not None and silent is not None
    (note,) = (test for test in told.notes if test.name == "field")
    assert "look for a better calibration" in note.says
    assert "field" not in {test.name for test in silent.notes}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mer-navcam", "msl-navcam"])
def test_errors_with_drawn_fields_agree_with_their_sigmas(name: str) -> None:
    """Squared error over variance of pans and tilts, over seeds."""
    rig = rig_template(name)
    rig = replace(rig, eyes=rig.eyes[:2])
    options = SimulationOptions(
        stops=1, pans=6, points_per_image=60, noise_px=0.1, rig_error="drawn", field_error="drawn"
    )
    squares = []
    for seed in range(800, 820):
        made = simulate(rig, options, seed=seed)
        found = solve(made.traverse, SolveOptions(field=True, rescale_noise=False))
        off = wrap_angle(found.final.pan_tilt_rad - made.truth.pan_tilt_rad)
        squares.append(float(np.mean((off / found.angle_sigma_rad) ** 2)))
    assert np.mean(squares) == pytest.approx(1.0, abs=0.3)
