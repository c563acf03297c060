"""All names that nobody knows yet: they hold up no known one, and are not kept out either."""

from __future__ import annotations

from collections import Counter
from itertools import count

from koop_service.serving.admission.arrivals import lane_of

from .bench import BATCH, NOW, Bench


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


def test_what_waits_of_one_that_has_become_known_is_told_of_at_once() -> None:
    """`Bench.put` checks it: who waits for the strangers' turn would come later."""
    bench = Bench()
    bench.known = {"a"}
    for name in ("a", "b", "b"):
        bench.put(name)
    assert bench.take() == ["a", "b"]
    assert bench.turns.ready_at(bench.now) > bench.now
    bench.known.add("b")
    bench.put("b")
    assert bench.take() == ["b", "b"]


def test_strangers_do_not_go_before_an_answer() -> None:
    """Nor are they kept out by who always asks."""
    bench = Bench()
    strangers(bench)
    bench.put("a")
    assert bench.take() == ["a", "nobody/0"]
    bench.now += 0.01
    assert bench.turns.ready_at(bench.now) <= bench.now, "nobody asks"
    assert bench.turns.ready_at(bench.now, asked=True) > bench.now
    assert bench.turns.take(BATCH, bench.now, asked=True) == []
    bench.now = bench.turns.ready_at(bench.now, asked=True)
    assert bench.now < NOW + 0.03
    assert len(bench.turns.take(BATCH, bench.now, asked=True)) == 4


def test_a_frame_that_has_waited_takes_no_stranger_along_that_has_not() -> None:
    bench = Bench()
    strangers(bench)
    got = []
    for _ in range(20):
        bench.put("a")
        bench.now += 0.001
        got.append("".join(name[0] for name in bench.take()))
        bench.now += 0.01
    assert got[:2] == ["a", "a"]
    assert 6 <= got.count("an") <= 10, "one in 20 ms"
    assert set(got) == {"a", "an"}


def test_many_frames_take_strangers_along_though_they_have_waited() -> None:
    bench = Bench()
    strangers(bench)
    bench.known |= {"b", "c", "d"}
    for name in "abcd":
        bench.put(name)
    bench.now += 0.01
    assert [name[0] for name in bench.take()] == ["a", "b", "c", "d", "n"]
