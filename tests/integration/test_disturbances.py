"""Whatever is killed or lost, and when: the state is bit for bit that of an undisturbed stream.

Source, log and service as they are, without a network and without processes: what would travel
stands in queues, and hypothesis decides what arrives, what is lost and who dies. Why it holds is
said in docs/design.md, under "Durability".
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import example, given, settings
from integration.loopback import RENDERER, control, picture, write_model
from integration.undisturbed import arrival_of, registry_of, undisturbed

from koop_clients.replay.file import CONTROL, FRAME, LogFile
from koop_protocol import (
    Control,
    Durable,
    Frame,
    Limits,
    encode,
)
from koop_service.encoding.image_codec import ImageCodec
from koop_service.serving.admission.arrivals import Arrival
from koop_service.serving.admission.news import LogAnswer, LogPresence, LogQuestion
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.measurements import Measurements
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.trajectories.records import snapshot_of
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.sealing import seal, unseal

NAME = "cart/0"
CHOICES = EstimatorChoices(forgetting=0.9)
Message = Frame | Control


class Service:
    """The pipeline's part of a service: what is folded, and who is asked."""

    def __init__(self, model: Path, stored: dict[str, bytes]) -> None:
        self.now = 0.0
        self.questions: list[LogQuestion] = []
        metrics, limits = Metrics(), Limits()
        refusals = Refusals(metrics)
        self.registry = registry_of(model, CHOICES, refusals)
        assert self.registry.restore(stored) == len(stored)
        self.recovery = Recovery(
            self.registry, self.questions.append, metrics, limits, 8, lambda: self.now
        )
        self.measurements = Measurements(
            self.registry, refusals, self.recovery, metrics, limits, lambda _: None
        )

    def process(self, arrivals: list[Arrival]) -> None:
        self.measurements.process(arrivals)
        self.step()

    def step(self) -> None:
        """As a turn of the pipeline does."""
        self.recovery.attend([])
        while replays := self.recovery.take(64):
            self.measurements.process([a for replay in replays for a in replay.arrivals])
            self.measurements.process([a for r in replays for a in self.recovery.finish(r)])
            self.recovery.attend([])

    def snapshot(self) -> tuple[dict[str, bytes], Durable | None]:
        """What would be stored, and what the source need not keep then."""
        trajectory = self.registry.find(NAME)
        if trajectory is None or trajectory.stream.epoch is None:
            return {}, None
        stream = trajectory.stream
        durable = Durable(NAME, stream.epoch, stream.replay_from)
        return {NAME: seal(snapshot_of(trajectory))}, durable


