"""Schedules of training: every number that the lead of a training tunes stands here."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from koop_service.encoding.architecture import FLOW, PAPER, Architecture
from koop_service.learning.recording import Recording


@dataclass(frozen=True)
class Stage:
    """One stage: Adam steps on `batch` frames or windows each.

    `epochs`, where given, sets the steps: so many passes over the recording's trajectories. The
    rate falls by a cosine to a hundredth, or is halved `halvings` times at even intervals.
    Gradients are clipped to the norm `clip`.
    """

    steps: int
    batch: int
    rate: float
    clip: float
    epochs: int = 0
    halvings: int = 0

    def on(self, trajectories: int) -> Stage:
        """This stage with its steps counted out for a recording of so many trajectories."""
        if not self.epochs:
            return self
        return replace(self, steps=math.ceil(self.epochs * trajectories / self.batch), epochs=0)


@dataclass(frozen=True)
class RollOut:
    """How a window of frames is fitted and predicted.

    Fitted on its first frames, as many as drawn from `fit_frames` for the batch, with `rho`. Then
    `horizon` frames are predicted from the fit's end, and `short` frames from each of the other
    `restarts`, anywhere in the window, which has `beyond` frames or more after the fit.

    With `refit` the restarts, of `horizon` frames each, follow each other from the fit's end on,
    and each has a fit of its own to everything measured until then: the paper's partial (or, with
    horizon 1, full) updates.

    With `shortest`, each batch draws its horizon between that and `horizon`. Where
    `around_mean` is given, the prior of our own fit is centred on a Theta that is learned with the
    network, and weighs so much instead of `rho`.
    """

    fit_frames: tuple[int, int]
    horizon: int
    rho: float
    restarts: int = 1
    short: int = 0
    beyond: int = 0
    refit: bool = False
    shortest: int = 0
    around_mean: float = 0.0

    def after(self, horizon: int) -> int:
        """Frames of a window after the fit while `horizon` frames are predicted."""
        return max(self.beyond, horizon * (self.restarts if self.refit else 1))

    @property
    def longest(self) -> int:
        """Frames of the longest window."""
        return self.fit_frames[1] + self.after(self.horizon)


@dataclass(frozen=True)
class Preset:
    """One schedule: the autoencoder alone, then together with the dynamics.

    The predicted horizon grows to its end within the share `growth` of the dynamics' steps.
    `predicted` and `reconstructed` frames of a batch are decoded. The first `frozen_blocks` encoder
    blocks are not trained with the dynamics: their outputs are computed once and kept, as many as
    fit `memory` [bytes] together with the frames.

    The share `held_out` is never trained on: the last trajectories or, where `segment` is given,
    sequences of so many frames out of every trajectory.
    """

    autoencoder: Stage
    dynamics: Stage
    free: RollOut
    actuated: RollOut
    growth: float = 0.5
    predicted: int = 256
    reconstructed: int = 96
    consistency: float = 0.02
    refinements: int = 2
    history: int = 2
    code_size: int = 8
    frozen_blocks: int = 3
    memory: float = 2.9e9
    architecture: Architecture = PAPER
    held_out: float = 0.04
    segment: int = 0

    def split(self, recording: Recording) -> tuple[Recording, Recording]:
        """(seen, unseen)."""
        if self.segment:
            return recording.split_in_time(self.held_out, self.segment)
        return recording.split(self.held_out)

    def sequences(self, recording: Recording) -> Recording:
        """All of `recording`, in sequences as long as those that `split` holds out."""
        return recording.cut(self.segment) if self.segment else recording

    def roll_out(self, controls: int) -> RollOut:
        """The roll-out for a recording with so many controls."""
        return self.actuated if controls else self.free

    def on(self, recording: Recording) -> Preset:
        """This preset with its steps counted out for `recording`."""
        count = len(recording.frames)
        return replace(
            self, autoencoder=self.autoencoder.on(count), dynamics=self.dynamics.on(count)
        )


_CPU = Preset(
    autoencoder=Stage(2000, batch=128, rate=3e-3, clip=1.0),
    dynamics=Stage(3000, batch=8, rate=1e-3, clip=0.1),
    free=RollOut(fit_frames=(60, 98), horizon=100, rho=1e-4, restarts=9, short=15),
    # A plant that is unstable without its controller: long open-loop roll-outs explode.
    actuated=RollOut(fit_frames=(60, 98), horizon=20, rho=1e-3, restarts=9, short=15, beyond=40),
)

# Windows of all the lengths that are judged; a fit of more numbers than it has frames needs to know
# what all trajectories have in common.
_LONG = {"fit_frames": (16, 40), "shortest": 8, "horizon": 100}
_FORCED = RollOut(**_LONG, rho=1e-2, around_mean=1.0, restarts=5, short=4, beyond=16)

# Windows of 32 frames, 16 to fit and 16 to predict, batches of 16, 1e-3 (section A.3). A field is a
# whole state, which pictures are not: one frame of history will do.
_FLOW = replace(
    _CPU,
    autoencoder=Stage(3000, batch=16, rate=3e-3, clip=1.0),
    dynamics=Stage(2000, batch=16, rate=1e-3, clip=0.1),
    free=RollOut(fit_frames=(16, 16), horizon=16, rho=1e-3, restarts=5, short=4, beyond=16),
    actuated=_FORCED,
    predicted=24,
    reconstructed=8,
    history=1,
    frozen_blocks=4,
    architecture=FLOW,
    held_out=0.12,
    segment=128,
)

PRESETS = {
    "cpu": _CPU,
    # Batches of 16, 200 epochs, 1e-3 halved every 20 epochs, everything trained (section A.2).
    "paper": replace(
        _CPU,
        autoencoder=Stage(4000, batch=256, rate=3e-3, clip=1.0),
        dynamics=Stage(0, batch=16, rate=1e-3, clip=0.1, epochs=200, halvings=10),
        free=RollOut(fit_frames=(40, 60), horizon=40, rho=1e-4, restarts=9, short=15),
        actuated=RollOut(
            fit_frames=(80, 100), horizon=20, rho=1e-3, restarts=9, short=15, beyond=100
        ),
        growth=0.2,
        predicted=640,
        reconstructed=320,
        frozen_blocks=0,
    ),
    "flow": _FLOW,
    "flow-gpu": replace(
        _FLOW,
        autoencoder=Stage(8000, batch=64, rate=3e-3, clip=1.0),
        dynamics=Stage(4750, batch=64, rate=1e-3, clip=0.1),
        free=replace(_FLOW.free, **_LONG),
        predicted=96,
        reconstructed=32,
    ),
    "smoke": replace(
        _CPU,
        autoencoder=Stage(20, batch=16, rate=3e-3, clip=1.0),
        dynamics=Stage(6, batch=2, rate=1e-3, clip=0.1),
        free=RollOut(fit_frames=(40, 50), horizon=8, rho=1e-4, restarts=3, short=4),
        actuated=RollOut(fit_frames=(40, 50), horizon=4, rho=1e-3, restarts=4, short=4, beyond=8),
        predicted=16,
        reconstructed=16,
    ),
}

#: What follows the fit in each of the paper's regimes (3.2): restarts and horizon of 90 frames.
REGIMES = {"offline": (1, 90), "partial": (6, 15), "full": (90, 1)}


def with_regime(preset: Preset, regime: str) -> Preset:
    """`preset` with the roll-outs of one of the paper's regimes."""
    restarts, horizon = REGIMES[regime]
    after = {"restarts": restarts, "horizon": horizon, "short": 0, "beyond": 0}
    after["refit"] = regime != "offline"
    return replace(
        preset, free=replace(preset.free, **after), actuated=replace(preset.actuated, **after)
    )
