"""Who takes part in a soak, each in a process of its own: sources, somebody spiteful, a driver.

Every role runs until it is told to stop, and then puts what it saw into the queue of results.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Event
from random import Random

import numpy as np
import zenoh
from load import ANSWER_TIMEOUT, PICTURES, RENDERER, ask, pictures
from nonsense import spoilt_put, spoilt_query

from koop_clients.connection import flush, open_session
from koop_clients.control import Controller
from koop_clients.queries import KoopError
from koop_clients.sources import FrameSource
from koop_protocol import COMMANDS, LqrEnd, LqrQuery, PredictQuery, decode, encode, predict_key

INTERVAL = 0.05  # s between two frames
HORIZON = 20
QUERY = encode(PredictQuery(HORIZON))


def names_of(count: int) -> list[str]:
    """Trajectories of the good sources."""
    return [f"benchmark/{i}" for i in range(count)]


@dataclass
class Answers:
    """Questions asked, and what came back: codes of errors, "" for an answer, and when."""

    asked: int = 0
    codes: Counter[str] = field(default_factory=Counter)
    latencies: list[tuple[float, float]] = field(default_factory=list)  # (time, latency) [s]

    def ask(
        self, session: zenoh.Session, selector: str, payload: bytes | None, since: float
    ) -> None:
        """Ask, and count the latency from `since` on."""
        self.asked += 1

        def answered(code: str) -> None:
            self.codes[code] += 1
            if not code:
                self.latencies.append((since, time.monotonic() - since))

        ask(session, selector, payload, answered)

    @property
    def unanswered(self) -> int:
        return self.asked - self.codes.total()

    def wait(self) -> None:
        """Until everything is answered, or will never be."""
        deadline = time.monotonic() + ANSWER_TIMEOUT
        while self.unanswered and time.monotonic() < deadline:
            time.sleep(0.05)


@dataclass
class Plant:
    """A source at 20 Hz that starts anew now and then, as cameras and their programs do."""

    session: zenoh.Session
    name: str
    images: np.ndarray
    life: float  # s on the average
    random: Random
    frames: int = 0
    starts: int = 0
    ends: float = 0.0
    source: FrameSource | None = None

    def step(self, answers: Answers) -> None:
        """A frame, its control, and a question that includes them."""
        now = time.monotonic()
        if self.source is None or now > self.ends:
            self._start(now)
        assert self.source is not None
        self.source.put_frame(self.images[self.frames % len(self.images)])
        self.source.put_control([self.random.uniform(-1.0, 1.0)])
        self.frames += 1
        answers.ask(self.session, predict_key(self.name), QUERY, now)

    def _start(self, now: float) -> None:
        if self.source is not None:
            self.source.close()
        self.source = FrameSource(self.session, self.name, 1, RENDERER)
        self.starts += 1
        self.ends = now + self.life * self.random.uniform(0.5, 1.5)


def stream(endpoint: str, count: int, life: float, stop: Event, results: Queue) -> None:
    """All good sources, evenly over the interval, each on a session of its own."""
    images, answers = pictures(PICTURES), Answers()
    with ExitStack() as stack:
        plants = [
            Plant(
                stack.enter_context(open_session(endpoint)),
                name,
                np.roll(images, 7 * i, 0),
                life,
                Random(i),
            )
            for i, name in enumerate(names_of(count))
        ]
        every(INTERVAL / count, stop, lambda step: plants[step % count].step(answers))
        answers.wait()
        for plant in plants:
            flush(plant.session)
    results.put(
        {
            "frames": {plant.name: plant.frames for plant in plants},
            "starts": sum(plant.starts for plant in plants),
            "answers": answers,
        }
    )


def spoil(endpoint: str, count: int, rate: float, stop: Event, results: Queue) -> None:
    """Spoilt puts under names of its own, and for every fifth of them a spoilt question."""
    random, answers, names = Random(0), Answers(), names_of(count)
    put = 0

    def step(number: int) -> None:
        nonlocal put
        key, payload = spoilt_put(f"benchmark/bad/{number % 5}", random)
        session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        put += 1
        if number % 5 == 0:
            selector, order = spoilt_query(random.choice(names), random)
            answers.ask(session, selector, order, time.monotonic())

    with open_session(endpoint) as session:
        every(1.0 / rate, stop, step)
        answers.wait()
        flush(session)
    results.put({"spoilt": put, "spoilt_answers": answers})


def drive(endpoint: str, count: int, hold: float, stop: Event, results: Queue) -> None:
    """A task on one trajectory after the other, each for a while; commands are counted."""
    commands: Counter[str] = Counter()
    bound = np.array([1.0])
    query = LqrQuery(5, target_code=np.zeros(8), u_min=-bound, u_max=bound, force=True)

    def take(sample: zenoh.Sample) -> None:
        ended = isinstance(decode(sample.payload.to_bytes()), LqrEnd)
        commands["ended" if ended else "commands"] += 1

    with (
        open_session(endpoint) as session,
        session.declare_subscriber(COMMANDS, zenoh.handlers.Callback(take, indirect=False)),
    ):
        names, turn = names_of(count), 0
        while not stop.is_set():
            try:
                with Controller(session, names[turn % count], query, timeout=ANSWER_TIMEOUT) as one:
                    one.begin()
                    commands["begun"] += 1
                    stop.wait(hold)
            except KoopError as error:  # it warms up again
                commands[error.code] += 1
                stop.wait(0.1)
            turn += 1
    results.put({"commands": commands})


def every(interval: float, stop: Event, work: Callable[[int], None]) -> None:
    """Work at a steady pace until told to stop; what was late is caught up."""
    start, step = time.monotonic(), 0
    while not stop.is_set():
        step += 1
        time.sleep(max(0.0, start + interval * step - time.monotonic()))
        work(step)
