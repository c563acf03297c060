"""Sources with a log, one event after the other: what is asked, what waits, what is given up."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from integration.loopback import RENDERER, write_model
from integration.undisturbed import arrival_of

from koop_protocol import (
    Frame,
    Limits,
    ProtocolError,
    ReplayQuery,
    ReplayReply,
    encode,
)
from koop_service.serving.admission.news import LogAnswer, LogPresence

from .recovery_desk import EPOCH, NAME, OTHER, Desk, frames


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model"))


@pytest.fixture
def desk(model: Path) -> Desk:
    return Desk(model)


def test_a_source_without_a_log_is_asked_nothing(desk: Desk) -> None:
    desk.put(frames(0, 1, 5, logged=False))
    assert desk.next_seq == 2
    assert (desk.asked, desk.recovery.behind) == ([], 0)
    assert not desk.recovery.is_logged(NAME)


def test_a_token_is_enough_to_ask_for_what_the_fold_needs(desk: Desk) -> None:
    desk.appear()
    assert desk.asked[-1].query == ReplayQuery(max_bytes=1 << 18, max_message_bytes=4 << 20)
    desk.answer(frames(0, 1, 2))
    assert (desk.next_seq, desk.recovery.behind) == (3, 0)
    desk.appear()
    assert desk.asked[-1].query == ReplayQuery(EPOCH, 2, None, 1 << 18, 4 << 20)


def test_where_many_are_behind_each_log_is_asked_for_little(model: Path) -> None:
    """So that the answers to many at once, each behind all that a link holds, fit into memory."""
    desk = Desk(model, most=1000)
    desk.turn(*(LogPresence(f"cart/{number}", True) for number in range(1000)))
    assert [question.query.max_bytes for question in desk.asked] == [1 << 15] * 1000


def test_an_answer_has_room_for_the_largest_message_that_waits(model: Path) -> None:
    desk = Desk(model, most=1000)
    desk.turn(*(LogPresence(f"other/{number}", True) for number in range(999)))
    image = np.zeros((256, 256), np.uint8)
    desk.put([Frame(NAME, EPOCH, 0, 0, image, RENDERER, True)])
    assert desk.asked[-1].trajectory == NAME
    assert 1 << 16 < desk.asked[-1].query.max_bytes < 1 << 17


def test_live_frames_wait_until_the_log_is_read_and_then_follow(desk: Desk) -> None:
    desk.put(frames(3, 4))
    assert desk.registry.find(NAME) is None
    assert desk.recovery.is_behind(NAME)
    desk.answer(frames(0, 1), end=False, position=5)
    assert desk.asked[-1].query.after == 5
    assert desk.next_seq == 2
    desk.answer(frames(2, 3), position=7)
    assert (desk.next_seq, desk.recovery.behind) == (5, 0)
    desk.put(frames(5))
    assert (desk.next_seq, len(desk.asked)) == (6, 2)
    assert desk.trajectory.stream.counters["duplicates"] == 0


def test_a_gap_is_asked_for_at_once_and_nothing_is_given_up(desk: Desk) -> None:
    desk.follow(5)
    desk.put(frames(*range(30, 60)))
    assert (desk.next_seq, len(desk.asked)) == (5, 2)
    desk.answer(frames(*range(4, 30)))
    assert desk.next_seq == 60
    assert desk.trajectory.stream.counters["gaps"] == 0


def test_a_gap_that_the_log_cannot_fill_is_counted(
    desk: Desk, caplog: pytest.LogCaptureFixture
) -> None:
    desk.follow(5)
    with caplog.at_level(logging.WARNING):
        desk.put(frames(20))
        desk.answer(frames(18, 19, 20), dropped=13)
        desk.put(frames(*range(21, 30)))
    assert desk.next_seq == 30
    counters = desk.trajectory.stream.counters
    assert (counters["gaps"], counters["missing_frames"]) == (1, 13)
    assert "was full: 13 messages of it are lost" in caplog.text
    assert len(desk.asked) == 2


def test_controls_that_were_never_put_are_not_asked_for_again_and_again(desk: Desk) -> None:
    shown = frames(*range(60), controls=True)[::2]
    desk.appear()
    desk.answer(shown[:5])
    for index, frame in enumerate(shown[5:], 5):
        desk.put([frame])
        if desk.recovery.is_behind(NAME):
            desk.answer(shown[desk.asked[-1].query.seq : index + 1])
    assert desk.next_seq == 60
    assert len(desk.asked) <= 2 + 60 // 8


def test_what_is_left_of_a_former_run_goes_before_the_new_one(desk: Desk) -> None:
    desk.follow(5)
    desk.put(frames(0, epoch=OTHER))
    assert desk.trajectory.epoch == EPOCH
    desk.answer([*frames(4, 5, 6), *frames(0, epoch=OTHER)])
    assert (desk.trajectory.epoch, desk.next_seq) == (OTHER, 1)
    assert desk.trajectory.stream.counters["frames"] == 8
    desk.put(frames(1, epoch=OTHER))
    assert (desk.next_seq, len(desk.asked)) == (2, 2)


def test_a_log_that_never_answers_is_done_without(
    desk: Desk, caplog: pytest.LogCaptureFixture
) -> None:
    desk.follow(3)
    with caplog.at_level(logging.WARNING):
        for second in range(40):
            desk.now = float(second)
            desk.put(frames(10 + second))
            desk.reply(None)
    assert "has not answered for 30 s" in caplog.text
    assert desk.next_seq == 50
    assert desk.trajectory.stream.counters["missing_frames"] == 7
    assert not desk.recovery.is_logged(NAME)
    assert len(desk.asked) < 40, "it is asked less and less often"
    # Its source starts anew.
    desk.appear()
    desk.answer(frames(49, 50, 51))
    assert (desk.next_seq, desk.recovery.is_logged(NAME)) == (52, True)


def test_a_log_whose_answers_are_late_is_waited_for(desk: Desk) -> None:
    """The source is held back, and its answers with it."""
    desk.follow(3)
    for minute in range(10):
        desk.now = 60.0 * minute
        desk.put(frames(10 + minute))
        desk.reply(None, late=True)
    assert (desk.next_seq, desk.recovery.is_behind(NAME)) == (3, True)
    desk.now += 3.0
    desk.turn()
    desk.answer(frames(*range(2, 20)))
    assert desk.next_seq == 20
    assert desk.trajectory.stream.counters["gaps"] == 0


def test_a_source_that_is_gone_is_waited_for_and_loses_nothing(desk: Desk) -> None:
    desk.follow(3)
    desk.put(frames(10, 11))
    desk.appear(False)
    for second in range(1, 60):
        desk.now = float(second)
        desk.reply(None)
    assert (desk.recovery.behind, desk.next_seq) == (0, 3)
    asked = len(desk.asked)
    desk.appear()
    assert len(desk.asked) == asked + 1
    desk.answer(frames(*range(2, 12)))
    assert desk.next_seq == 12
    assert desk.trajectory.stream.counters["gaps"] == 0


def test_answers_of_no_use_are_asked_for_again(desk: Desk) -> None:
    desk.appear()
    limits = Limits().for_replays()
    for payload in (
        None,
        b"nonsense",
        encode(frames(0)[0]),
        encode(ReplayReply("cart/1", (), 3, True), limits),
        encode(ReplayReply(NAME, (), 0, False), limits),
    ):
        asked = len(desk.asked)
        desk.reply(payload)
        assert len(desk.asked) == asked, "at once, it would be asked in a tight loop"
        assert 0 < desk.recovery.pause() <= 2
        desk.now += 2.5
        desk.turn()
        assert len(desk.asked) == asked + 1
    desk.answer(frames(0, 1))
    assert desk.next_seq == 2


def test_an_answer_to_a_former_question_changes_nothing(desk: Desk) -> None:
    desk.appear()
    former = desk.asked[-1]
    desk.appear()
    late = ReplayReply(NAME, tuple(map(encode, frames(0, 1))), 5, True, EPOCH, 0, EPOCH, 1)
    desk.reply(encode(late, Limits().for_replays()), former)
    assert desk.recovery.is_behind(NAME)
    desk.answer(frames(0, 1, 2))
    assert (desk.next_seq, desk.recovery.behind) == (3, 0)


def test_a_frame_that_the_log_could_not_take_is_folded_all_the_same(desk: Desk) -> None:
    desk.follow(5)
    desk.put(frames(5, logged=False))
    assert (desk.next_seq, len(desk.asked)) == (6, 1)
    # Frame 6 is lost, and frame 7 is not in the log either: nobody can be asked for it.
    desk.put(frames(7, logged=False))
    assert len(desk.asked) == 1
    desk.put(frames(8))
    desk.answer(frames(8))
    desk.put(frames(*range(9, 18)))
    assert desk.next_seq == 18
    assert desk.trajectory.stream.counters["missing_frames"] == 1


def test_a_source_without_a_log_may_take_a_name_over(desk: Desk) -> None:
    desk.follow(5)
    desk.appear(False)
    desk.put(frames(0, 1, 2, epoch=OTHER, logged=False))
    assert (desk.trajectory.epoch, desk.next_seq, len(desk.asked)) == (OTHER, 3, 1)


def test_messages_that_are_refused_are_not_asked_for_again_and_again(desk: Desk) -> None:
    """Frames of another renderer: the log was read into their epoch, and nothing came of it."""
    desk.appear()
    wrong = frames(*range(20), renderer="another")
    desk.answer(wrong[:10])
    desk.put(wrong[10:])
    assert desk.registry.find(NAME) is None
    assert (len(desk.asked), desk.recovery.behind) == (1, 0)
    assert desk.metrics.value("koop_rejected_total", reason="renderer_mismatch") == 20


def test_it_remembers_a_bounded_number_of_sources(
    model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    desk = Desk(model, most=2)
    with caplog.at_level(logging.WARNING):
        for number in range(4):
            desk.turn(LogPresence(f"cart/{number}", True))
    assert "there are too many" in caplog.text
    assert [desk.recovery.is_logged(f"cart/{n}") for n in range(4)] == [True, True, False, False]
    desk.turn(LogPresence("cart/0", False))
    desk.reply(None, desk.asked[0])
    desk.now += 100.0
    desk.turn()
    desk.turn(LogPresence("cart/3", True))
    assert desk.recovery.is_logged("cart/3")
    assert not desk.recovery.is_logged("cart/0")


def test_answers_that_overlap_are_counted_once(desk: Desk) -> None:
    """The token came anew while an answer waited for its turn."""
    desk.appear()
    first = desk.asked[-1]
    told = ReplayReply(NAME, tuple(map(encode, frames(0, 1, 2))), 9, True, EPOCH, 0, EPOCH, 2)
    payload = encode(told, Limits().for_replays())
    desk.recovery.attend([LogAnswer(first, payload), LogPresence(NAME, True)])
    desk.recovery.attend([LogAnswer(desk.asked[-1], payload)])
    replays = desk.recovery.take(64)
    desk.measurements.process([arrival for replay in replays for arrival in replay.arrivals])
    for replay in replays:
        desk.recovery.finish(replay)
    assert (len(replays), desk.next_seq, desk.recovery.behind) == (2, 3, 0)
    assert desk.trajectory.counters()["duplicates"] == 0


def test_controls_that_come_with_a_frame_that_is_held_are_held_too(desk: Desk) -> None:
    """Far more of them than the fold keeps ahead of the frames."""
    desk.follow(3, controls=True)
    late = frames(*range(4, 200), controls=True)
    desk.measurements.process([arrival_of(message) for message in late])
    desk.turn()
    sent = frames(*range(3, 35), controls=True)
    while desk.recovery.behind:
        desk.answer(sent, end=len(sent) < 64, position=desk.asked[-1].number + 9)
        following = range(desk.next_seq, min(desk.next_seq + 32, 200))
        sent = frames(*following, controls=True)
    counters = desk.trajectory.counters()
    assert (counters["frames"], counters["controls"], counters["gaps"]) == (200, 200, 0)


def test_a_first_control_that_got_lost_is_asked_for(desk: Desk) -> None:
    """No transition waits for it, but it counts."""
    desk.follow(1, controls=False)
    first, lost, second = frames(0, 1, controls=True, epoch=OTHER)[:3]
    desk.put([first])
    desk.answer([first])
    desk.put([second])
    desk.answer([first, lost, second])
    counters = desk.trajectory.counters()
    assert (desk.next_seq, counters["controls"]) == (2, 1)


def test_a_source_that_comes_back_without_its_log_is_taken_as_any_other(desk: Desk) -> None:
    desk.follow(3, controls=True)
    desk.appear(here=False)
    asked = len(desk.asked)
    plain = frames(*range(12), controls=True, epoch=OTHER, logged=False)
    desk.measurements.process([arrival_of(message) for message in plain])
    desk.turn()
    assert (desk.next_seq, desk.trajectory.counters()["controls"]) == (12, 15)
    assert (len(desk.asked), desk.recovery.is_logged(NAME)) == (asked, False)
    desk.appear()
    assert desk.recovery.is_behind(NAME)


def test_what_could_not_be_folded_is_asked_for_again(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as while the disk, where the trajectory is, cannot be read."""

    def fail(_: str) -> None:
        raise ProtocolError("internal", "the disk cannot be read")

    desk.follow(3)
    desk.put(frames(5))
    with monkeypatch.context() as broken:
        broken.setattr(desk.registry, "find", fail)
        desk.answer(frames(2, 3, 4, 5))
    assert desk.recovery.is_behind(NAME)
    desk.now += 1.0
    desk.turn()
    desk.answer(frames(2, 3, 4, 5))
    assert (desk.next_seq, desk.trajectory.counters()["gaps"], desk.recovery.behind) == (6, 0, 0)
