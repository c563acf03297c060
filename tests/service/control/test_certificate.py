"""The verdict: controllable or not, excited or not, as expected or surprised."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.control.certificate import certify, unstable_modes
from koop_service.estimation.estimator import Bank
from koop_service.estimation.settings import EstimatorSettings
from koop_service.prediction.model import LinearModel

from .systems import pendulum, random_model

NOISE = 1e-3


def learned(plant, controls, affine=False, seed=0, history=None, **prior):
    """Learn `plant` from a noisy run under `controls` (K, p): the arguments of `certify`."""
    rng = np.random.default_rng(seed)
    n, h, p = plant.code_size, plant.history, plant.control_size
    settings = EstimatorSettings(n, h, p, affine=affine, **{"rho": 1e-4, **prior})
    bank = Bank(settings)
    lane, E = bank.open(), []
    codes = list(np.zeros((h, n)) if history is None else history)
    for u in controls:
        x = np.concatenate(codes[-h:])
        codes.append(plant.A @ x + plant.B @ u + plant.c + NOISE * rng.normal(size=n))
        w = np.concatenate([x, u, np.ones(int(affine))])
        E.append(bank.fold(np.array([lane]), w[None], codes[-1][None])[0].copy())
    model = LinearModel.from_theta(bank.theta(lane), settings)
    R = bank.factor(lane).R
    return model, bank.covariance(lane), R, settings.ignorance, np.stack(E[-10:])


def excitation(steps, p, seed=1, size=1.0):
    return size * np.random.default_rng(seed).normal(size=(steps, p))


@pytest.mark.parametrize(("h", "p", "affine"), [(1, 1, False), (2, 2, True), (3, 1, True)])
def test_an_excited_model_that_can_be_steered_is_fit(h, p, affine):
    plant = random_model(np.random.default_rng(h), 3, h, p, 1.03, affine)
    certificate = certify(*learned(plant, excitation(100, p), affine), -1.0, 1.0)
    assert certificate.reasons == ()
    assert certificate.fit
    assert certificate.stabilisable
    assert certificate.probing is None
    assert len(certificate.modes) >= 1
    assert certificate.modes[0].score > 3
    assert (certificate.scores > 10).all()
    assert (certificate.information > 1e3).all()
    assert 0.3 < certificate.residual < certificate.band == 2.0


def test_a_mode_that_no_control_reaches_is_named():
    plant = LinearModel(np.diag([1.04, 0.5]), np.array([[0.0], [1.0]]), np.zeros(2))
    arguments = learned(plant, excitation(80, 1), history=np.array([[0.1, 0.0]]))
    certificate = certify(*arguments, -1.0, 1.0)
    assert not certificate.fit
    assert not certificate.stabilisable
    (mode,) = certificate.modes
    assert mode.eigenvalue == pytest.approx(1.04, abs=1e-3)
    assert mode.margin < 1e-3
    (reason,) = certificate.reasons
    assert "a mode that grows by 4% a step is not steered" in reason
    assert certificate.scores[0] > 10  # B itself is well known: what lacks is not excitation


def test_two_equal_modes_and_one_control_leave_one_to_itself():
    """Each mode alone has a gain; only the rank of [lambda I - F, G] sees that they are one."""
    model = LinearModel(1.1 * np.eye(2), np.ones((2, 1)), np.zeros(2))
    R = 100.0 * np.eye(3)
    certificate = certify(model, np.zeros((2, 2)), R, 1.0, np.zeros((0, 2)))
    assert all(mode.score > 100 for mode in certificate.modes)
    assert not certificate.stabilisable
    steered = LinearModel(np.diag([1.1, 1.2]), np.ones((2, 1)), np.zeros(2))
    assert certify(steered, np.zeros((2, 2)), R, 1.0, np.zeros((0, 2))).fit


def test_a_mode_that_hardly_grows_is_drift_and_no_reason():
    drift = LinearModel(np.diag([1.001, 0.5]), np.array([[0.0], [1.0]]), np.zeros(2))
    certificate = certify(drift, np.zeros((2, 2)), 100.0 * np.eye(3), 1.0, np.zeros((0, 2)))
    assert certificate.fit
    assert len(certificate.modes) == 1
    assert certificate.modes[0].score == 0.0


@pytest.mark.parametrize("affine", [False, True])
def test_a_control_that_was_never_moved_is_not_known_until_probed(affine):
    plant = pendulum(p=2, h=2, gravity=-20.0)
    start = np.array([[0.3, 0.0], [0.3, 0.0]])
    still = excitation(60, 2)
    still[:, 1] = 0.0
    certificate = certify(*learned(plant, still, affine, history=start), -1.0, 1.0)
    assert not certificate.fit
    (reason,) = certificate.reasons
    assert "control 1 was hardly moved" in reason
    assert certificate.information[0] > 100 > 2 > certificate.information[1]
    probing = certificate.probing
    assert probing.shape == (3 * (4 + 2 + affine), 2)
    assert (np.abs(probing) <= 0.5).all()
    after = np.concatenate([still, probing])
    assert certify(*learned(plant, after, affine, history=start), -1.0, 1.0).fit


def test_what_a_control_does_may_be_known_before_it_moves():
    plant = pendulum(h=2, gravity=-20.0)
    still, start = np.zeros((60, 1)), np.array([[0.3, 0.0], [0.3, 0.0]])
    mean = tuple(map(tuple, np.hstack([plant.A, plant.B]).tolist()))
    ignorant = learned(plant, still, history=start, rho=1.0)
    assert "hardly moved" in "".join(certify(*ignorant, -1.0, 1.0).reasons)
    informed = learned(plant, still, history=start, rho=1.0, prior_mean=mean)
    certificate = certify(*informed, -1.0, 1.0)
    assert certificate.fit
    assert certificate.information[0] == np.inf
    nothing = tuple(map(tuple, np.hstack([plant.A, 0 * plant.B]).tolist()))
    certificate = certify(
        *learned(plant, still, history=start, rho=1.0, prior_mean=nothing), -1.0, 1.0
    )
    assert not certificate.fit
    assert "what control 0 does is not known" in certificate.reasons[-1]


def test_a_constant_control_is_not_told_from_the_constant():
    """Moved far from zero, and yet nothing is known of it apart from the model's own constant."""
    plant = pendulum(h=1, gravity=-20.0)
    pushed = np.full((60, 1), 5.0)
    start = np.array([[0.3, 0.0]])
    assert certify(*learned(plant, pushed, affine=False, history=start)).fit
    certificate = certify(*learned(plant, pushed, affine=True, history=start))
    assert not certificate.fit
    assert any("control 0" in reason for reason in certificate.reasons)


