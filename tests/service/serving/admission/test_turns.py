"""Whose turn it is: order within a trajectory, fairness between them, and nothing lost."""

from __future__ import annotations

from collections import Counter
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.serving.admission.arrivals import lane_of

from .bench import BATCH, NOW, Bench

SAVED = 5
"""Frames that one who has more waiting may have at once, ..."""
RIDING = 3
"""... and with others'."""


def test_frames_and_controls_of_a_trajectory_share_a_lane() -> None:
    assert lane_of("koop/frame/1b/line/3") == lane_of("koop/control/1b/line/3") == "line/3"
    assert lane_of("nonsense") == "nonsense"


steps = st.one_of(
    st.tuples(st.just("put"), st.sampled_from("abcd")),
    st.tuples(st.just("take"), st.integers(1, 5)),
    st.tuples(st.just("short cut"), st.sampled_from("abcd")),
    st.tuples(st.just("meet"), st.sampled_from("abcd")),
    st.tuples(st.just("pass"), st.sampled_from([0.0005, 0.003, 0.5, 2.0])),
)


@settings(max_examples=300, deadline=None)
@given(st.lists(steps, max_size=80), st.integers(0, 10**6))
def test_every_trajectory_keeps_its_order_and_nothing_is_lost(script: list, before: int) -> None:
    """Whatever is taken when, also out of turn, and also where a stranger becomes known."""
    bench, sent, got = Bench(), [], []
    bench.known = set()
    for action, value in script:
        if action == "put":
            data = bytes([len(sent)])
            assert bench.put(value, data)
            sent.append((value, data))
        elif action == "meet":
            bench.known.add(value)
        elif action == "pass":
            bench.now += value
        else:
            turns, now = bench.turns, bench.now
            due = turns.ready_at(now) <= now
            taken = (
                turns.take(value, now) if action == "take" else turns.take_of(value, before, 3, now)
            )
            assert action == "short cut" or bool(taken) == due
            got += [(lane_of(arrival.key), arrival.data) for arrival in taken]
        left = sent[:]
        for item in got:
            left.remove(item)
        assert len(bench.turns) == len(left)
        oldest = min((sent.index(item) for item in left), default=float("inf"))
        assert bench.turns.oldest() == oldest
    while len(bench.turns):
        bench.now = max(bench.now, bench.turns.ready_at(bench.now))
        got += [(lane_of(a.key), a.data) for a in bench.turns.take(3, bench.now)]
    for name in "abcd":
        assert [item for item in got if item[0] == name] == [i for i in sent if i[0] == name]
    assert len(got) == len(sent)
    assert bench.turns.ready_at(bench.now) == float("inf")


def test_who_is_alone_gets_the_whole_batch() -> None:
    bench = Bench()
    for _ in range(200):
        assert bench.put("a")
    assert bench.take() == ["a"] * BATCH
    assert bench.take() == ["a"] * BATCH


def test_a_backlog_makes_nobody_wait() -> None:
    bench = Bench()
    while bench.put("flood"):
        continue
    bench.put("a")
    bench.put("a", kind="control")
    batch = bench.take()
    assert batch.count("a") == 2
    assert batch.count("flood") == RIDING, "more of it would make the other wait longer"


def test_a_flood_keeps_a_pace_while_others_are_active() -> None:
    bench, got = Bench(), Counter()
    for _ in range(5000):  # five seconds
        bench.now += 0.001
        while bench.put("flood"):
            continue
        if bench.turns._shares.get("a") is None:
            bench.put("a")
        got.update(bench.take())
    assert 450 < got["flood"] < 520
    assert got["a"] > 450


def flooded() -> Bench:
    """A source that has put as much as it may, beside another; both had their first turn."""
    bench = Bench()
    bench.put("a")
    while bench.put("flood"):
        continue
    bench.take()
    return bench


def test_a_backlog_goes_with_others_frames() -> None:
    """Then nobody finds a flood's frame in work when his own comes."""
    bench, got = flooded(), Counter()
    for _ in range(100):
        bench.now += 0.01
        bench.put("flood")
        assert bench.take() == []
        bench.put("a")
        batch = bench.take()
        assert batch.count("flood") <= 1
        got.update(batch)
    assert got["a"] == 100
    assert got["flood"] >= 97, "its pace"


def test_several_go_at_once_only_where_others_come_seldom() -> None:
    bench, got = flooded(), Counter()
    for _ in range(50):
        bench.now += 0.02
        bench.put("flood")
        bench.put("flood")
        assert bench.take() == []
        bench.put("a")
        batch = bench.take()
        assert batch.count("flood") <= 3
        got.update(batch)
    assert got["flood"] >= 95


