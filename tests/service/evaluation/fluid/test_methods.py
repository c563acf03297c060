"""Each regime knows what it should, no more and no less."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.fluid.cases import FIT_FRAMES, UPDATE_AT
from koop_service.evaluation.fluid.methods import REGIMES, Known, ours, theirs
from koop_service.evaluation.forecasts import Array
from koop_service.learning.dynamics import LearnedDynamics

SETTINGS = EstimatorSettings(2, history=1, control_size=1, affine=True, rho=1e-4, forgetting=0.97)
ANGLE = 0.7
A = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
B = np.array([[0.3], [-0.2]])


def known(frames: int = 116, count: int = 3, size: int = 1) -> Known:
    """Codes that turn, with pushes."""
    rng = np.random.default_rng(0)
    controls = rng.normal(size=(count, frames - 1, size))
    codes = np.empty((count, frames, 2))
    codes[:, 0] = rng.normal(size=(count, 2))
    for k in range(frames - 1):
        codes[:, k + 1] = codes[:, k] @ A.T + controls[:, k] @ B[:, :size].T + 0.1
    return Known(dataclasses.replace(SETTINGS, control_size=size), codes, controls)


def predicted(given: Known) -> dict[str, Array]:
    return {method.name: method.predict(given) for method in ours(given)}


@pytest.mark.parametrize("size", [0, 1])
def test_linear_codes_are_predicted_by_every_regime(size: int) -> None:
    given = known(size=size)
    assert list(predicted(given)) == list(REGIMES)
    for found in predicted(given).values():
        np.testing.assert_allclose(found, given.codes, atol=1e-3)


def changed_from(frame: int) -> tuple[dict[str, Array], dict[str, Array]]:
    """Predictions before and after the codes from `frame` on became others."""
    given = known()
    codes = given.codes.copy()
    codes[:, frame:] = np.random.default_rng(1).normal(size=codes[:, frame:].shape)
    return predicted(given), predicted(dataclasses.replace(given, codes=codes))


@pytest.mark.parametrize("regime", ["offline", "once"])
def test_a_fit_that_stays_knows_its_own_frames_alone(regime: str) -> None:
    last = {"offline": FIT_FRAMES, "once": UPDATE_AT}[regime]
    before, after = changed_from(last)
    np.testing.assert_array_equal(before[regime], after[regime])
    before, after = changed_from(last - 1)
    assert (before[regime][:, last:] != after[regime][:, last:]).any()


def test_until_its_update_one_update_is_none() -> None:
    before, after = changed_from(UPDATE_AT - 5)
    for found in (before, after):
        until = slice(0, UPDATE_AT)
        np.testing.assert_array_equal(found["once"][:, until], found["offline"][:, until])


def test_full_updates_know_every_frame_before() -> None:
    before, after = changed_from(60)
    np.testing.assert_array_equal(before["full"][:, :61], after["full"][:, :61])
    assert (before["full"][:, 61] != after["full"][:, 61]).any()


def test_the_learned_baselines() -> None:
    given = known()
    right, wrong = (LearnedDynamics("learned-B", sign * B) for sign in (1, -1))
    found = {method.name: method.predict(given) for method in theirs(right, given)}
    assert list(found) == ["learned-B", "learned-B-once", "learned-B-full"]
    for codes in found.values():
        np.testing.assert_allclose(codes, given.codes, atol=1e-3)
    for method in theirs(wrong, given):
        assert np.abs(method.predict(given) - given.codes).max() > 0.1
    Theta = np.concatenate([A, B, np.full((2, 1), 0.1)], axis=1)
    (only,) = theirs(LearnedDynamics("learned-A", Theta), given)
    assert only.name == "learned-A"
    np.testing.assert_allclose(only.predict(given), given.codes, atol=1e-9)