def test_a_control_without_effect_is_excited_but_not_known_to_act():
    plant = LinearModel(0.8 * np.eye(2), np.zeros((2, 1)), np.zeros(2))
    certificate = certify(*learned(plant, excitation(80, 1)))
    assert certificate.information[0] > 1e4
    assert certificate.scores[0] < 2
    assert "what control 0 does is not known" in certificate.reasons[0]


def test_a_system_that_changed_surprises_the_model():
    model, S, R, rho, innovations = learned(pendulum(h=2, gravity=-20.0), excitation(80, 1))
    assert certify(model, S, R, rho, innovations).fit
    certificate = certify(model, S, R, rho, 3.0 * innovations)
    assert not certificate.fit
    assert certificate.residual > 2.0
    assert "the last 10 codes are" in certificate.reasons[0]
    assert certify(model, S, R, rho, innovations[:0]).fit


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 2), st.floats(0.01, 100.0))
def test_the_units_of_the_control_do_not_matter(seed, h, p, unit):
    rng = np.random.default_rng(seed)
    model = random_model(rng, 3, h, p, 1.2)
    other = LinearModel(model.A, model.B / unit, model.c)
    S, C = np.diag(rng.uniform(0.1, 1.0, 3)), rng.uniform(0.1, 1.0, p)
    modes = unstable_modes(model, S, C, np.full(p, 2.0))
    same = unstable_modes(other, S, C / unit**2, np.full(p, 2.0 * unit))
    assert [mode.eigenvalue for mode in modes] == [mode.eigenvalue for mode in same]
    np.testing.assert_allclose(
        [mode[1:] for mode in modes], [mode[1:] for mode in same], rtol=1e-6, atol=1e-9
    )
    assert abs(modes[0].eigenvalue) == pytest.approx(1.2)


def test_bad_arguments_say_what_was_wrong():
    model, S, R, rho, innovations = learned(pendulum(), excitation(20, 1))
    with pytest.raises(ValueError, match="no control input"):
        certify(random_model(np.random.default_rng(0), p=0), S, R, rho, innovations)
    with pytest.raises(ValueError, match=r"R has shape \(2, 2\); expected \(d, d\) with d = 3"):
        certify(model, S, R[:2, :2], rho, innovations)
    with pytest.raises(ValueError, match=r"S has shape \(1, 1\)"):
        certify(model, S[:1, :1], R, rho, innovations)
    with pytest.raises(ValueError, match="du_min <= 0"):
        certify(model, S, 1e-6 * R, rho, innovations, du_min=1.0)