def test_a_backlog_lets_a_frame_go_alone_that_is_late() -> None:
    bench, timely, late = flooded(), Counter(), Counter()
    for _ in range(100):
        bench.now += 0.006
        bench.put("flood")
        bench.put("a")
        timely.update(bench.take())
        bench.now += 0.003
        bench.put("b")
        bench.now += 0.001
        late.update(bench.take())
    assert timely["a"] == late["b"] == 100
    assert late["flood"] <= 3, "what it had saved"
    assert timely["flood"] >= 97, "its pace"


def test_a_backlog_keeps_its_pace_where_all_frames_are_late() -> None:
    bench, got = flooded(), Counter()
    for _ in range(100):
        bench.now += 0.009
        bench.put("flood")
        bench.put("a")
        bench.now += 0.001
        got.update(bench.take())
    assert got["flood"] >= 95


def test_a_backlog_waits_for_others_frames_only_until_some_is_saved() -> None:
    bench, got = flooded(), []
    for _ in range(15):
        bench.now = bench.turns.ready_at(bench.now)
        got.append(bench.take())
    assert got == [["flood"] * SAVED] * 15
    assert bench.now < NOW + 0.8, "less than its pace"


def test_one_frame_alone_waits_for_nobody() -> None:
    """A camera at 90 Hz, beside others that put nothing at the time."""
    bench = Bench()
    bench.put("other")
    bench.take()
    for _ in range(80):
        bench.now += 0.0111
        bench.put("a")
        assert bench.take() == ["a"]


def test_controls_cost_little_of_the_pace() -> None:
    """Nearly a hundred frames a second, each with its control, wait for nothing beside others."""
    bench = Bench()
    for _ in range(100):
        bench.now += 0.0111
        bench.put("other")
        bench.put("a")
        bench.put("a", kind="control")
        assert sorted(bench.take()) == ["a", "a", "other"]


def test_who_has_gone_leaves_the_others_alone() -> None:
    bench = Bench()
    bench.put("a")
    for _ in range(100):
        bench.put("b")
    assert Counter(bench.take()) == {"a": 1, "b": RIDING}
    assert bench.take() == []
    bench.now += 1.5
    assert bench.take() == ["b"] * BATCH


def test_many_busy_ones_fill_the_batch() -> None:
    bench = Bench()
    names = [str(i) for i in range(100)]
    for _ in range(2):
        for name in names:
            bench.put(name)
    first, second = bench.take(), bench.take()
    assert set(first).union(second[: 100 - BATCH]) == set(names), "whose turn it was, was forgotten"
    assert len(first) == len(second) == BATCH


@pytest.mark.parametrize("data", [b"x", bytes(1 << 20)])
def test_one_source_cannot_fill_the_queue(data: bytes) -> None:
    bench = Bench()
    while bench.put("flood", data):
        continue
    assert 8 <= len(bench.turns) <= 256
    assert bench.put("a", data)


@pytest.mark.parametrize("cut", [0, 1])
def test_a_short_cut_counts_against_the_pace(cut: int) -> None:
    bench = Bench()
    bench.put("a")
    for _ in range(20):
        bench.put("b")
    assert Counter(bench.take()) == Counter(a=1, b=RIDING)
    bench.put("a")
    for _ in range(cut):
        assert len(bench.turns.take_of("b", 10**9, BATCH, bench.now)) == 2
    assert Counter(bench.take()) == Counter(a=1, b=1 - cut)


def test_a_short_cut_takes_the_whole_backlog_of_who_has_had_little() -> None:
    """Too much comes in all: a question about one of many waits for one turn, not for ten."""
    bench = Bench()
    for _ in range(10):
        for name in "ab":
            bench.put(name)
        bench.now += 0.03
    assert len(bench.turns.take_of("a", 10**9, BATCH, bench.now)) == 10
    assert len(bench.turns.take_of("b", 10**9, BATCH, bench.now)) == 10
    bench.now += 0.03
    for _ in range(10):
        bench.put("a")
    assert len(bench.turns.take_of("a", 10**9, BATCH, bench.now)) == 2, "it has had its pace"


def test_a_short_cut_takes_few_of_unknown_names() -> None:
    bench = Bench()
    bench.known = {"a"}
    bench.put("a")
    for _ in range(10):
        bench.put("b")
    bench.now += 0.5
    assert len(bench.turns.take_of("b", 10**9, BATCH, bench.now)) == 2


def test_at_the_end_nobody_keeps_a_pace() -> None:
    bench = Bench()
    bench.put("a")
    for _ in range(40):
        bench.put("b")
    bench.turns.hurry()
    assert Counter(bench.take()) == {"a": 1, "b": 40}


def test_the_room_is_bounded_for_all_together() -> None:
    bench = Bench(messages=64)
    names = (str(i) for i in count())
    while bench.put(next(names)):
        continue
    assert len(bench.turns) == 64


def test_one_message_larger_than_the_room_still_passes() -> None:
    bench = Bench(size=20)
    assert bench.put("a", bytes(50))
    assert not bench.put("b", b"x")
