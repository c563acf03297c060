"""The shell of a training: checkpoints, early looks, log, bar and signals around the loop."""

from __future__ import annotations

import dataclasses
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from koop_service.learning.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from koop_service.learning.log import Log
from koop_service.learning.look import Forecast, forecast, save_strip
from koop_service.learning.objective import Loss
from koop_service.learning.progress import Bar
from koop_service.learning.recording import Recording
from koop_service.learning.train import Setting, Training, advance

_LOOKED_AT = 4  # trajectories of an early look


@dataclass(frozen=True)
class Files:
    """What a training writes: weights, and beside them a checkpoint, a log and a strip."""

    out: Path

    @property
    def checkpoint(self) -> Path:
        return checkpoint_path(self.out)

    @property
    def log(self) -> Path:
        return self.out.with_suffix(".csv")

    @property
    def strip(self) -> Path:
        return self.out.with_suffix(".png")


class InterruptedTrainingError(Exception):
    """A signal stopped the training; its checkpoint is written."""

    def __init__(self, number: int, training: Training) -> None:
        super().__init__(number)
        self.number, self._training = number, training

    def __str__(self) -> str:
        at = self._training
        return f"stopped at step {at.step} of stage {at.stage_name}; the same command goes on there"


@dataclass(eq=False)
class Session:
    """One training, watched.

    `identity` is what a checkpoint must have been begun with to fit. Every `every` seconds there is
    a checkpoint and an early look at the `unseen` trajectories.
    """

    training: Training
    setting: Setting
    files: Files
    identity: Mapping[str, object]
    unseen: Recording
    every: float
    notes: set[str] = field(default_factory=set)

    def resume(self, fresh: bool) -> None:
        """Go on from the checkpoint, if there is one and it is not to be forgotten."""
        path, group = self.files.checkpoint, self.setting.group
        found = path.exists() and not fresh
        if group.any(found) and not found:
            raise ValueError(f"{path} must be on a file system that all processes see")
        if found:
            load_checkpoint(path, self.training, self.identity)
            if group.leads:
                at = self.training
                say(f"going on from {path}: stage {at.stage_name}, step {at.step}")

    def run(self) -> None:
        """Train to the end. Raises InterruptedTrainingError after SIGINT or SIGTERM."""
        leads = self.setting.group.leads
        due = time.monotonic() + self.every
        with self._watchers() as watchers, _signals() as received:
            for loss in advance(self.training, self.setting):
                for watch in watchers:
                    watch(self.training, loss)
                stop = self.setting.group.any(bool(received))
                if leads and (stop or time.monotonic() > due):
                    self.keep()
                    due = time.monotonic() + self.every
                if stop:
                    raise InterruptedTrainingError(received[0] if received else 15, self.training)
        if leads:
            self.keep()

    def keep(self) -> None:
        """Write the checkpoint, and in the second stage a strip of what is predicted by now."""
        save_checkpoint(self.files.checkpoint, self.training, self.identity)
        if self.training.stage > 0:
            self.look(_LOOKED_AT)

    def look(self, count: int) -> Forecast:
        """The prediction of the first `count` unseen trajectories; draws the strip."""
        some = dataclasses.replace(
            self.unseen, frames=self.unseen.frames[:count], controls=self.unseen.controls[:count]
        )
        roll = self.setting.preset.roll_out(some.controls.shape[2])
        view = forecast(self.training, some, roll.fit_frames[1])
        title = f"{self.files.out.stem}: {self.training.stage_name}, step {self.training.step}"
        if not save_strip(self.files.strip, view, title):
            self._note("no prediction strip: pip install matplotlib")
        return view

    @contextmanager
    def _watchers(self) -> Iterator[list[Callable[[Training, Loss], None]]]:
        """What the leader shows and logs of each step."""
        if not self.setting.group.leads:
            yield []
            return
        with Bar(self.setting) as bar:
            yield [bar, Log(self.files.log, self.setting, self.training)]

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.add(text)
            say(text)


def say(text: str) -> None:
    """Tell the user, above the bar."""
    tqdm.write(f"koop-train: {text}", file=sys.stderr)


@contextmanager
def _signals() -> Iterator[list[int]]:
    """The stop signals received; a second one acts at once, as it would without this."""
    received: list[int] = []
    previous = {}

    def note(number: int, _: object) -> None:
        received.append(number)
        signal.signal(number, previous[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        previous[number] = signal.signal(number, note)
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
