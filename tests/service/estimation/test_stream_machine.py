"""The fold and its estimator against the simple model, through anything that may happen to them.

Frames and controls in any order, twice, late, lost, ahead, of new epochs and of old ones; snapshots
restored at any moment, also one of long ago whose messages since then come again. After each
message the transitions are the model's, and so is all that the stream knows, bit for bit. So is the
estimator, which here folds in batches, in a bank beside others, from one bank to the next; the
model's folds one transition after the other, alone.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from koop_service.estimation.estimator import Bank
from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import COUNTERS, Stream, Transition

from .stream_model import SimpleFold

N = 2  # numbers in a code
MEMORIES = ({}, {"forgetting": 0.9}, {"window": 5}, {"window": 7, "forgetting": 0.95})
NEIGHBOURS = 7  # enough for the bank to fold a whole block at once


@dataclass(frozen=True)
class Message:
    kind: str
    epoch: int
    seq: int

    @property
    def name(self) -> str:
        return f"{self.epoch:016x}"

    def values(self, size: int) -> np.ndarray:
        """The same numbers whenever it is sent."""
        seed = (self.kind == "frame", self.epoch, self.seq)
        return np.random.default_rng(seed).standard_normal(size)


@dataclass
class Saved:
    """Snapshots as they lie on a disk, and what was sent after them."""

    stream: dict[str, Any]
    lane: dict[str, Any]
    queue: list[Transition]
    since: list[Message]


class FoldMachine(RuleBasedStateMachine):
    """One trajectory: its stream, its lane of a bank, and the model of both."""

    @initialize(
        history=st.integers(1, 3),
        p=st.integers(0, 2),
        affine=st.booleans(),
        limit=st.integers(0, 4),
        memory=st.sampled_from(MEMORIES),
    )
    def begin(self, history: int, p: int, affine: bool, limit: int, memory: dict) -> None:
        self.sizes = EstimatorSettings(N, history, p, affine, **memory)
        self.stream = Stream(self.sizes, limit)
        self.model = SimpleFold(history, p, affine, limit)
        self.learned: list[Any] = []  # the model's transitions of this epoch
        self.queue: list[Transition] = []  # the stream's that are not in the bank yet
        self.epoch = 1
        self.sent: list[Message] = []
        self.saved: Saved | None = None
        self.bank = Bank(self.sizes)
        self.lane = self.bank.open()
        self.neighbours = [self.bank.open() for _ in range(NEIGHBOURS)]

    # What sources do

    @rule(count=st.integers(1, 12))
    def stream_on(self, count: int) -> None:
        """Frames in order, each with its control: what mostly happens."""
        for seq in range(self.model.next_seq, self.model.next_seq + count):
            self.send(Message("frame", self.epoch, seq))
            self.send(Message("control", self.epoch, seq))

    @rule(kind=st.sampled_from(["frame", "control"]), offset=st.integers(-12, 12))
    def send_near(self, kind: str, offset: int) -> None:
        self.send(Message(kind, self.epoch, max(0, self.model.next_seq + offset)))

    @rule(kind=st.sampled_from(["frame", "control"]), offset=st.sampled_from([30, 10**6, 2**50]))
    def send_far(self, kind: str, offset: int) -> None:
        self.send(Message(kind, self.epoch, self.model.next_seq + offset))

    @precondition(lambda self: self.sent)
    @rule(data=st.data(), count=st.integers(1, 6))
    def send_again(self, data: st.DataObject, count: int) -> None:
        """Some of the messages of this or any other epoch, in whatever order."""
        for message in data.draw(st.lists(st.sampled_from(self.sent), max_size=count)):
            self.send(message)

    @rule(count=st.sampled_from([1, 1, 1, 9]))
    def restart(self, count: int) -> None:
        """The source starts anew, perhaps again and again; nobody remembers more than eight."""
        for _ in range(count):
            self.epoch += 1
            self.send(Message("frame", self.epoch, 0))

    # What the service does

    @rule()
    def fold(self) -> None:
        """Give the bank what waits, together with its neighbours' measurements."""
        W = [transition.w for transition in self.queue]
        Y = [transition.y for transition in self.queue]
        lanes = [self.lane] * len(W)
        rng = np.random.default_rng(len(self.sent))
        for lane in self.neighbours:
            at = int(rng.integers(len(lanes) + 1))
            lanes.insert(at, lane)
            W.insert(at, rng.standard_normal(self.sizes.regressor_size))
            Y.insert(at, rng.standard_normal(N))
        self.bank.fold(np.array(lanes), np.array(W), np.array(Y))
        self.queue.clear()

    @rule()
    def restore(self) -> None:
        """Stop and start again: everything goes through its snapshot, into another bank."""
        self._restore(self.stream.snapshot(), self.bank.snapshot(self.lane))

    @rule()
    def save(self) -> None:
        stream, lane = self.stream.snapshot(), dict(self.bank.snapshot(self.lane))
        self.saved = copy.deepcopy(Saved(stream, lane, self.queue, []))

    @precondition(lambda self: self.saved is not None)
    @rule()
    def crash(self) -> None:
        """Back to what was saved; what came since then comes again, and gives the same."""
        saved = copy.deepcopy(self.saved)
        self._restore(saved.stream, saved.lane)
        self.queue = saved.queue
        for message in saved.since:
            self._take(message)

    def send(self, message: Message) -> None:
        """To the stream and to the model; their answers are the same."""
        if message.kind == "control" and self.sizes.control_size == 0:
            return
        self.sent.append(message)
        if self.saved is not None:
            self.saved.since.append(message)
        before, size = self.model.epoch, self._size(message)
        fold = self.model.fold_frame if message.kind == "frame" else self.model.fold_control
        expected = fold(message.name, message.seq, message.values(size))
        if self.model.epoch != before:
            self.learned = []
        self.learned += expected
        found = self._take(message)
        assert [t.seq for t in found] == [t.seq for t in expected]
        for one, other in zip(found, expected, strict=True):
            assert one.w.tobytes() == other.w.tobytes()
            assert one.y.tobytes() == other.y.tobytes()

    def _take(self, message: Message) -> list[Transition]:
        """Fold a message as a trajectory of the service does."""
        before, values = self.stream.epoch, message.values(self._size(message))
        fold = self.stream.fold_frame if message.kind == "frame" else self.stream.fold_control
        found = fold(message.name, message.seq, values)
        if before is not None and self.stream.epoch != before:
            self.queue.clear()
            self.bank.reset(self.lane)
        self.queue += found
        return found

    def _restore(self, stream: dict[str, Any], lane: dict[str, Any]) -> None:
        self.stream = Stream.restore(self.sizes, stream)
        self.bank = Bank(self.sizes)
        self.neighbours = [self.bank.open() for _ in range(NEIGHBOURS)]
        self.lane = self.bank.open()
        self.bank.restore(self.lane, lane)

    def _size(self, message: Message) -> int:
        return N if message.kind == "frame" else self.sizes.control_size

    # What must be true

    @invariant()
    def the_stream_knows_what_the_model_knows(self) -> None:
        stream, model = self.stream, self.model
        assert stream.counters == {name: model.counters[name] for name in COUNTERS}
        assert stream.epoch == model.epoch
        assert list(stream.retired) == model.retired[-8:]
        assert (stream.next_seq, stream.frames) == (model.next_seq, len(model.folded))
        assert (stream.missing, stream.replay_from) == (model.missing, model.replay_from)
        assert_same(stream.history, model.history)
        assert (stream.last_control is None) == (model.last_control is None)
        if stream.last_control is not None and model.last_control is not None:
            assert stream.last_control[0] == model.last_control[0]
            assert_same(stream.last_control[1], model.last_control[1])

    def teardown(self) -> None:
        """The estimator is the one that learned the same, one after the other and alone."""
        if not hasattr(self, "bank"):
            return
        self.fold()
        alone = Bank(self.sizes)
        lane = alone.open()
        for transition in self.learned:
            alone.fold(np.array([lane]), transition.w[None], transition.y[None])
        found, expected = self.bank.snapshot(self.lane), alone.snapshot(lane)
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            assert np.asarray(found[name]).tobytes() == np.asarray(value).tobytes(), name


def assert_same(one: np.ndarray | None, other: np.ndarray | None) -> None:
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        assert one.shape == other.shape
        assert one.tobytes() == other.tobytes()


TestFold = FoldMachine.TestCase
TestFold.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
