"""Live messages that wait: in order, the newest of each trajectory, and never too many."""

from __future__ import annotations

import hypothesis.strategies as st
from hypothesis import given

from koop_service.serving.admission.arrivals import Arrival
from koop_service.serving.replay.holding import Holding

LIMIT, EACH = 1000, 64


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 300) | st.just(5000)), max_size=200)
)
def test_it_is_bounded_and_keeps_the_newest_in_order(messages: list[tuple[str, int]]) -> None:
    holding = Holding(LIMIT)
    put: dict[str, list[Arrival]] = {name: [] for name in "abc"}
    let_go = 0
    for ticket, (name, size) in enumerate(messages):
        arrival = Arrival(name, bytes(size), ticket)
        put[name].append(arrival)
        let_go += holding.add(name, arrival)
        assert holding.bytes <= LIMIT
    held = {name: holding.release(name) for name in "abc"}
    assert holding.bytes == 0
    assert sum(map(len, held.values())) + let_go == len(messages)
    for name, arrivals in held.items():
        assert len(arrivals) <= EACH
        assert arrivals == put[name][len(put[name]) - len(arrivals) :]
        assert name not in holding


def test_a_few_small_ones_are_all_held() -> None:
    holding = Holding(LIMIT)
    arrivals = [Arrival("a", b"x", ticket) for ticket in range(EACH)]
    assert [holding.add("a", arrival) for arrival in arrivals] == [0] * EACH
    assert "a" in holding
    assert holding.add("a", Arrival("a", b"x", EACH)) == 1
    assert [arrival.ticket for arrival in holding.release("a")] == list(range(1, EACH + 1))
    assert holding.release("a") == []
