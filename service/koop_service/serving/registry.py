"""All trajectories by name: who is let in, with which model, in which bank of estimators."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from koop_protocol import Control, ErrorCode, Frame, ProtocolError
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.estimator import Bank
from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import Stream
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.durability.sealing import seal, unseal
from koop_service.serving.records import check_record, restored, snapshot_of
from koop_service.serving.refusals import Refusals
from koop_service.serving.trajectories import REMEMBERED_EPOCHS, Trajectory, check_image

log = logging.getLogger("koop.trajectories")


def settings_for(entry: ModelEntry, chosen: EstimatorChoices, p: int) -> EstimatorSettings:
    """What the user chose, else what the model's card recommends, for p controls."""
    card = entry.card.estimator
    return EstimatorSettings(
        code_size=entry.card.code_size,
        history=card.history if chosen.history is None else chosen.history,
        control_size=p,
        affine=card.affine if chosen.affine is None else chosen.affine,
        rho=card.rho if chosen.rho is None else chosen.rho,
        forgetting=card.forgetting if chosen.forgetting is None else chosen.forgetting,
        window=chosen.window,
    )


class Registry:
    """The trajectories, the models that they use, and the banks that hold their estimators."""

    def __init__(
        self,
        catalogue: Catalogue,
        choices: EstimatorChoices,
        refusals: Refusals,
        max_trajectories: int,
        device: str = "cpu",
    ) -> None:
        self._catalogue = catalogue
        self._choices = choices
        self._refusals = refusals
        self._max_trajectories = max_trajectories
        self._device = device
        self._trajectories: dict[str, Trajectory] = {}
        self._codecs: dict[str, ImageCodec] = {}
        self._banks: dict[tuple[str, int], Bank] = {}

    def __len__(self) -> int:
        return len(self._trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self._trajectories.values())

    def __contains__(self, name: object) -> bool:
        return name in self._trajectories

    def names(self) -> list[str]:
        """Names of all trajectories."""
        return list(self._trajectories)

    def count_ready(self) -> int:
        """Trajectories that can be predicted."""
        return sum(trajectory.ready for trajectory in list(self._trajectories.values()))

    def find(self, name: str) -> Trajectory | None:
        """The trajectory of that name."""
        return self._trajectories.get(name)

    def admit(self, message: Frame | Control) -> Trajectory:
        """The trajectory that the message is for, opened at its first frame.

        Raises ProtocolError where the message does not fit, and where there is no model or no room.
        """
        trajectory = self._trajectories.get(message.trajectory)
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
        trajectory = self._trajectories.get(message.trajectory)
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
        entry, refused = self._catalogue.match(name), self._refusals.last(name)
        if entry is None:
            return self._no_model(name)
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

    # Snapshots

    def snapshot(self) -> dict[str, bytes]:
        """A sealed record of each trajectory that has been folded into."""
        return {t.name: seal(snapshot_of(t)) for t in self if t.stream.epoch is not None}

    def restore(self, records: Mapping[str, bytes]) -> int:
        """Open the trajectories that are whole and still fit models and settings; how many."""
        left_out: list[str] = []
        for name, sealed in records.items():
            try:
                self._trajectories[name] = self._restored(name, unseal(sealed))
            except Exception as error:
                left_out.append(f"{name[:200]!r}: {error}")
        if left_out:
            log.warning(
                "the stored state of %d trajectories is left out, such as of %s",
                len(left_out),
                left_out[0],
            )
        return len(records) - len(left_out)

    def _restored(self, name: str, record: Mapping[str, Any]) -> Trajectory:
        entry = self._entry_for(name)
        settings = settings_for(entry, self._choices, int(record["settings"]["control_size"]))
        check_record(record, entry, settings)
        return restored(name, record, entry, self._codec(entry), self._bank(entry, settings))

    def equipment(
        self, entry: ModelEntry, control_size: int
    ) -> tuple[ImageCodec, EstimatorSettings]:
        """What a trajectory of this model would be opened with."""
        return self._codec(entry), settings_for(entry, self._choices, control_size)

    # Opening

    def _open(self, frame: Frame, former: Trajectory | None) -> Trajectory:
        if former is None and len(self) >= self._max_trajectories:
            raise ProtocolError(
                "too_many_trajectories",
                f"{len(self)} trajectories are here already",
                f"at most {self._max_trajectories}",
                "raise --max-trajectories",
                {"limit": self._max_trajectories},
            )
        entry = self._entry_for(frame.trajectory)
        settings = settings_for(entry, self._choices, frame.control_size)
        codec = self._codec(entry)
        check_image(frame, entry, codec)
        bank = self._bank(entry, settings)
        ended: tuple[str, ...] = ()
        if former is not None:
            ended = (*former.ended_epochs(), former.epoch)[-REMEMBERED_EPOCHS:]
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
        self._trajectories[frame.trajectory] = trajectory
        return trajectory

    def _entry_for(self, name: str) -> ModelEntry:
        entry = self._catalogue.match(name)
        if entry is None:
            raise self._no_model(name)
        return entry

    def _codec(self, entry: ModelEntry) -> ImageCodec:
        if entry.name not in self._codecs:
            try:
                self._codecs[entry.name] = entry.load(self._device)
            except (ValueError, RuntimeError) as error:
                raise ProtocolError(
                    ErrorCode.no_model, f"the model {entry.name!r} cannot be loaded: {error}"
                ) from error
        return self._codecs[entry.name]

    def _bank(self, entry: ModelEntry, settings: EstimatorSettings) -> Bank:
        key = (entry.name, settings.control_size)
        if key not in self._banks:
            self._banks[key] = Bank(settings)
        return self._banks[key]

    def _no_model(self, name: str) -> ProtocolError:
        models = [f"{e.name} ({' '.join(e.patterns)})" for e in self._catalogue.entries]
        return ProtocolError(
            ErrorCode.no_model,
            f"no model for trajectory {name!r}",
            f"a name that one of the models is for: {', '.join(models) or 'there are none yet'}",
            "train one with 'koop-dataset ... && koop-train ...' and pass it with "
            f"--models '{name.split('/')[0]}/*=FILE'",
            {"trajectory": name},
        )


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
