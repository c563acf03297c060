"""Following one plan to its end without a further look: the paper's open loop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from koop_clients.mechanics.simulation import State
from koop_clients.sim_client.driving.driver import Account
from koop_clients.sim_client.driving.registration import Registration
from koop_protocol import LqrReply


class Planned:
    """A driver that asks for one plan at the takeover, waits for it, and follows it.

    Attributes:
        account: how the plan came.
        standing: what is the matter, in a few words; else "".
    """

    def __init__(
        self, ask: Callable[[], LqrReply], registration: Registration, takeover: int
    ) -> None:
        self.account = Account()
        self.standing = ""
        self._ask = ask
        self._registration = registration
        self._takeover = takeover

    @property
    def has_given_up(self) -> bool:
        """Whether the model was not fit for control for too long."""
        return self._registration.has_given_up

    @property
    def pictures(self) -> np.ndarray | None:
        """(N, H, W) what the plan leads to, by the service's model; None without a plan."""
        reply = self._registration.reply
        return None if reply is None else reply.frames

    def shown(self, number: int) -> None:
        """Frame `number` was put just now: ask for the plan from it, unless there is one."""
        if number >= self._takeover:
            self._registration.ask(self._ask)

    def settle(self, number: int) -> None:
        """Wait for the plan.

        Raises:
            KoopError: a refusal that waiting does not heal.
        """
        self._registration.settle(number, wait=True)
        reply = self._registration.reply
        self.account.reasons = self._registration.reasons
        self.standing = self._registration.standing
        if reply is not None and not self.account.statuses:
            self.account.statuses[reply.status] += 1
            self.account.warnings = reply.warnings

    def speaks(self, number: int) -> bool:
        """Whether the plan has a torque for that interval."""
        return self._row(number) is not None

    def torque(self, number: int, step: int, state: State) -> float:
        """The plan's torque [N m]; 0 after its end."""
        del step, state
        row = self._row(number)
        return 0.0 if row is None else float(row[0])

    def close(self) -> None:
        """Nothing to end."""

    def _row(self, number: int) -> np.ndarray | None:
        reply = self._registration.reply
        if reply is None or reply.controls is None:
            return None
        index = number - reply.start
        return reply.controls[index] if 0 <= index < len(reply.controls) else None
