"""First plans and verdicts, on a known linear system without a network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from koop_protocol import ErrorCode, Limits, LqrQuery, LqrReply, ProtocolError, decode, encode
from koop_service.serving.answering.queries import control

from .linear import N, Plant, registry_of

BOUND = np.ones(1)
LIMITS = Limits()


def query(**changes: object) -> LqrQuery:
    options = {"horizon": 12, "target_code": np.zeros(N), "r": 0.1, "u_min": -BOUND, "u_max": BOUND}
    return LqrQuery(**{**options, **changes})


@pytest.fixture
def plant(tmp_path: Path) -> Plant:
    return Plant(registry_of(tmp_path))


def test_a_well_excited_model_is_fit_and_its_numbers_travel(plant):
    plant.excite()
    reply = control(plant.trajectory, query(), LIMITS)
    assert (reply.fit, reply.reasons, reply.status) == (True, (), "solved")
    assert (reply.seq, reply.start) == (plant.seq, plant.seq)
    assert reply.controls.shape == (12, 1)
    assert reply.probing is None
    assert reply.modes.shape == (1, 4)
    assert reply.modes[0, 0] == pytest.approx(1.05, abs=0.01)
    assert (reply.scores > 2).all()
    assert (reply.information > 10).all()
    assert 0 < reply.residual < reply.band == 2.0
    assert isinstance(decode(encode(reply)), LqrReply)


@pytest.mark.parametrize("method", ["qp", "gain"])
def test_with_a_delay_the_codes_are_those_after_it(plant, method):
    plant.excite()
    options = {"method": method, "returns": frozenset({"codes", "frames"})}
    reply = control(plant.trajectory, query(delay=2, **options), LIMITS)
    assert reply.start == reply.seq + 2
    for _ in range(2):  # what acts meanwhile is taken to be the last control, held
        plant.step(plant.trajectory.last_control())
    plant.step(reply.controls[0])
    np.testing.assert_allclose(plant.code, reply.codes[0], atol=0.02)
    assert reply.frames.shape == (12, 64, 64)


def test_a_model_that_was_never_excited_gets_a_probing_input_inside_the_bounds(plant):
    for _ in range(120):
        plant.step(np.zeros(1))
    reply = control(plant.trajectory, query(), LIMITS)
    assert not reply.fit
    assert "hardly moved" in " ".join(reply.reasons)
    assert (reply.status, reply.controls, reply.codes) == ("unfit", None, None)
    assert (reply.cost, reply.kkt_residual) == (0.0, 0.0)
    assert np.abs(reply.probing).max() <= 1.0
    for u in np.concatenate([reply.probing, reply.probing]):
        plant.step(u)
    assert control(plant.trajectory, query(), LIMITS).fit


def test_forced_it_gives_controls_and_says_that_it_is_not_fit(plant):
    for _ in range(120):
        plant.step(np.zeros(1))
    reply = control(plant.trajectory, query(force=True, returns=frozenset({"codes"})), LIMITS)
    assert not reply.fit
    assert reply.reasons
    assert reply.controls.shape == (12, 1)
    assert reply.codes.shape == (12, N)
    assert reply.probing is None


def test_a_model_just_warmed_up_has_not_proved_itself(plant):
    plant.excite(plant.trajectory.settings.warmup_frames - 1)
    reply = control(plant.trajectory, query(), LIMITS)
    assert not reply.fit
    assert "0 frames only" in " ".join(reply.reasons)
    assert (reply.residual, reply.band) == (0.0, 0.0)
    plant.excite(30)
    assert control(plant.trajectory, query(), LIMITS).fit


def test_a_changed_system_is_noticed(plant):
    plant.excite()
    for _ in range(10):
        plant.code = plant.code + 0.1 * np.ones(N)
        plant.step(np.zeros(1))
    reply = control(plant.trajectory, query(), LIMITS)
    assert reply.residual > reply.band
    assert not reply.fit


def test_a_target_that_cannot_be_held_is_warned_of(plant):
    plant.excite()
    reply = control(plant.trajectory, query(target_code=np.full(N, 30.0)), LIMITS)
    assert reply.fit
    assert "can hold within the bounds" in reply.warnings[0]
    assert control(plant.trajectory, query(), LIMITS).warnings == ()


def test_a_picture_unlike_any_is_no_target(tmp_path):
    plant = Plant(registry_of(tmp_path, {"reconstruction": 0.01})).excite()
    noise = np.random.default_rng(0).integers(0, 256, (64, 64)).astype(np.uint8)
    reply = control(plant.trajectory, query(target_code=None, target_image=noise), LIMITS)
    assert not reply.fit
    assert reply.reasons[-1] == reply.warnings[-1]
    assert "unlike" in reply.reasons[-1]
    assert reply.target_error > 3 * 0.01 * 255
    assert reply.controls is None


def test_an_answer_from_a_snapshot_is_the_same(plant, tmp_path):
    """The newest innovations are part of the answer, so they are kept too."""
    plant.excite()
    other = registry_of(tmp_path)
    assert other.restore(plant.trajectory_records()) == 1
    restored = other.find(plant.trajectory.name)
    one, two = (control(trajectory, query(), LIMITS) for trajectory in (plant.trajectory, restored))
    assert encode(one) == encode(two)


def test_an_unstable_model_over_a_long_horizon_is_refused(plant):
    plant.excite()
    plant.trajectory.model = lambda: _wild(plant)
    with pytest.raises(ProtocolError) as caught:
        control(plant.trajectory, query(horizon=400, force=True), LIMITS)
    assert caught.value.code == ErrorCode.bad_horizon


def _wild(plant: Plant):
    model = type(plant.trajectory).model(plant.trajectory)
    return type(model)(8.0 * model.A, model.B, model.c)
