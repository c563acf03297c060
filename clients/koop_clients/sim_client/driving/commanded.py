"""Obeying the service: at each step the control of the newest command that has come by then."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from koop_clients.control import Controller
from koop_clients.mechanics.simulation import State
from koop_clients.sim_client.driving.driver import Account
from koop_clients.sim_client.driving.registration import Registration
from koop_clients.sim_client.driving.timing import Timing
from koop_protocol import LqrQuery, LqrReply

_PATIENCE, _MISSING = 1.0, 2  # s, and commands, without which the task is taken for lost
_REMEMBERED = 64  # frames


class Commanded:
    """A driver that registers a task with the service, and obeys its commands.

    Where a command is late the older plan goes on; where that has run out the control is 0.

    Attributes:
        account: how the commands came.
        standing: what is the matter, in a few words; else "".
    """

    def __init__(
        self,
        open_controller: Callable[[LqrQuery], Controller],
        query: LqrQuery,
        registration: Registration,
        timing: Timing,
        takeover: int,
        lag: Callable[[], float],
    ) -> None:
        """Nothing is asked before it must be.

        Args:
            open_controller: makes the controller of this plant's trajectory.
            query: what the task is to be; its delay is measured here.
            registration: asks for it.
            timing: of the run.
            takeover: number of the frame at which the drive begins.
            lag: how long after a frame the service has answered about it, as known so far [s].
        """
        self.account = Account()
        self.standing = ""
        self._open = open_controller
        self._query = query
        self._registration = registration
        self._timing = timing
        self._lag = lag
        # The first plan speaks of intervals from `delay` on; it must reach into the drive.
        self._ask_from = takeover - 1 - timing.frames(0.0)
        self._controller: Controller | None = None
        self._put: dict[int, float] = {}
        self._awaited: dict[int, float] = {}
        self._granted: LqrReply | None = None
        self._counted = -1

    @property
    def has_given_up(self) -> bool:
        """Whether the model was not fit for control for too long."""
        return self._registration.has_given_up

    def shown(self, number: int) -> None:
        """Frame `number` was put just now: ask about it, unless commands come by themselves."""
        now = time.monotonic()
        _remember(self._put, number, now)
        if self._registration.reply is not None:
            _remember(self._awaited, number, now)
        elif number >= self._ask_from:
            self._registration.ask(self._begin)

    def settle(self, number: int) -> None:
        """Take in what came during the interval after frame `number`.

        Raises:
            KoopError: the service refuses for good, or has been silent for too long.
        """
        self._registration.settle(number, self._timing.waits)
        reply, controller = self._registration.reply, self._controller
        self.account.reasons = self._registration.reasons
        self.standing = self._registration.standing
        if reply is None or controller is None:
            return
        if reply is not self._granted:
            self._granted, self.account.warnings = reply, reply.warnings
        if self._timing.waits:
            controller.wait(number, _PATIENCE)
        self._count(controller, number)
        self._check_alive(controller)

    def await_command(self, number: int) -> None:
        """Wait for frame `number`'s command, until the interval after the frame is over."""
        put, controller = self._put.get(number), self._controller
        if number in self._awaited and put is not None and controller is not None:
            left = put + self._timing.wall_interval - time.monotonic()
            controller.wait(number, max(0.0, left))

    def speaks(self, number: int) -> bool:
        """Whether there is a plan for that interval as it begins."""
        return self._row(number, 0) is not None

    def control(self, number: int, step: int) -> float:
        """What the newest plan that was there by then says; 0 without one."""
        row = self._row(number, step)
        return 0.0 if row is None else float(row[0])

    def torque(self, number: int, step: int, state: State) -> float:
        """The same as a torque law [N m]."""
        del state
        return self.control(number, step)

    def close(self) -> None:
        """Cancel the task."""
        if self._controller is not None:
            self._controller.close()

    def _begin(self) -> LqrReply:
        if self._controller is None:
            self.account.delay = self._timing.frames(self._lag())
            query = replace(self._query, delay=self.account.delay)
            self._controller = self._open(query)
        return self._controller.begin()

    def _row(self, number: int, step: int) -> np.ndarray | None:
        if self._controller is None:
            return None
        for seq in range(number, number - _REMEMBERED, -1):
            put, came = self._put.get(seq), self._controller.arrived(seq)
            if put is None or came is None:
                continue
            if self._timing.is_there(seq, came - put, number, step):
                return self._controller.control(number, newest=seq)
        return None

    def _count(self, controller: Controller, number: int) -> None:
        for seq, put in list(self._awaited.items()):
            came = controller.arrived(seq)
            if came is not None:
                self.account.latencies.append(came - put)
                # Commands come in order: whatever came before it and did not, will not.
                self._awaited = {later: t for later, t in self._awaited.items() if later > seq}
        self.account.late += number in self._awaited
        command = controller.command
        if command is not None and command.seq > self._counted:
            self._counted = command.seq
            self.account.statuses[command.status] += 1
            self.standing = "" if command.status == "solved" else command.status

    def _check_alive(self, controller: Controller) -> None:
        if controller.ended is not None:
            self._registration.lose(controller.ended.message)
        elif self._is_silent():
            self._awaited.clear()
            self._registration.lose("no command for a second")
        self.standing = self._registration.standing or self.standing

    def _is_silent(self) -> bool:
        """Whether commands have stopped; a single one may get lost on the way."""
        if len(self._awaited) < _MISSING:
            return False
        return time.monotonic() - min(self._awaited.values()) > _PATIENCE


def _remember(times: dict[int, float], number: int, now: float) -> None:
    times[number] = now
    times.pop(number - _REMEMBERED, None)
