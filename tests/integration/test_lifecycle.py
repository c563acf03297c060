"""Idle trajectories leave for the disk and come back; whoever watches is told of ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh
from integration.loopback import Loop, Source, config_for, loop, wait_until

from koop_protocol import (
    Ending,
    ErrorReply,
    PredictReply,
    StateReply,
    TrajectoryEnd,
    decode,
    decode_as,
    source_token,
    state_key,
)
from koop_service.serving.admission.strain import Strain


@contextmanager
def ends_of(koop: Loop, name: str) -> Iterator[list[TrajectoryEnd]]:
    """What is put on the trajectory's state key."""
    ends: list[TrajectoryEnd] = []

    def take(sample: zenoh.Sample) -> None:
        ends.append(decode_as(TrajectoryEnd, sample.payload.to_bytes()))

    with koop.session.declare_subscriber(state_key(name), take):
        yield ends


def test_an_idle_trajectory_leaves_and_comes_back(tmp_path: Path, model: Path) -> None:
    with loop(config_for(tmp_path, model, evict_after=0.5)) as koop:
        with ends_of(koop, "cart/0") as ends:
            source = Source(koop.session, "cart/0")
            source.stream(40)
            before = koop.predict("cart/0")
            assert isinstance(before, PredictReply)
            # A slow machine may let it leave before, too: what counts is the last time.
            wait_until(lambda: koop.service.metrics.value("koop_trajectories") == 0, "the end")
            wait_until(lambda: any(end.next_seq == 40 for end in ends), "the end")
        assert {(end.reason, end.epoch) for end in ends} == {(Ending.evicted, source.epoch)}
        (answer,) = koop.ask("koop/state/**")
        assert isinstance(answer, ErrorReply)
        after = koop.predict("cart/0")
        assert isinstance(after, PredictReply)
        assert (after.codes == before.codes).all()
        source.put(source.control(39))
        source.put(source.frame(40))
        state = koop.state("cart/0")
        assert (state.frames, state.updates, state.counters["gaps"]) == (41, 39, 0)
        assert koop.lost() == 0


def test_more_than_have_room_all_stream_on(tmp_path: Path, model: Path) -> None:
    with loop(config_for(tmp_path, model, max_trajectories=2)) as koop:
        sources = [Source(koop.session, f"cart/{i}", seed=i, control_size=0) for i in range(5)]
        for seq in range(8):
            for source in sources:
                source.put(source.frame(seq))
        states = [koop.state(source.name) for source in sources]
        assert [state.frames for state in states] == [8] * 5
        assert koop.lost() == 0
        assert len(koop.ask("koop/state/**")) == 2
        assert all(isinstance(answer, StateReply) for answer in koop.ask("koop/state/**"))


def test_costly_predictions_are_turned_away_at_the_door(
    koop: Loop, cart: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Strain, "active", property(lambda _: True))
        for selector in ("cart/0?return=frames", "cart/0?return=codes,std", "**?horizon=2"):
            refusal = koop.ask_one(f"koop/predict/{selector}")
            assert isinstance(refusal, ErrorReply)
            assert (refusal.code, refusal.details["retry_after"]) == ("overloaded", 1.0)
        assert isinstance(koop.ask_one(f"koop/predict/{cart.name}"), PredictReply)
        assert koop.state(cart.name).frames == 40
    assert isinstance(koop.ask_one("koop/predict/cart/0?return=frames"), PredictReply)
    assert koop.service.metrics.value("koop_shed_total", reason="overloaded") == 3


def test_predictions_have_a_pace(tmp_path: Path, model: Path) -> None:
    with loop(config_for(tmp_path, model, max_query_rate=1)) as koop:
        first, *others = [koop.session.get("koop/predict/cart/0", timeout=30) for _ in range(20)]
        assert [r.ok for r in first] == [None]  # unknown, and told so
        told = [decode(r.err.payload.to_bytes()) for replies in others for r in replies]
        assert {"rate"} <= {refusal.details.get("reason") for refusal in told}


def test_a_new_epoch_and_a_source_that_goes_are_told(koop: Loop) -> None:
    first = Source(koop.session, "cart/0")
    second = Source(koop.session, "cart/0", epoch="00000000000000bb")
    third = Source(koop.session, "cart/0", epoch="00000000000000cc", control_size=2)
    with ends_of(koop, "cart/0") as ends:
        for source, frames in ((first, 3), (second, 2), (third, 1)):
            source.stream(frames)
        assert koop.state("cart/0").epoch == third.epoch
        token = koop.session.liveliness().declare_token(source_token("cart/0"))
        wait_until(lambda: koop.service.metrics.value("koop_catching_up") == 1, "the token")
        token.undeclare()
        wait_until(lambda: len(ends) == 3, "three ends")
    assert [(end.reason, end.epoch, end.next_seq) for end in ends] == [
        (Ending.replaced_epoch, first.epoch, 3),
        (Ending.replaced_epoch, second.epoch, 2),
        (Ending.source_gone, third.epoch, 1),
    ]
