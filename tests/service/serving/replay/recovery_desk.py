"""A pipeline whose sources have logs, without a network: what arrives when is the test's."""

from __future__ import annotations

from pathlib import Path

from integration.loopback import RENDERER, control, picture
from integration.undisturbed import arrival_of, registry_of

from koop_protocol import (
    Control,
    Frame,
    Limits,
    ReplayReply,
    encode,
)
from koop_service.serving.admission.news import LogAnswer, LogPresence, LogQuestion
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.measurements import Measurements
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.trajectory import Trajectory

NAME, EPOCH, OTHER = "cart/0", "00000000000000aa", "00000000000000bb"
Messages = list[Frame | Control]


def frames(*numbers: int, epoch: str = EPOCH, controls: bool = False, **how: object) -> Messages:
    """Frames of these numbers; with a control after each, if wanted."""
    messages: Messages = []
    for seq in numbers:
        options = {"renderer": RENDERER, "logged": True, **how}
        messages.append(Frame(NAME, epoch, seq, int(controls), picture(0, seq), **options))
        if controls:
            messages.append(Control(NAME, epoch, seq, control(0, seq)))
    return messages


class Desk:
    """A service's pipeline with a clock of its own, and what it asks of logs."""

    def __init__(self, model: Path, most: int = 4) -> None:
        self.now = 0.0
        self.asked: list[LogQuestion] = []
        self.metrics = Metrics()
        refusals, limits = Refusals(self.metrics), Limits()
        self.registry = registry_of(model, EstimatorChoices(), refusals)
        self.recovery = Recovery(
            self.registry, self.asked.append, self.metrics, limits, most, lambda: self.now
        )
        self.measurements = Measurements(
            self.registry, refusals, self.recovery, self.metrics, limits, lambda _: None
        )

    def put(self, messages: Messages) -> None:
        for message in messages:
            self.measurements.process([arrival_of(message)])
        self.turn()

    def appear(self, here: bool = True) -> None:
        self.turn(LogPresence(NAME, here))

    def answer(self, messages: Messages, **how: object) -> None:
        """The log answers the newest question with these messages."""
        last = messages[-1] if messages else None
        place = {} if last is None else _place(messages[0], last)
        options = {"position": 9, "end": True, **place, **how}
        data = tuple(map(encode, messages))
        self.reply(encode(ReplayReply(NAME, data, **options), Limits().for_replays()))

    def reply(
        self, payload: bytes | None, question: LogQuestion | None = None, *, late: bool = False
    ) -> None:
        self.turn(LogAnswer(question or self.asked[-1], payload, late=late))

    def turn(self, *news: LogPresence | LogAnswer) -> None:
        self.recovery.attend(news)
        for replay in self.recovery.take(64):
            self.measurements.process(replay.arrivals)
            self.measurements.process(self.recovery.finish(replay))
        self.recovery.attend([])

    @property
    def trajectory(self) -> Trajectory:
        found = self.registry.find(NAME)
        assert found is not None
        return found

    @property
    def next_seq(self) -> int:
        return self.trajectory.stream.next_seq

    def follow(self, count: int = 5, **how: object) -> None:
        """So many frames came, the first ones out of the log."""
        self.appear()
        self.answer(frames(*range(count), **how))


def _place(first: Frame | Control, last: Frame | Control) -> dict[str, object]:
    return {
        "first_epoch": first.epoch,
        "first_seq": first.seq,
        "last_epoch": last.epoch,
        "last_seq": last.seq,
    }
