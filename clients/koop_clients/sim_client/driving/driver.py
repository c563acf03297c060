"""What decides about a plant's torque while it is driven."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Protocol

from koop_clients.mechanics.simulation import Policy, State

_KEPT = 10_000  # latencies


@dataclass
class Account:
    """How the commands of one drive came.

    Attributes:
        latencies: from putting a frame to the command from it being there [s].
        late: intervals that were over before their own frame's command came.
        statuses: commands by the solver's word.
        delay: frames between a frame and its first control, as the task was told.
        reasons: why the model was last found not fit for control.
        warnings: what the service said beside its first plan.
    """

    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    late: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    delay: int = 0
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


class Deciding(Protocol):
    """Decides about one plant's controls.

    An interval is simulated when the next frame is due: whatever came while it lasted is known
    then, with the time at which it came.
    """

    account: Account
    standing: str
    """What is the matter, in a few words; else ""."""

    @property
    def has_given_up(self) -> bool:
        """Whether it will never drive."""
        ...

    def shown(self, number: int) -> None:
        """Frame `number` was put just now."""
        ...

    def settle(self, number: int) -> None:
        """The interval after frame `number` is over; its controls may be asked about."""
        ...

    def speaks(self, number: int) -> bool:
        """Whether it knows a control at the beginning of that interval."""
        ...

    def close(self) -> None:
        """The drive is over."""
        ...


class Driver(Deciding, Protocol):
    """Decides about one plant's torque, 5 ms by 5 ms."""

    def torque(self, number: int, step: int, state: State) -> float:
        """The torque law [N m] (a Policy)."""
        ...


class Independent:
    """What is common to drivers that ask nobody."""

    has_given_up = False

    def __init__(self) -> None:
        self.account = Account()
        self.standing = ""

    def shown(self, number: int) -> None:
        """Nothing to ask."""

    def settle(self, number: int) -> None:
        """Nothing to wait for."""

    def speaks(self, number: int) -> bool:
        """Always."""
        del number
        return True

    def close(self) -> None:
        """Nothing to end."""


class Knowing(Independent):
    """A driver that knows the true state."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self._policy = policy

    def torque(self, number: int, step: int, state: State) -> float:
        """The law's torque [N m]."""
        return self._policy(number, step, state)
