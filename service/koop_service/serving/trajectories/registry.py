"""All trajectories by name: who is let in, with which model, in which bank of estimators."""

from __future__ import annotations

import logging
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from koop_protocol import Control, Ending, ErrorCode, Frame, ProtocolError
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.estimator import Bank
from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import Stream
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.trajectories.equipment import Equipment
from koop_service.serving.trajectories.records import check_record, computed_elsewhere, restored
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.residents import Residents
from koop_service.serving.trajectories.sealing import unseal
from koop_service.serving.trajectories.trajectory import REMEMBERED_EPOCHS, Trajectory, check_image

log = logging.getLogger("koop.trajectories")


class Registry(Residents):
    """Who is let in, with which model, in which bank; see `Residents` for who is in memory."""

    def __init__(
        self,
        catalogue: Catalogue,
        choices: EstimatorChoices,
        refusals: Refusals,
        max_trajectories: int,
        device: str = "cpu",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(max_trajectories, clock)
        self._equipment = Equipment(catalogue, choices, device)
        self._refusals = refusals

    def admit(self, message: Frame | Control) -> Trajectory:
        """The trajectory that the message is for, opened at its first frame.

        Raises ProtocolError where the message does not fit, and where there is no model or no room.
        """
        trajectory = self.find(message.trajectory)
        if isinstance(message, Control):
            if trajectory is None:
                raise _no_frame_yet(message)
            trajectory.check_control(message)
            return trajectory
        if trajectory is None or self.would_replace(message):
            trajectory = self._open(message, trajectory)
        trajectory.check_frame(message)
        return trajectory

    def would_replace(self, message: Frame | Control) -> bool:
        """Whether the message starts a new epoch with another control size, so new estimators."""
        if isinstance(message, Control):
            return False
        trajectory = self.find(message.trajectory)
        return (
            trajectory is not None
            and message.control_size != trajectory.settings.control_size
            and message.epoch != trajectory.epoch
            and message.epoch not in trajectory.ended_epochs()
        )

    def update_estimators(self, trajectories: Iterable[Trajectory]) -> int:
        """Give the banks what these trajectories' streams have completed; how many updates."""
        by_bank: dict[Bank, list[Trajectory]] = defaultdict(list)
        for trajectory in trajectories:
            if trajectory.queue:
                by_bank[trajectory.bank].append(trajectory)
        return sum(_fold(bank, group) for bank, group in by_bank.items())

    def why_unknown(self, name: str) -> ProtocolError:
        """What to tell somebody who asks about a trajectory that is not there."""
        entry, refused = self._equipment.match(name), self._refusals.last(name)
        if entry is None:
            return self._equipment.no_model(name)
        details: dict[str, str | int | float] = {"trajectory": name, "trajectories": len(self)}
        if refused is not None:
            details["refused"] = str(refused.code)
            problem = (
                f"every message of {name!r} was rejected so far, the last one because {refused}"
            )
            return ProtocolError(ErrorCode.unknown_trajectory, problem, details=details)
        return ProtocolError(
            ErrorCode.unknown_trajectory,
            f"no frame of {name!r} has come",
            f"one of the {len(self)} trajectories here (ask koop/state/** for them)",
            "stream frames first, or check the name",
            details,
        )

    # Coming back

    def restore(self, records: Mapping[str, bytes]) -> int:
        """Open the trajectories that are whole and still fit models and settings; how many."""
        left_out: list[str] = []
        elsewhere: Counter[str] = Counter()
        for name, sealed in records.items():
            try:
                record = unseal(sealed)
                trajectory = self._restored(name, record)
                self._settle_in(trajectory)
            except Exception as error:
                left_out.append(f"{name[:200]!r}: {error}")
            else:
                elsewhere[computed_elsewhere(record, trajectory.codec)] += 1
        _tell_of(left_out, elsewhere)
        return len(records) - len(left_out)

    def equipment(
        self, entry: ModelEntry, control_size: int
    ) -> tuple[ImageCodec, EstimatorSettings]:
        """What a trajectory of this model would be opened with."""
        return self._equipment.codec(entry), self._equipment.settings(entry, control_size)

    def _restored(self, name: str, record: Mapping[str, Any]) -> Trajectory:
        equipment, entry = self._equipment, self._equipment.match(name)
        if entry is None:
            raise ValueError("there is no model for it any more")
        settings = equipment.settings(entry, int(record["settings"]["control_size"]))
        check_record(record, entry, settings)
        bank = equipment.bank(entry, settings)
        return restored(name, record, entry, equipment.codec(entry), bank)

    # Opening

    def _open(self, frame: Frame, former: Trajectory | None) -> Trajectory:
        equipment, entry = self._equipment, self._equipment.entry_for(frame.trajectory)
        settings, codec = equipment.settings(entry, frame.control_size), equipment.codec(entry)
        check_image(frame, entry, codec)
        bank = equipment.bank(entry, settings)
        ended: tuple[str, ...] = ()
        if former is None:
            self._make_room()
        else:
            ended = (*former.ended_epochs(), former.epoch)[-REMEMBERED_EPOCHS:]
            self._tell(former, Ending.replaced_epoch)
            former.bank.close(former.lane)
        trajectory = Trajectory(
            frame.trajectory,
            entry,
            codec,
            bank,
            bank.open(),
            Stream(settings),
            frame.epoch,
            ended,
        )
        self._settle_in(trajectory)
        return trajectory


def _tell_of(left_out: list[str], elsewhere: Counter[str]) -> None:
    if left_out:
        log.warning(
            "the stored state of %d trajectories is left out, such as of %s",
            len(left_out),
            left_out[0],
        )
    for where, count in elsewhere.items():
        if where:
            log.warning("%d stored trajectories go on, but not to the bit: %s", count, where)


def _no_frame_yet(control: Control) -> ProtocolError:
    return ProtocolError(
        ErrorCode.unknown_trajectory,
        f"a control of {control.trajectory!r} came before its first frame",
        "a frame first",
    )


def _fold(bank: Bank, trajectories: list[Trajectory]) -> int:
    """Fold the queued transitions in one call; a trajectory's own stay in their order."""
    lanes = [t.lane for t in trajectories for _ in t.queue]
    W = np.array([transition.w for t in trajectories for transition in t.queue])
    Y = np.array([transition.y for t in trajectories for transition in t.queue])
    for trajectory in trajectories:
        trajectory.queue.clear()
    bank.fold(np.array(lanes), W, Y)
    return len(lanes)
