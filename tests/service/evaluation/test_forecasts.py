"""Exact where the codes are linear; and each regime knows what it should, no more and no less."""

import numpy as np
import pytest

from koop_service.evaluation.fits import Constant, ConstantControl, Proximal, TruncatedSVD
from koop_service.evaluation.forecasts import SATURATION, Schedule, forecast, roll_out

from .linear_world import SETTINGS, linear_codes

OFFLINE, PARTIAL, FULL = (Schedule(15, every) for every in (None, 4, 1))
SCHEDULES = pytest.mark.parametrize("schedule", [OFFLINE, PARTIAL, FULL])


@SCHEDULES
@pytest.mark.parametrize("fit", [Proximal(SETTINGS), TruncatedSVD(SETTINGS, 1e-12)])
def test_linear_codes_are_predicted_exactly(fit, schedule):
    codes, controls, _ = linear_codes()
    np.testing.assert_allclose(forecast(fit, schedule, codes, controls), codes, atol=1e-6)


@SCHEDULES
def test_a_right_learned_b_is_exact_and_a_wrong_one_is_not(schedule):
    codes, controls, Theta = linear_codes(trajectories=1)
    right = forecast(ConstantControl(Theta[0, :, 4:5], SETTINGS), schedule, codes, controls)
    np.testing.assert_allclose(right, codes, atol=1e-6)
    wrong = forecast(ConstantControl(-Theta[0, :, 4:5], SETTINGS), schedule, codes, controls)
    assert np.abs(wrong - codes)[:, 15:].max() > 0.1


def test_one_learned_a_is_exact_on_its_own_trajectory_alone():
    codes, controls, Theta = linear_codes(trajectories=2)
    predicted = forecast(Constant(Theta[0], SETTINGS), OFFLINE, codes, controls)
    np.testing.assert_allclose(predicted[0], codes[0], atol=1e-9)
    assert np.abs(predicted[1] - codes[1]).max() > 0.1


def test_the_proximal_fit_solves_the_least_squares_problem():
    codes = np.random.default_rng(1).normal(size=(1, 20, 2))
    controls = np.random.default_rng(2).normal(size=(1, 19, 1))
    (Theta,) = Proximal(SETTINGS).thetas(codes, controls, [19])
    W = np.array(
        [[*codes[0, t - 2], *codes[0, t - 1], *controls[0, t - 1], 1] for t in range(2, 20)]
    )
    expected = np.linalg.lstsq(W, codes[0, 2:])[0].T
    np.testing.assert_allclose(Theta[0], expected, atol=1e-8)


def test_a_threshold_cuts_directions():
    codes, controls, _ = linear_codes()
    (Theta,) = TruncatedSVD(SETTINGS, 0.3).thetas(codes, controls, [39])
    (whole,) = TruncatedSVD(SETTINGS, 1e-12).thetas(codes, controls, [39])
    assert (np.linalg.norm(Theta, axis=(1, 2)) < np.linalg.norm(whole, axis=(1, 2))).all()


@pytest.mark.parametrize(
    ("schedule", "expected"),
    [(OFFLINE, [14]), (PARTIAL, [14, 18, 22, 26]), (FULL, [*range(14, 29)])],
)
def test_restarts(schedule, expected):
    assert [*schedule.restarts(30)] == expected


@pytest.mark.parametrize(("schedule", "every"), [(OFFLINE, 100), (PARTIAL, 4), (FULL, 1)])
def test_each_roll_out_starts_at_the_last_restart(schedule, every):
    rng = np.random.default_rng(3)
    codes, controls = rng.normal(size=(2, 30, 2)), rng.normal(size=(2, 29, 1))
    Theta = 0.3 * rng.normal(size=(2, 6))
    predicted = forecast(Constant(Theta, SETTINGS), schedule, codes, controls)
    for i in range(2):
        known = [*codes[i, :15]]
        np.testing.assert_array_equal(predicted[i, :15], codes[i, :15])
        for t in range(15, 30):
            known.append(Theta @ [*known[t - 2], *known[t - 1], *controls[i, t - 1], 1])
            np.testing.assert_allclose(predicted[i, t], known[t])
            if (t - 14) % every == 0:  # frame t is measured; the next ones start from it
                known = [*codes[i, : t + 1]]


@pytest.mark.parametrize(("schedule", "unmoved"), [(OFFLINE, 30), (PARTIAL, 23), (FULL, 22)])
def test_nothing_is_known_before_its_time(schedule, unmoved):
    """Changing frame 21 and later moves no prediction made before a restart has seen frame 21."""
    rng = np.random.default_rng(4)
    codes, controls = rng.normal(size=(2, 30, 2)), rng.normal(size=(2, 29, 1))
    other = codes.copy()
    other[:, 21:] += 1.0
    fit = Proximal(SETTINGS)
    before, after = (forecast(fit, schedule, c, controls) for c in (codes, other))
    np.testing.assert_array_equal(before[:, :unmoved], after[:, :unmoved])
    assert unmoved == 30 or np.abs(before - after)[:, unmoved].max() > 1e-6


def test_a_diverging_roll_out_stays_finite():
    Theta = np.full((1, 2, 6), 3.0)
    codes = roll_out(Theta, np.ones((1, 2, 2)), np.ones((1, 2000, 1)), SETTINGS)
    assert codes.max() == SATURATION
    assert np.isfinite(codes).all()


@pytest.mark.parametrize("fit_frames", [2, 30])
def test_a_fit_that_leaves_nothing(fit_frames):
    codes, controls, _ = linear_codes(frames=30)
    with pytest.raises(ValueError, match="expected more than the history's 2, and fewer"):
        forecast(Proximal(SETTINGS), Schedule(fit_frames), codes, controls)


@pytest.mark.parametrize("baseline", [Constant, ConstantControl])
def test_a_learned_matrix_that_does_not_fit(baseline):
    with pytest.raises(ValueError, match=r"has shape \(3, 3\); expected"):
        baseline(np.zeros((3, 3)), SETTINGS)
