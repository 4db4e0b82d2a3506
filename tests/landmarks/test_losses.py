"""Robust losses: NumPy's cost and weight against GTSAM's through a factor, and against each other."""

import gtsam
import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.landmarks import SQUARED, Loss, LossName, loss_of

NAMES: list[LossName] = ["none", "huber", "cauchy"]
LENGTHS = [0.0, 1e-9, 0.3, 1.3449, 1.3451, 2.5, 10.0, 1e6]
SIGMA = 0.5


def losses() -> list[Loss]:
    return [loss_of(name, scale) for name in NAMES for scale in (1.0, 2.5)]


IDS = [f"{loss.name}-{loss.width:.3g}" for loss in losses()]


@pytest.mark.parametrize("loss", losses(), ids=IDS)
@pytest.mark.parametrize("length", LENGTHS)
def test_cost_and_weight_are_those_of_the_noise_model(loss: Loss, length: float) -> None:
    """A prior on a 2-vector, off by a whitened residual of the given length."""
    whitened = length * np.array([0.6, -0.8])
    factor = gtsam.PriorFactorVector(
        0, -SIGMA * whitened, loss.noise_model(gtsam.noiseModel.Isotropic.Sigma(2, SIGMA))
    )
    values = gtsam.Values()
    values.insert(0, np.zeros(2))
    assert loss.cost(whitened[None])[0] == pytest.approx(factor.error(values), rel=1e-12, abs=1e-300)
    rows, right = factor.linearize(values).jacobian()
    weight = loss.weight(whitened[None])[0]
    assert rows == pytest.approx(np.sqrt(weight) / SIGMA * np.eye(2), rel=1e-12)
    assert right == pytest.approx(-np.sqrt(weight) * whitened, rel=1e-12)


@pytest.mark.parametrize("loss", losses(), ids=IDS)
def test_weight_makes_the_gradient_of_the_cost(loss: Loss) -> None:
    rng = np.random.default_rng(0)
    residual = rng.normal(0, 4, (50, 2))
    h = 1e-6
    for axis in range(2):
        step = h * np.eye(2)[axis]
        numeric = (loss.cost(residual + step) - loss.cost(residual - step)) / (2 * h)
        assert loss.weight(residual) * residual[:, axis] == pytest.approx(numeric, abs=1e-7)


@pytest.mark.parametrize("loss", losses(), ids=IDS)
def test_a_loss_is_half_the_square_near_zero(loss: Loss) -> None:
    residual = np.array([[1e-3, 2e-3]])
    assert loss.cost(residual)[0] == pytest.approx(0.5 * 5e-6, rel=1e-5)
    assert loss.weight(residual)[0] == pytest.approx(1, rel=1e-5)
    assert loss.weight(np.zeros((1, 2)))[0] == 1


@pytest.mark.parametrize(("name", "width"), [("huber", 1.345), ("cauchy", 2.3849)])
def test_ninety_five_percent_efficiency_for_gaussian_noise(name: LossName, width: float) -> None:
    """Asymptotic variance of a location estimate, E[psi^2] / E[psi']^2, integrated on a grid."""
    loss = loss_of(name)
    assert loss.width == width
    x = np.linspace(-9, 9, 20001)
    density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi) * (x[1] - x[0])
    psi = loss.weight(x[:, None]) * x
    slope = np.gradient(psi, x)
    variance = np.sum(density * psi**2) / np.sum(density * slope) ** 2
    assert 1 / variance == pytest.approx(0.95, abs=5e-4)


def test_an_unknown_loss_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="loss: expected one of none, huber, cauchy; found 'tukey'"):
        loss_of("tukey")  # type: ignore[arg-type]


def test_no_robust_loss_leaves_the_noise_model_alone() -> None:
    gaussian = gtsam.noiseModel.Unit.Create(2)
    assert SQUARED.noise_model(gaussian) is gaussian
    assert loss_of("none", 3.0) == SQUARED
