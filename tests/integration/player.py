"""A source with a log that plays the same pictures whenever it is started, from where it was.

    python -m integration.player ENDPOINT LOG NAME ...

A line on standard input ends the stream; the log is served until the process is killed.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator

from integration.loopback import RENDERER, control, picture

from koop_clients.connection import open_session
from koop_clients.replay.log import SourceLog
from koop_clients.sources import FrameSource
from koop_protocol import Control, Frame

PACE = 0.02  # s


def main(endpoint: str, path: str, names: list[str]) -> None:
    told = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.readline(), told.set()), daemon=True).start()
    with open_session(endpoint, wait=60.0) as session, SourceLog(path) as log:
        sources = [FrameSource(session, n, 1, RENDERER, log=log, resume=True) for n in names]
        seq = min(source.next_seq for source in sources)
        while not told.wait(PACE):
            for number, source in enumerate(sources):
                play(source, number, seq)
            seq += 1
        print(seq, flush=True)
        threading.Event().wait()


def play(source: FrameSource, number: int, seq: int) -> None:
    """Frame `seq` and the control after it, unless they were put before."""
    if source.awaits_control:
        source.put_control(control(number, source.next_seq - 1))
    if source.next_seq <= seq:
        source.put_frame(picture(number, seq))
        source.put_control(control(number, seq))


def played(name: str, epoch: str, number: int, frames: int) -> Iterator[Frame | Control]:
    """All that was put of the trajectory with this number on the command line."""
    for seq in range(frames):
        yield Frame(name, epoch, seq, 1, picture(number, seq), RENDERER)
        yield Control(name, epoch, seq, control(number, seq))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3:])