class World:
    """One source with its log, what is on the way, and one service with its store."""

    def __init__(self, folder: Path, model: Path, control_size: int) -> None:
        self.folder, self.model, self.control_size = folder, model, control_size
        self.put: list[Message] = []
        self.wire: deque[tuple[Message, bytes]] = deque()
        self.stored: dict[str, bytes] = {}
        self.unheard: list[Durable] = []
        self.log = LogFile(folder / "log", 1 << 30)
        self.service = Service(model, {})
        self.runs = 0
        self.encodes = True
        self.begin_epoch()
        self.start_source()

    # The source

    def begin_epoch(self) -> None:
        self.runs += 1
        self.epoch, self.seq, self.awaits_control = f"{self.runs:016x}", 0, False

    def start_source(self) -> None:
        """Its token comes, once more or for the first time."""
        self.service.recovery.attend([LogPresence(NAME, True)])

    def stream(self, count: int, *, answered: bool) -> None:
        """Messages that arrive as they are put; whether the log answers meanwhile."""
        for _ in range(count):
            self.measure()
            self.deliver(len(self.wire))
            if answered:
                self.answer(8)

    def miss(self, count: int) -> None:
        """Messages are lost, and nobody knows."""
        for _ in range(count):
            self.measure()
        self.wire.clear()

    def miss_next(self, kind: type[Message]) -> None:
        """The next frame, or the next control, is lost alone."""
        if self.awaits_control != (kind is Control):
            self.stream(1, answered=True)
        self.miss(1)

    def burst(self, count: int, *, lost: int) -> None:
        """Messages that arrive together, but for some of the first."""
        for _ in range(lost + count):
            self.measure()
        for _ in range(lost):
            self.wire.popleft()
        self.deliver(count)

    def measure(self) -> None:
        """A frame, or the control that follows it: logged, then put."""
        if self.awaits_control:
            message: Message = Control(
                NAME, self.epoch, self.seq - 1, control(len(self.put), self.seq)
            )
        else:
            image = picture(self.runs, len(self.put))
            message = Frame(
                NAME, self.epoch, self.seq, self.control_size, image, RENDERER, logged=True
            )
            self.seq += 1
        self.awaits_control = isinstance(message, Frame) and self.control_size > 0
        data = encode(message)
        kind = FRAME if isinstance(message, Frame) else CONTROL
        self.log.append(NAME, message.epoch, message.seq, kind, data)
        self.put.append(message)
        self.wire.append((message, data))

    def kill_source(self, *, resume: bool, before_the_put: bool, noticed: bool) -> None:
        """Unnoticed: it is back before its former token is gone, and one token hides the other."""
        if before_the_put:
            self.measure()
        self.wire.clear()
        self.log.close()
        self.log = LogFile(self.folder / "log", 1 << 30)
        if not resume:
            self.begin_epoch()
        if noticed:
            self.service.recovery.attend([LogPresence(NAME, False)])
            self.start_source()

    # The way

    def deliver(self, count: int) -> None:
        arrivals = [self.wire.popleft() for _ in range(min(count, len(self.wire)))]
        self.service.process([arrival_of(m, data) for m, data in arrivals])

    def lose(self, count: int) -> None:
        """The link breaks: messages are gone, and the source's token comes anew with it."""
        self.miss(count)
        self.start_source()

    def answer(self, count: int, *, lost: bool = False, folded: bool = True) -> None:
        """The log answers the oldest questions; folded: at once. Or its answers get lost."""
        for _ in range(min(count, len(self.service.questions))):
            question = self.service.questions.pop(0)
            query = replace(question.query, max_bytes=20_000)  # about five frames
            payload = None if lost else encode(self.log.read(NAME, query), Limits().for_replays())
            self.service.recovery.attend([LogAnswer(question, payload, late=lost)])
            if folded:
                self.service.step()

    def overlap(self) -> None:
        """The token comes anew while an answer waits to be folded: so the same is asked twice."""
        for _ in range(2):
            self.start_source()
            self.answer(8, folded=False)
        self.service.step()

    # The service

    def snapshot(self) -> None:
        stored, durable = self.service.snapshot()
        self.stored |= stored
        if durable is not None:
            self.unheard.append(durable)

    def acknowledge(self, count: int) -> None:
        """The log hears of some snapshots, the oldest of which it has not heard."""
        self.log.forget(self.unheard[:count])
        del self.unheard[:count]

    def wait(self, seconds: float) -> None:
        self.service.now += seconds
        self.service.step()

    def kill_service(self) -> None:
        self.service = Service(self.model, self.stored)
        self.start_source()

    def turn_encoder(self, on: bool) -> None:
        """Its device goes, or comes back."""
        self.encodes = on

    def settle(self) -> None:
        """Nothing else happens, and everything on the way arrives."""
        self.encodes = True
        for _ in range(1000):
            self.deliver(8)
            self.answer(8)
            self.service.now += 0.1
            self.service.step()
            if not (self.wire or self.service.questions or self.service.recovery.behind):
                return
        raise AssertionError("it never settles")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("model"))


def event(name: str, **options: st.SearchStrategy) -> st.SearchStrategy:
    return st.tuples(st.just(name), st.fixed_dictionaries(options))


few, yes = st.integers(1, 12), st.booleans()
streaming = event("stream", count=st.integers(1, 3) | st.integers(1, 40), answered=yes)
disturbances = (
    event("lose", count=few),
    event("miss", count=few),
    event("miss_next", kind=st.sampled_from([Frame, Control])),
    event("burst", count=st.integers(1, 60) | st.just(200), lost=st.integers(0, 3)),
    event("answer", count=few, lost=yes, folded=yes),
    event("overlap"),
    event("snapshot"),
    event("acknowledge", count=few),
    event("wait", seconds=st.sampled_from([0.1, 3.0])),
    event("kill_service"),
    event("turn_encoder", on=yes),
    event(
        "kill_source",
        resume=yes,
        before_the_put=yes,
        noticed=yes,
    ),
)
happenings = st.lists(st.one_of(streaming, *disturbances), max_size=16)
ENCODE = ImageCodec.encode
first_control_lost = [("miss_next", {"kind": Control})]
encoder_gone = [("stream", {"count": 9, "answered": True}), ("turn_encoder", {"on": False})]


@given(happenings, st.integers(0, 1))
@example(first_control_lost, 1)
@example(encoder_gone, 1)
@example(encoder_gone, 0)
@settings(max_examples=40, deadline=None, derandomize=True)
def test_the_state_is_that_of_an_undisturbed_stream(
    weights: Path,
    tmp_path_factory: pytest.TempPathFactory,
    happenings: list[tuple[str, dict]],
    control_size: int,
) -> None:
    world = World(tmp_path_factory.mktemp("world"), weights, control_size)

    def encode_while_it_can(codec: ImageCodec, *images: np.ndarray, **options: bool) -> np.ndarray:
        assert world.encodes
        return ENCODE(codec, *images, **options)

    with patch.object(ImageCodec, "encode", encode_while_it_can):
        for name, options in happenings:
            getattr(world, name)(**options)
        # A control that got lost unnoticed is asked for once it would be given up: nine frames on.
        world.stream(24, answered=True)
        world.settle()
    record = unseal(world.service.snapshot()[0][NAME])
    np.testing.assert_equal(record, undisturbed(weights, world.put, CHOICES)[NAME])
    world.log.close()
