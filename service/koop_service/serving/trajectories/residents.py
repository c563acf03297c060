"""The trajectories in memory: who leaves for the disk, and who comes back from there."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from koop_protocol import Control, Ending, ErrorCode, Frame, ProtocolError
from koop_service.estimation.estimator import Bank
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.trajectories.residence import Residence
from koop_service.serving.trajectories.trajectory import Trajectory

log = logging.getLogger("koop.trajectories")

_AT_ONCE = 16
"""Trajectories that leave between two batches at most, but for those that make room."""


class Archive(Protocol):
    """Where trajectories go that leave memory."""

    def has_room(self) -> bool:
        """Whether a further one can be kept."""
        ...

    def leave(self, trajectory: Trajectory) -> None:
        """Keep it."""
        ...

    def recall(self, name: str) -> dict[str, Any] | None:
        """The record of one that may come back, where there is one.

        Raises OSError where it cannot be read at present.
        """
        ...

    def arrived(self, name: str) -> None:
        """It came back."""
        ...

    def spares(self, name: str) -> bool:
        """Whether it must not leave to make room for another."""
        ...

    def is_pressed(self) -> bool:
        """Whether a further trajectory must take the place of another, for want of memory."""
        ...


class Residents:
    """At most `most` trajectories by name. One that is not in memory is looked for in the archive.

    archive: where trajectories go to make room; None: a further one is refused.
    ended: is told of each run that is over: trajectory, epoch, next number, why.
    """

    def __init__(self, most: int, clock: Callable[[], float]) -> None:
        self.archive: Archive | None = None
        self.ended: Callable[[str, str, int, Ending], None] = lambda *_: None
        self._most = most
        self._trajectories: dict[str, Trajectory] = {}
        self._residence = Residence(clock)
        self._brake = Brake()

    def __len__(self) -> int:
        return len(self._trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self._trajectories.values())

    def __contains__(self, name: object) -> bool:
        return name in self._trajectories

    def names(self) -> list[str]:
        """Names of all trajectories in memory."""
        return list(self._trajectories)

    def count_ready(self) -> int:
        """Trajectories that can be predicted."""
        return sum(map(_is_ready, list(self._trajectories.values())))

    def held(self, name: str) -> Trajectory | None:
        """The trajectory of that name, where it is in memory."""
        return self._trajectories.get(name)

    def find(self, name: str) -> Trajectory | None:
        """The trajectory of that name, for use: an evicted one is brought back from the disk.

        Raises ProtocolError where there is no room for it, or the disk cannot be read.
        """
        trajectory = self._trajectories.get(name)
        if trajectory is None:
            return self._revive(name)
        self._residence.touch(name)
        return trajectory

    def tell_gone(self, name: str) -> None:
        """Its source is gone; what was learned stays."""
        trajectory = self._trajectories.get(name)
        if trajectory is not None:
            self._tell(trajectory, Ending.source_gone)

    def evict_idle(self, seconds: float) -> None:
        """Have some of those leave that were not used for so long."""
        for name in self._residence.idle_for(seconds, _AT_ONCE):
            if self.archive is None or not self.archive.has_room():
                return
            self._evict(name)

    def displaced_by(self, message: Frame | Control) -> Trajectory | None:
        """The trajectory that would have to leave for the message's, which is not in memory."""
        if message.trajectory in self or not self._is_full():
            return None
        victim = self._victim()
        return None if victim is None else self._trajectories[victim]

    def _is_full(self) -> bool:
        if len(self) >= self._most:
            return True
        return self.archive is not None and self.archive.is_pressed() and len(self) > 0

    def _victim(self) -> str | None:
        return None if self.archive is None else self._residence.longest_idle(self.archive.spares)

    def _make_room(self) -> None:
        """Have the longest idle one leave, where there is no room for one more."""
        if not self._is_full():
            return
        victim = self._victim()
        if victim is None or self.archive is None or not self.archive.has_room():
            raise ProtocolError(
                "too_many_trajectories",
                f"{len(self)} trajectories are here already",
                f"at most {self._most}, or fewer that are in use",
                "raise --max-trajectories",
                {"limit": self._most},
            )
        self._evict(victim)

    def _evict(self, name: str) -> None:
        trajectory = self._trajectories[name]
        if self.archive is not None:
            self.archive.leave(trajectory)
        del self._trajectories[name]
        self._residence.remove(name)
        trajectory.bank.close(trajectory.lane)
        self._compact(trajectory.bank)
        self._tell(trajectory, Ending.evicted)

    def _compact(self, bank: Bank) -> None:
        moved = bank.compact()
        for trajectory in self._trajectories.values() if moved else ():
            if trajectory.bank is bank:
                trajectory.lane = moved.get(trajectory.lane, trajectory.lane)

    def _revive(self, name: str) -> Trajectory | None:
        """The trajectory as it was when it left; None where nothing of it is kept, or fits."""
        if self.archive is None:
            return None
        try:
            record = self.archive.recall(name)
            if record is None:
                return None
            self._make_room()
            trajectory = self._restored(name, record)
        except ProtocolError:
            raise
        except OSError as error:
            raise ProtocolError(
                ErrorCode.internal,
                f"the stored state of {name!r} cannot be read at present: {error}",
                remedy="ask again later",
            ) from error
        except Exception as error:
            if self._brake.admit("record") is not None:
                log.warning("the stored state of %r is left out: %s", name[:200], error)
            return None
        self._settle_in(trajectory)
        self.archive.arrived(name)
        return trajectory

    def _settle_in(self, trajectory: Trajectory) -> None:
        self._trajectories[trajectory.name] = trajectory
        self._residence.touch(trajectory.name)

    def _tell(self, trajectory: Trajectory, reason: Ending) -> None:
        if trajectory.stream.epoch is not None:
            stream = trajectory.stream
            self.ended(trajectory.name, trajectory.epoch, stream.next_seq, reason)

    def _restored(self, name: str, record: Mapping[str, Any]) -> Trajectory:
        """The trajectory of a record; raises an error where it does not fit any more."""
        raise NotImplementedError


def _is_ready(trajectory: Trajectory) -> bool:
    try:
        return trajectory.ready
    except ValueError:  # evicted just now: metrics are read from a thread of their own
        return False
