"""Predictions a second on one key."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from koop_service.serving.admission.pace import Pace


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@given(
    st.integers(1, 5),
    st.lists(st.tuples(st.sampled_from("ab"), st.floats(0, 0.5)), max_size=60),
)
def test_no_key_gets_more_than_its_rate_and_nobody_pays_for_another(
    rate: int, asked: list[tuple[str, float]]
) -> None:
    clock = Clock()
    both, alone = Pace(rate, clock), {key: Pace(rate, clock) for key in "ab"}
    admitted: dict[str, list[float]] = {"a": [], "b": []}
    for key, wait in asked:
        clock.now += wait
        hint = both.wait(key)
        if hint == 0.0:
            admitted[key].append(clock.now)
        assert 0.0 <= hint <= 1.0
        # The windows of a Pace of its own begin elsewhere, but it refuses no first one.
        if alone[key].wait(key) == 0.0 and len(admitted[key]) == 0:
            raise AssertionError(f"{key} was refused for what another asked")
    for times in admitted.values():
        for start in times:
            assert sum(start <= t < start + 1 for t in times) <= 2 * rate


def test_the_hint_is_when_it_goes_on() -> None:
    clock = Clock()
    pace = Pace(2, clock)
    clock.now = 0.25
    assert [pace.wait("a") for _ in range(3)] == [0.0, 0.0, 0.75]
    clock.now = 1.0
    assert pace.wait("a") == 0.0


def test_no_rate_is_no_limit() -> None:
    assert not any(Pace(0).wait("a") for _ in range(10_000))
