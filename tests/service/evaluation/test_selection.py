"""The rho of a fit that is never updated: chosen on the fit frames, and on nothing else."""

import numpy as np
import pytest

from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.fits import Proximal
from koop_service.evaluation.selection import with_offline_rho

SETTINGS = EstimatorSettings(code_size=2, history=1, affine=True, rho=0.5)
FIT = 40


def rotating(trajectories: int, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Codes (N, 80, 2) on circles, measured with noise."""
    angle = 0.3 * np.arange(80) + rng.uniform(0, 6, (trajectories, 1))
    codes = np.stack([np.cos(angle), np.sin(angle)], axis=2)
    return codes + noise * rng.standard_normal(codes.shape)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_exactly_linear_codes_want_the_weakest_prior(rng):
    codes = rotating(5, 0.0, rng)
    chosen = with_offline_rho(Proximal, SETTINGS, FIT, codes, np.zeros((5, 79, 0)))
    assert chosen.rho == 1e-4


def test_pure_noise_wants_a_strong_prior(rng):
    codes = rng.standard_normal((5, 80, 2))
    chosen = with_offline_rho(Proximal, SETTINGS, FIT, codes, np.zeros((5, 79, 0)))
    assert chosen.rho == 10.0


def test_what_comes_after_the_fit_is_not_looked_at(rng):
    codes = rotating(5, 0.05, rng)
    other = codes.copy()
    other[:, FIT:] = rng.standard_normal(other[:, FIT:].shape)
    first, second = (
        with_offline_rho(Proximal, SETTINGS, FIT, c, np.zeros((5, 79, 0))) for c in (codes, other)
    )
    assert first == second


def test_the_rest_of_the_settings_stays(rng):
    codes = rotating(2, 0.0, rng)
    chosen = with_offline_rho(Proximal, SETTINGS, FIT, codes, np.zeros((2, 79, 0)))
    assert (chosen.code_size, chosen.history, chosen.affine) == (2, 1, True)
