"""The supervisor's decisions, played through without processes or a clock."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from koop_service.serving.placement.roster import Roster


class Play:
    """A roster whose members start, load and die as they are told."""

    def __init__(self, seats: int, spares: int) -> None:
        self.roster: Roster[int] = Roster(seats, spares)
        self.now = 0.0
        self.loading: list[int] = []
        self.idle: list[int] = []
        self.seated: dict[int, int] = {}
        self.count = 0

    def start(self) -> None:
        for _ in range(self.roster.to_start(self.now)):
            self.roster.started(self.count)
            self.loading.append(self.count)
            self.count += 1

    def load(self) -> None:
        if self.loading:
            self.idle.append(self.loading.pop(0))
            self.roster.prepared(self.idle[-1])
        self.seat()

    def seat(self) -> None:
        for member, number in self.roster.seat():
            self.idle.remove(member)
            assert number not in self.seated
            self.seated[number] = member

    def kill(self, choice: int) -> None:
        alive = [*self.loading, *self.idle, *self.seated.values()]
        if not alive:
            return
        member = alive[choice % len(alive)]
        left = self.roster.died(member, self.now)
        taken = {m: number for number, m in self.seated.items()}
        assert left == taken.get(member)
        self.loading = [m for m in self.loading if m != member]
        self.idle = [m for m in self.idle if m != member]
        self.seated = {number: m for number, m in self.seated.items() if m != member}
        self.seat()

    def settle(self) -> None:
        """Long enough for every wait to be over, everything loads."""
        for _ in range(2 * self.count + 10):
            self.now = max(self.now, self.roster.wake() or self.now)
            self.start()
            self.load()


@given(st.integers(1, 5), st.integers(0, 2), st.lists(st.integers(0, 30), max_size=30))
def test_whoever_dies_every_seat_is_taken_again(seats: int, spares: int, events: list[int]) -> None:
    play = Play(seats, spares)
    for event in events:
        if event < 15:
            play.start()
            play.load()
        else:
            play.kill(event)
        play.now += 0.1
        members = len(play.loading) + len(play.idle) + len(play.seated)
        assert members <= seats + spares
        assert not (play.idle and len(play.seated) < seats), "a spare waits while a seat is vacant"
    play.settle()
    assert sorted(play.seated) == list(range(seats))
    assert len(play.idle) == spares
    assert play.roster.wake() is None


def test_a_spare_takes_a_vacant_seat_at_once() -> None:
    play = Play(2, 1)
    play.settle()
    before = play.seated[1]
    (spare,) = play.idle
    play.kill(len(play.idle) + list(play.seated).index(1))
    assert play.seated[1] == spare != before


def test_spares_are_started_after_the_workers() -> None:
    play = Play(2, 1)
    play.start()
    assert play.count == 2
    play.load()
    play.start()
    assert play.count == 2
    play.load()
    play.start()
    assert play.count == 3


def test_deaths_in_a_row_make_the_next_start_wait_longer() -> None:
    play = Play(1, 0)
    play.settle()
    waits = []
    for _ in range(8):
        play.kill(0)
        waits.append((play.roster.wake() or 0.0) - play.now)
        play.settle()
    assert waits[0] <= 0
    assert waits[1:] == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0]
    play.now += 60.0
    play.kill(0)
    assert play.roster.to_start(play.now) == 1
