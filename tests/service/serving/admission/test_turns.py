"""Whose turn it is: order within a trajectory, fairness between them, and nothing lost."""

from __future__ import annotations

from collections import Counter
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koop_service.serving.admission.turns import Arrival, Turns, lane_of

NOW = 1000.0  # s
BATCH = 64
SAVED = 5
"""Frames that one who has more waiting may have at once, ..."""
RIDING = 3
"""... and with others'."""


def key(name: str) -> str:
    return f"koop/frame/00/{name}"


class Bench:
    """Turns with a clock and tickets of its own."""

    def __init__(self, messages: int = 2048, size: int = 1 << 26) -> None:
        self.known: set[str] | None = None  # None: all of them
        self.turns = Turns(messages, size, lambda n: self.known is None or n in self.known)
        self.now = NOW
        self.tickets = count()

    def put(self, name: str, data: bytes = b"x", kind: str = "frame") -> bool:
        """False, and nothing happens, where it would have to wait outside."""
        if self.turns.is_full(name, len(data)):
            return False
        key = f"koop/{kind}/00/{name}"
        self.turns.add(Arrival(key, data, next(self.tickets), at=self.now))
        return True

    def take(self, most: int = BATCH) -> list[str]:
        return [lane_of(arrival.key) for arrival in self.turns.take(most, self.now)]


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


def strangers(bench: Bench) -> None:
    """All that fit of one each of ever new names, beside one that is known."""
    bench.known = {"a"}
    names = (f"nobody/{i}" for i in count())
    while bench.put(next(names)):
        continue


def test_strangers_have_one_share_together() -> None:
    bench = Bench()
    strangers(bench)
    assert len(bench.turns) == 256
    assert bench.put("a")


def test_strangers_come_a_few_at_a_time() -> None:
    bench = Bench()
    strangers(bench)
    for _ in range(20):
        bench.put("a")
        assert [name[0] for name in bench.take()] == ["a", "n"], "one goes with another's frame"
        bench.now += 0.001
        few = bench.take()
        assert 1 <= len(few) <= 4
        assert bench.take() == []
        bench.now += 0.014
    left = len(bench.turns)
    for _ in range(10):
        bench.now = bench.turns.ready_at(bench.now)
        bench.take()
    assert left - len(bench.turns) == 40, "time that is left is theirs"


def test_strangers_are_not_kept_out_by_those_who_are_always_there() -> None:
    """Two thousand a second where these leave some time, else one with each of their frames."""
    bench, got = Bench(messages=1 << 16), Counter()
    strangers(bench)
    for _ in range(100):
        bench.now += 0.03
        while bench.put("a"):
            continue
        while taken := bench.take():
            got.update(name[0] for name in taken)
    assert got["n"] > 1500
    assert got["a"] >= 280


def test_strangers_go_with_others_in_proportion_to_these() -> None:
    """So that many who begin need not wait for long beside many who are there."""
    bench = Bench()
    strangers(bench)
    names = [f"a{i}" for i in range(40)]
    bench.known = set(names)
    for name in names:
        bench.put(name)
    batch = Counter(name[0] for name in bench.take())
    assert batch == {"a": 40, "n": 10}


def begin(bench: Bench, step: float) -> tuple[Counter[str], float]:
    """New trajectories beside "a", which puts a frame every `step` [s], for ten seconds.

    A frame alone takes 2 ms, 3 ms with another. Returns how often which were taken together, and
    the time that a batch took for the new ones' sake [s].
    """
    strangers(bench)
    together: Counter[str] = Counter()
    spent, due = 0.0, bench.now
    while bench.now < NOW + 10.0:
        if bench.now >= due:
            bench.put("a")
            due += step
        arrivals = bench.turns.take(BATCH, bench.now)
        if not arrivals:
            bench.now = min(due, bench.turns.ready_at(bench.now))
            continue
        names = [lane_of(arrival.key) for arrival in arrivals]
        bench.known.update(names)
        seconds = 0.001 + 0.001 * len(names)
        together["".join(name[0] for name in names)] += 1
        spent += seconds - 0.002 * ("a" in names)
        bench.now += seconds
        bench.turns.worked(arrivals, seconds, bench.now)
        while bench.put(f"nobody/{next(bench.tickets)}"):
            continue
    return together, spent / 10.0


def test_new_trajectories_begin_along_with_others_frames() -> None:
    """Where these come, nobody finds one in work that would not have begun without it."""
    together, spent = begin(Bench(), step=0.01)
    first = 1
    assert together["n" * 4] + together["n"] <= first, "before it was known what they cost"
    assert together["an"] > 400
    assert spent < 0.1


def test_new_trajectories_begin_alone_where_others_seldom_come() -> None:
    together, spent = begin(Bench(), step=0.5)
    assert together["n"] > 200
    assert together["an"] > 15
    assert spent < 0.12


def test_refused_strangers_that_go_with_others_frames_pay_nothing_for_them() -> None:
    bench, got = Bench(), Counter()
    strangers(bench)
    for _ in range(1000):
        bench.put("a")
        arrivals = bench.turns.take(BATCH, bench.now)
        got.update(lane_of(arrival.key)[0] for arrival in arrivals)
        bench.now += 0.002
        bench.turns.worked(arrivals, 0.002, bench.now)
        while bench.put(f"nobody/{next(bench.tickets)}"):
            continue
    assert got["n"] > 190, "one with each frame of a, which keeps its own pace"


def test_a_process_that_stood_still_keeps_no_stranger_out() -> None:
    bench = Bench()
    strangers(bench)
    bench.put("a")
    arrivals = bench.turns.take(BATCH, bench.now)
    bench.known |= {lane_of(arrival.key) for arrival in arrivals}
    bench.now += 60.0
    bench.put("a")
    bench.put("nobody/else")
    bench.turns.worked(arrivals, 60.0, bench.now)
    assert bench.take() == ["a"]
    got: list[str] = []
    for _ in range(4):
        bench.now += 0.1
        bench.put("a")
        got += bench.take()
    assert got.count("a") == 4
    assert len(got) > 4


def test_many_that_begin_at_once_do_not_stay_strangers() -> None:
    """50 cameras at 20 Hz beside one that is known; a service that keeps up sees no queue."""
    bench = Bench()
    bench.known = {"old"}
    for step in range(3000):
        bench.now += 0.001
        for name in [f"new/{step % 50}"] + ["old"] * (step % 50 == 0):
            assert bench.put(name) or step < 1000
        bench.known.update(bench.take())
        assert len(bench.turns) == 0 or step < 1000


def test_what_waits_of_a_stranger_that_becomes_known_leaves_room_for_the_others() -> None:
    bench = Bench()
    bench.known = set()
    while bench.put("a", b"1"):
        continue
    assert not bench.put("b")
    bench.known.add("a")
    assert not bench.put("a")
    assert bench.put("b")
    assert len(bench.turns) == 257


@pytest.mark.parametrize("cut", [0, 1])
def test_a_short_cut_counts_against_the_pace(cut: int) -> None:
    bench = Bench()
    bench.put("a")
    for _ in range(20):
        bench.put("b")
    for _ in range(cut):
        assert len(bench.turns.take_of("b", 10**9, BATCH, bench.now)) == 2
    assert Counter(bench.take()) == Counter(a=1, b=max(1, RIDING - 2 * cut))


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
