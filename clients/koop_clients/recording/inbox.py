"""What arrives over Zenoh, on its way to the recorder."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

import zenoh

_FRAME_ROOT = "koop/frame/"
_LARGEST = 256 << 20  # bytes that may wait


class Arrival(NamedTuple):
    """One put: its key, its bytes, and when it came [s] on a clock that never jumps."""

    key: str
    data: bytes
    time: float


class Inbox:
    """A queue between Zenoh's threads and the recorder.

    Where it is full, the newest is dropped and counted, and nobody is held back: somebody who
    records must not slow down the service and the sources.
    """

    def __init__(self, largest: int = _LARGEST) -> None:
        self.overflowed = 0
        self._largest = largest
        self._bytes = 0
        self._arrivals: deque[Arrival] = deque()
        self._changed = threading.Condition()

    def put(self, key: str, data: bytes) -> None:
        """Add what came; never waits."""
        arrival = Arrival(key, data, time.monotonic())
        with self._changed:
            if self._bytes + len(data) > self._largest:
                self.overflowed += 1
                return
            self._bytes += len(data)
            self._arrivals.append(arrival)
            self._changed.notify()

    def take(self, timeout: float) -> Arrival | None:
        """The oldest, or None if nothing comes within `timeout` [s]."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._arrivals, timeout):
                return None
            arrival = self._arrivals.popleft()
            self._bytes -= len(arrival.data)
            return arrival


def control_expression(key: str) -> str:
    """The key expression of the controls that belong to the frames of `key`.

    Raises ValueError for one that is not about frames.
    """
    try:
        zenoh.KeyExpr(key)
    except zenoh.ZError:
        valid = False
    else:
        valid = key.startswith(_FRAME_ROOT)
    if not valid:
        raise ValueError(
            f"{key!r} is no key of frames; expected one like 'koop/frame/**' (all), "
            "'koop/frame/*/cartpole/**' or 'koop/frame/*/line3/robot7'"
        )
    return "koop/control/" + key.removeprefix(_FRAME_ROOT)


@contextmanager
def subscribed(session: zenoh.Session, key: str, inbox: Inbox) -> Iterator[None]:
    """Frames under `key` and their controls go to the inbox, in their order on each link."""

    def arrive(sample: zenoh.Sample) -> None:
        inbox.put(str(sample.key_expr), sample.payload.to_bytes())

    with ExitStack() as stack:
        for expression in (key, control_expression(key)):
            callback = zenoh.handlers.Callback(arrive, indirect=False)  # in the link's own thread
            stack.enter_context(session.declare_subscriber(expression, callback))
        yield


def open_hub(listen: str) -> zenoh.Session:
    """A session that sources connect to, where no service or router runs.

    Raises ValueError if it cannot listen there.
    """
    config = zenoh.Config()
    values = {
        "mode": "router",
        "listen/endpoints": [listen],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
    }
    try:
        for path, value in values.items():
            config.insert_json5(path, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ValueError(
            f"cannot listen on {listen!r}; where a service or router runs already, record from it "
            f"with --connect {listen} ({str(error).split(' at /')[0]})"
        ) from error
