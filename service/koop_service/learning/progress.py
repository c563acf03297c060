"""What a training tells while it runs: a bar with rate and time left, and a log."""

from __future__ import annotations

import math
import sys

from tqdm import tqdm

from koop_service.learning.objective import Loss
from koop_service.learning.schedule import growing_horizon, mean_horizon
from koop_service.learning.train import Setting, Training


def frames_in(setting: Setting, stage: int, first: int) -> float:
    """Frames that the steps of a stage from `first` on put through the network, about."""
    preset = setting.preset
    steps = range(first, setting.stage(stage).steps)
    if stage == 0:
        return len(steps) * preset.autoencoder.batch
    roll = preset.roll_out(setting.recording.controls.shape[2])
    fitted = sum(roll.fit_frames) / 2
    horizons = (mean_horizon(growing_horizon(step, preset, roll), roll) for step in steps)
    return preset.dynamics.batch * sum(fitted + roll.after(horizon) for horizon in horizons)


class Bar:
    """One bar a stage, in frames: a step's length grows with the horizon, a frame's hardly."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._bar: tqdm | None = None
        self._stage = -1
        self._interval = 0.5 if sys.stderr.isatty() else 15.0

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def __call__(self, training: Training, loss: Loss) -> None:
        """Show one more step."""
        if training.stage != self._stage:
            self._close()
            self._stage, self._bar = training.stage, self._open(training)
        assert self._bar is not None
        self._bar.set_postfix(_figures(training, loss), refresh=False)
        self._bar.update(loss.frames * self._setting.group.size)
        if training.step == self._setting.stage(training.stage).steps:
            self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _open(self, training: Training) -> tqdm:
        total = frames_in(self._setting, training.stage, training.step - 1)
        return tqdm(
            total=round(total),
            desc=training.stage_name,
            unit=" frames",
            unit_scale=True,
            mininterval=self._interval,
            maxinterval=self._interval,
        )


def _figures(training: Training, loss: Loss) -> dict[str, str | int]:
    shown: dict[str, str | int] = {"step": training.step}
    if loss.horizon:
        shown["K"] = loss.horizon
    for name in ("reconstruction", "prediction", "codes"):
        value = getattr(loss, name)
        if not math.isnan(value):
            shown[name] = f"{value:.4f}"
    return shown
