"""From a batch of arrivals to updated estimators: decode, check, encode, fold.

Every message that cannot be used ends in `Refusals` or, where the fault is ours, in the counter of
lost ones; it never touches another trajectory's.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koop_protocol import Control, Ending, Frame, Limits, ProtocolError
from koop_protocol.checks import Image
from koop_service.encoding.image_codec import ImageCodec
from koop_service.serving.admission.arrivals import Arrival, lane_of
from koop_service.serving.admission.reading import read
from koop_service.serving.encoding import BatchEncoder, EncoderError
from koop_service.serving.instruments.logs import Brake
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory

log = logging.getLogger("koop.measurements")

Array = NDArray[np.float64]


@dataclass(slots=True)
class _Accepted:
    """A message that will be folded; a frame's code is computed in between.

    stalled: the encoder failed under it.
    """

    trajectory: Trajectory
    message: Frame | Control
    arrival: Arrival
    code: Array | None = None
    stalled: bool = False


class Measurements:
    """Folds arrivals into the registry's trajectories, in the order given."""

    def __init__(
        self,
        registry: Registry,
        refusals: Refusals,
        recovery: Recovery,
        metrics: Metrics,
        limits: Limits,
        changed: Callable[[Iterable[Trajectory]], None],
    ) -> None:
        self._registry = registry
        self._refusals = refusals
        self._recovery = recovery
        self._metrics = metrics
        self._limits = limits
        self._changed = changed
        self._encoder = BatchEncoder(metrics)
        self._stalled: set[str] = set()
        self._brake = Brake()

    @property
    def encoder_fails(self) -> bool:
        """Whether some model could not encode what last came for it."""
        return self._encoder.fails

    def process(self, arrivals: list[Arrival]) -> dict[Trajectory, float]:
        """Use every arrival or account for it; raises nothing.

        Returns the trajectories that have a new newest live frame, and when that came [s].
        """
        self._stalled.clear()
        accepted: list[_Accepted] = []
        advanced: dict[Trajectory, float] = {}
        for arrival in arrivals:
            message = self._read(arrival)
            if message is None:
                continue
            if self._must_go_first(accepted, message):
                advanced |= self._fold(accepted)
                accepted = []
            self._accept(arrival, message, accepted)
        return advanced | self._fold(accepted)

    def _must_go_first(self, accepted: list[_Accepted], message: Frame | Control) -> bool:
        """Whether what was accepted has to be folded before this message is looked at.

        Because it is a new run's with other controls, or a trajectory leaves memory for it.
        """
        leaves = self._registry.displaced_by(message)
        if leaves is not None and any(item.trajectory is leaves for item in accepted):
            return True
        try:
            return self._registry.would_replace(message)
        except ProtocolError:
            return False  # it will be refused for that

    def _read(self, arrival: Arrival) -> Frame | Control | None:
        try:
            return read(arrival, self._limits)
        except ProtocolError as error:
            self._reject(lane_of(arrival.key), error)
        except Exception:
            self._lose("reading a message", 1)
        return None

    def _accept(
        self, arrival: Arrival, message: Frame | Control, accepted: list[_Accepted]
    ) -> None:
        try:
            if not self._is_due(arrival, message):
                return
            trajectory = self._registry.admit(message)
        except ProtocolError as error:
            self._reject(lane_of(arrival.key), error)
        except Exception:
            self._lose("admitting a message", 1)
        else:
            accepted.append(_Accepted(trajectory, message, arrival))

    def _is_due(self, arrival: Arrival, message: Frame | Control) -> bool:
        if arrival.replayed:
            return not self._recovery.has_come(message)
        return self._recovery.admits(arrival, message)

    def _fold(self, accepted: list[_Accepted]) -> dict[Trajectory, float]:
        """Fold them, and tell which trajectories have a new newest frame, and since when."""
        self._encode(accepted)
        folded, replayed = {Frame: 0, Control: 0}, 0
        advanced: dict[Trajectory, float] = {}
        for item in accepted:
            before, epoch = item.trajectory.last_seq, item.trajectory.epoch
            if self._fold_one(item):
                folded[type(item.message)] += 1
                replayed += item.arrival.replayed
            if item.trajectory.last_seq != before and not item.arrival.replayed:
                advanced[item.trajectory] = item.arrival.at
            if item.trajectory.epoch != epoch:
                name, over = item.trajectory.name, Ending.replaced_epoch
                self._registry.ended(name, epoch, before + 1, over)
        touched = {item.trajectory: None for item in accepted}
        self._changed(touched)
        try:
            updates = self._registry.update_estimators(touched)
        except Exception:
            self._lose("updating the estimators", len(accepted))
            return {}
        self._metrics.frames.inc(folded[Frame])
        self._metrics.controls.inc(folded[Control])
        self._metrics.updates.inc(updates)
        self._metrics.replayed.inc(replayed)
        return advanced

    def _fold_one(self, item: _Accepted) -> bool:
        message = item.message
        try:
            if self._waits(item):
                return False
            if not self._recovery.folds(item.arrival, message, item.trajectory):
                return False
            if isinstance(message, Control):
                item.trajectory.fold_control(message)
            elif item.code is None:
                return False  # it could not be encoded, and is counted
            else:
                item.trajectory.fold_frame(message, item.code)
        except ProtocolError as error:
            self._reject(message.trajectory, error)
        except Exception:
            self._lose("folding a message", 1)
        else:
            return True
        return False

    def _waits(self, item: _Accepted) -> bool:
        """Whether the encoder failed under it or, of a log's answer, under one before it.

        It comes again where its source has a log; else it is lost.
        """
        message, arrival = item.message, item.arrival
        if arrival.replayed:
            if item.stalled:
                self._stalled.add(message.trajectory)
            arrival.stalled = message.trajectory in self._stalled
            return arrival.stalled
        if item.stalled and not self._recovery.stalls(arrival, message):
            self._metrics.lost.inc()
        return item.stalled

    def _encode(self, items: list[_Accepted]) -> None:
        """Compute the codes, all frames of one model together."""
        groups: dict[tuple[ImageCodec, bool], list[tuple[_Accepted, Image]]] = defaultdict(list)
        for item in items:
            if isinstance(item.message, Frame):
                image = item.message.image
                groups[item.trajectory.codec, image.dtype == np.uint8].append((item, image))
        for (codec, _), group in groups.items():
            self._encode_group(codec, group)

    def _encode_group(self, codec: ImageCodec, group: list[tuple[_Accepted, Image]]) -> None:
        images = [image for _, image in group]
        try:
            codes = self._encoder.encode(codec, images, hurried=self._recovery.behind > 0)
        except EncoderError as error:
            if self._brake.admit("encoder") is not None:
                log.error("nothing can be encoded; sources with a log lose nothing", exc_info=error)
            for item, _ in group:
                item.stalled = True
            return
        for (item, _), code in zip(group, codes, strict=True):
            item.code = code
        self._metrics.lost.inc(sum(code is None for code in codes))

    def _reject(self, lane: str, error: ProtocolError) -> None:
        trajectory = self._registry.held(lane)
        if trajectory is not None:
            trajectory.rejected[str(error.code)] += 1
        self._refusals.note(lane, error)

    def _lose(self, doing: str, count: int) -> None:
        """An exception of ours: counted, logged with its traceback, and the others go on."""
        self._metrics.lost.inc(count)
        if self._brake.admit(doing) is not None:
            log.exception("%s failed; %d messages are lost, the service goes on", doing, count)
