"""The service over real Zenoh: streams in, answers out."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from integration.loopback import WARMUP, Loop, Source, config_for, control, loop, picture

from koop_protocol import ErrorCode, ErrorReply, LqrQuery, LqrReply, PredictQuery, PredictReply
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import load_weights
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.sharding.ownership import EVERY_SHARD
from koop_service.serving.trajectories.sealing import unseal


def test_a_prediction_is_answered_by_selector_alone(koop: Loop, cart: Source) -> None:
    reply = koop.ask_one("koop/predict/cart/0?horizon=7;return=codes,frames,std")
    assert isinstance(reply, PredictReply)
    assert (reply.trajectory, reply.epoch, reply.seq) == ("cart/0", cart.epoch, 39)
    assert reply.codes.shape == reply.std.shape == (7, 8)
    assert (reply.std > 0).all()
    assert reply.frames.shape == (7, 64, 64)
    assert reply.frames.dtype == np.uint8


@pytest.mark.usefixtures("cart")
def test_a_prediction_is_that_of_ridge_regression_on_the_codes(koop: Loop, model: Path) -> None:
    """The naive formula: encode everything, refit everything, roll out."""
    codec = ImageCodec(*load_weights(model))
    Z = codec.encode(np.stack([picture(0, k) for k in range(40)]))
    U = np.stack([control(0, k) for k in range(39)])
    W = np.hstack([Z[:-2], Z[1:-1], U[1:]])
    Y, rho = Z[2:], codec.card.estimator.rho
    gram, theta = W.T @ W + rho * np.eye(17), np.zeros((17, 8))
    for _ in range(2):  # eq. 7, two proximal iterations
        theta = np.linalg.solve(gram, W.T @ Y + rho * theta)
    future = 0.1 * np.arange(10.0)[:, None]
    expected = list(Z[-2:])
    for u in future:
        expected.append(np.hstack([expected[-2], expected[-1], u]) @ theta)
    reply = koop.predict("cart/0", PredictQuery(10, future))
    np.testing.assert_allclose(reply.codes, expected[2:], rtol=1e-6, atol=1e-9)


@pytest.mark.usefixtures("cart")
def test_omitted_controls_hold_the_last_one(koop: Loop) -> None:
    held = koop.predict("cart/0", PredictQuery(6))
    given = koop.predict("cart/0", PredictQuery(6, np.tile(control(0, 38), (6, 1))))
    zero = koop.predict("cart/0", PredictQuery(6, np.zeros((6, 1))))
    np.testing.assert_array_equal(held.codes, given.codes)
    assert not np.array_equal(held.codes, zero.codes)


def test_a_query_is_answered_after_the_frames_put_before_it(koop: Loop, cart: Source) -> None:
    for seq in range(40, 70):
        cart.put(cart.control(seq - 1))
        cart.put(cart.frame(seq))
        assert koop.predict("cart/0").seq == seq


def test_the_prediction_improves_with_what_it_sees(koop: Loop, cart: Source) -> None:
    before = koop.state("cart/0")
    cart.stream(80, start=40)
    after = koop.state("cart/0")
    assert (before.frames, after.frames) == (40, 80)
    assert after.updates == 77  # control 39, between the two calls of `stream`, was never sent
    assert after.counters["missing_controls"] == 1
    assert after.residual_rms > 0


def test_before_the_warm_up_is_over_it_says_how_far_it_is(koop: Loop) -> None:
    source = Source(koop.session, "cart/new")
    source.stream(12)
    reply = koop.predict("cart/new")
    assert isinstance(reply, ErrorReply)
    assert reply.code == ErrorCode.warming_up
    assert reply.message == "warming up, 12 of 36 frames"
    assert reply.details == {"frames": 12, "warmup_frames": 36}
    source.put(source.control(11))
    source.stream(WARMUP - 1, start=12)
    assert koop.predict("cart/new").code == ErrorCode.warming_up
    source.put(source.control(WARMUP - 2))
    source.put(source.frame(WARMUP - 1))
    assert isinstance(koop.predict("cart/new"), PredictReply)


@pytest.mark.usefixtures("cart")
def test_a_wildcard_gets_one_reply_a_trajectory(koop: Loop) -> None:
    for i in range(1, 4):
        Source(koop.session, f"cart/{i}", seed=i).stream(40)
    Source(koop.session, "cart/young").stream(3)
    replies = koop.ask("koop/predict/**?horizon=3")
    answered = [r for r in replies if isinstance(r, PredictReply)]
    (refused,) = [r for r in replies if isinstance(r, ErrorReply)]
    assert sorted(r.trajectory for r in answered) == [f"cart/{i}" for i in range(4)]
    assert all(r.seq == 39 for r in answered)
    assert refused.details["trajectory"] == "cart/young"
    states = koop.ask("koop/state/**")
    assert sorted(s.trajectory for s in states) == [*(f"cart/{i}" for i in range(4)), "cart/young"]
    assert len(koop.ask("koop/*/cart/1")) == 3  # predict, state, and lqr's complaint


@pytest.mark.usefixtures("cart")
def test_lqr_to_a_picture_and_to_its_code(koop: Loop, model: Path) -> None:
    target = picture(0, 100)
    # What the discs do has nothing to do with the controls: such a model is not fit for them.
    options = {"u_min": np.array([-0.5]), "u_max": np.array([0.5]), "force": True}
    shown = koop.lqr("cart/0", LqrQuery(10, target, returns=frozenset({"codes"}), **options))
    assert isinstance(shown, LqrReply), shown
    assert shown.status == "solved"
    assert shown.kkt_residual <= 1e-6
    assert shown.controls.shape == (10, 1)
    assert (np.abs(shown.controls) <= 0.5).all()
    assert shown.codes.shape == (10, 8)
    assert shown.target_error > 0
    code = ImageCodec(*load_weights(model)).encode(target[None])[0]
    told = koop.lqr("cart/0", LqrQuery(10, target_code=code, **options))
    assert told.target_error == 0
    np.testing.assert_array_equal(told.controls, shown.controls)


def test_a_new_epoch_starts_afresh_and_the_old_one_is_refused(koop: Loop, cart: Source) -> None:
    fresh = replace(cart, epoch="00000000000000bb")
    fresh.stream(5)
    state = koop.state("cart/0")
    assert (state.epoch, state.frames, state.updates) == (fresh.epoch, 5, 3)
    cart.put(cart.frame(40))
    state = koop.state("cart/0")
    assert (state.epoch, state.next_seq) == (fresh.epoch, 5)
    assert state.counters["rejected_stale_epoch"] == 1


def test_a_new_epoch_may_have_other_controls(koop: Loop, cart: Source) -> None:
    still = replace(cart, epoch="00000000000000bb", control_size=0)
    still.stream(40)
    assert koop.state("cart/0").control_size == 0
    assert isinstance(koop.predict("cart/0"), PredictReply)
    cart.put(cart.frame(40))
    assert koop.state("cart/0").epoch == still.epoch
    assert koop.rejected("stale_epoch") == 1


def test_floats_are_pictures_too(koop: Loop) -> None:
    source = Source(koop.session, "cart/float")
    for seq in range(40):
        image = picture(0, seq).astype(np.float32) / 255
        source.put(source.frame(seq, image=image))
        source.put(source.control(seq))
    reply = koop.predict("cart/float", PredictQuery(2, returns=frozenset({"frames"})))
    assert reply.frames.dtype == np.float32
    assert (reply.frames >= 0).all()
    assert (reply.frames <= 1).all()


def test_a_stream_leaves_the_same_bits_alone_and_in_company(tmp_path: Path, model: Path) -> None:
    """Also under forgetting and a window, where the order of every sum counts."""
    alone, company = tmp_path / "alone", tmp_path / "company"
    records = []
    for folder, others in ((alone, 0), (company, 7)):
        config = replace(
            config_for(folder, model), estimator=EstimatorChoices(forgetting=0.95, window=30)
        )
        with loop(config) as koop:
            sources = [Source(koop.session, f"cart/{i}", seed=i) for i in range(others + 1)]
            for seq in range(60):
                for source in sources:
                    source.put(source.frame(seq))
                    source.put(source.control(seq))
                if not others:
                    koop.state("cart/0")  # frame by frame: every batch has one
            koop.ask("koop/state/**")
        with closing(LmdbStore(config.state_folder)) as store:
            records.append(unseal(store.load(EVERY_SHARD)["cart/0"]))
    for name, array in records[0]["lane"].items():
        np.testing.assert_array_equal(array, records[1]["lane"][name], err_msg=name)
    assert records[0]["lane"]["updates"] == 58


def test_the_state_survives_a_restart(tmp_path: Path, model: Path) -> None:
    config = config_for(tmp_path, model)
    with loop(config) as koop:
        source = Source(koop.session, "cart/0")
        source.stream(50)
        before = koop.predict("cart/0", PredictQuery(20, returns=frozenset({"codes", "std"})))
    with loop(config) as koop:
        assert koop.service.restored == 1
        after = koop.predict("cart/0", PredictQuery(20, returns=frozenset({"codes", "std"})))
        np.testing.assert_array_equal(before.codes, after.codes)
        np.testing.assert_array_equal(before.std, after.std)
        again = replace(source, session=koop.session)
        again.put(again.frame(49))  # what was folded before is still known
        again.put(again.control(49))
        again.put(again.frame(50))
        state = koop.state("cart/0")
        assert (state.frames, state.counters["duplicates"]) == (51, 1)


def test_a_state_of_other_settings_is_left_out(tmp_path: Path, model: Path) -> None:
    config = config_for(tmp_path, model)
    with loop(config) as koop:
        Source(koop.session, "cart/0").stream(40)
        koop.state("cart/0")
    with loop(replace(config, estimator=EstimatorChoices(rho=0.5))) as koop:
        assert koop.service.restored == 0


def test_what_it_folded_of_a_full_queue_is_stored_when_it_stops(
    tmp_path: Path, model: Path
) -> None:
    config = config_for(tmp_path, model)
    with loop(config) as koop:
        source = Source(koop.session, "cart/0")
        for seq in range(3000):
            source.put(source.frame(seq, control_size=0))
    folded = koop.service.metrics.value("koop_frames_total")
    with closing(LmdbStore(config.state_folder)) as store:
        counters = unseal(store.load(EVERY_SHARD)["cart/0"])["stream"]["counters"]
    assert (counters["frames"], counters["gaps"]) == (folded, 0)
    assert folded > 0
