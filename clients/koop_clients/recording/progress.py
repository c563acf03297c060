"""What a recording tells while it goes on, on standard error, and at its end."""

from __future__ import annotations

import sys
import time
from collections import Counter
from typing import TextIO

from koop_clients.recording.recorder import Recorder

_INTERVAL = 5.0  # s


class Progress:
    """Lines for a person, one every few seconds."""

    def __init__(self, stream: TextIO = sys.stderr, interval: float = _INTERVAL) -> None:
        self.overflowed = 0
        self._stream = stream
        self._interval = interval
        self._unreadable: Counter[str] = Counter()
        self._start = self._last = time.monotonic()
        self._frames = 0

    def say(self, line: str) -> None:
        """Print a line at once."""
        print(line, file=self._stream, flush=True)

    def unreadable(self, key: str, problem: str) -> None:
        """Count what cannot be read, and explain it the first time for each key."""
        if key not in self._unreadable:
            self.say(f"ignored what came on {key}: {problem}")
        self._unreadable[key] += 1

    def show(self, recorder: Recorder, segments: int) -> None:
        """Say how it stands, if that was not said lately."""
        now = time.monotonic()
        elapsed = now - self._last
        if elapsed < self._interval:
            return
        rate = (recorder.frames - self._frames) / elapsed
        self._last, self._frames = now, recorder.frames
        self.say(self._state(recorder, segments, rate))

    def summary(self, recorder: Recorder, segments: int) -> str:
        """How it stood in the end."""
        elapsed = time.monotonic() - self._start
        rate = recorder.frames / elapsed if elapsed else 0.0
        return f"{recorder.frames} frames came; " + self._state(recorder, segments, rate)

    def _state(self, recorder: Recorder, segments: int, rate: float) -> str:
        sources = len(recorder.trajectories)
        return (
            f"{segments} segment{'s' * (segments != 1)} of {recorder.length} frames from {sources} "
            f"trajector{'y' if sources == 1 else 'ies'}, {rate:.1f} frames/s" + self._why(recorder)
        )

    def _why(self, recorder: Recorder) -> str:
        reasons = recorder.dropped
        reasons["unreadable"] += sum(self._unreadable.values())
        reasons["faster than they could be written"] += self.overflowed
        told = [f"{count} {why}" for why, count in reasons.most_common() if count]
        return f"; not kept: {', '.join(told)}" if told else ""
