"""The training loop over two stages: the autoencoder alone, then together with the dynamics.

Every random draw of a step comes from a generator seeded by the step, and rates and horizons are
functions of the step, so a `Training` is all that there is to remember.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn

from koop_service.encoding.autoencoder import Autoencoder, initialised
from koop_service.learning.dynamics import Dynamics, Sizes
from koop_service.learning.fit import regressors
from koop_service.learning.hardware import Hardware
from koop_service.learning.objective import DynamicsLoss, Loss, autoencoder_loss
from koop_service.learning.parallel import Group
from koop_service.learning.presets import Preset, Stage
from koop_service.learning.recording import Recording
from koop_service.learning.schedule import drawn_horizon, growing_horizon, learning_rate
from koop_service.learning.windows import Windows, as_images, held_frames, random_frames

STAGES = ("autoencoder", "dynamics")
_PATIENCE = 20  # steps in a row whose gradient is not finite, before training gives up


@dataclass(eq=False)
class Training:
    """How far a training has come: `step` steps of STAGES[stage] are done.

    `moments` is what Adam keeps, by parameter; `frames` went through the network in `seconds` [s].
    """

    model: Autoencoder
    dynamics: Dynamics
    stage: int = 0
    step: int = 0
    frames: int = 0
    seconds: float = 0.0
    moments: dict[int, dict[str, Tensor]] = field(default_factory=dict)

    @property
    def stage_name(self) -> str:
        return STAGES[min(self.stage, len(STAGES) - 1)]


@dataclass(frozen=True, eq=False)
class Setting:
    """What does not change in a training; `tell` is for what a user should know."""

    recording: Recording
    preset: Preset
    seed: int
    hardware: Hardware
    group: Group = field(default_factory=Group)
    tell: Callable[[str], None] = print

    def stage(self, index: int) -> Stage:
        return (self.preset.autoencoder, self.preset.dynamics)[index]

    def generator(self, stage: int, step: int) -> np.random.Generator:
        """The random numbers of one step in this process."""
        return np.random.default_rng([self.seed, stage, step, self.group.rank])


@dataclass(frozen=True, eq=False)
class _Task:
    """One stage at work: `averaged` tensors are kept equal in all processes beside gradients."""

    parameters: list[nn.Parameter]
    averaged: list[Tensor]
    loss: Callable[[int, np.random.Generator], Loss]


@dataclass(frozen=True, eq=False)
class Warm:
    """Weights to go on from, with what their dynamics learned, if anything: (n, d) or (n, p)."""

    model: Autoencoder
    matrix: Tensor | None = None


def begin(setting: Setting, dynamics: str, warm: Warm | None = None) -> Training:
    """A training that has done nothing yet; it starts at the second stage from `warm` weights.

    A fresh autoencoder's output is matched to the channels' means and spreads.
    """
    preset, recording = setting.preset, setting.recording
    model = _fresh(setting) if warm is None else warm.model
    model.to(setting.hardware.device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    controls = recording.controls.shape[2]
    sizes = Sizes(model.code_size, preset.history, controls)
    roll = preset.roll_out(controls)
    fit = Dynamics(dynamics, sizes, roll.rho, preset.refinements, roll.around_mean)
    setting.group.agree(list(model.state_dict().values()))
    done = warm is not None and not preset.autoencoder.steps
    if warm is not None and done:
        fit.go_on_from(warm.matrix)
    return Training(model, fit.to(setting.hardware.device), stage=int(done))


def _fresh(setting: Setting) -> Autoencoder:
    preset, recording = setting.preset, setting.recording
    shape = recording.image_shape
    model = initialised(preset.code_size, setting.seed, shape, preset.architecture)
    some = recording.frames[:: max(1, len(recording.frames) // 64), ::10]
    images = as_images(torch.from_numpy(some).flatten(0, 1))
    model.match_output_scale(images.mean((0, 2, 3)), images.std((0, 2, 3), unbiased=False))
    return model


def advance(training: Training, setting: Setting) -> Iterator[Loss]:
    """Train on from where `training` stands, and change it; yields after each step.

    Raises ValueError where the loss stays not finite.
    """
    for stage in range(training.stage, len(STAGES)):
        training.stage = stage
        if setting.stage(stage).steps > training.step:
            yield from _advance_stage(training, setting)
        training.step, training.moments = 0, {}
    training.stage = len(STAGES)
    training.model.eval()


def _advance_stage(training: Training, setting: Setting) -> Iterator[Loss]:
    stage = setting.stage(training.stage)
    task = (_autoencoder, _dynamics)[training.stage](training, setting)
    optimiser = _optimiser(training, task.parameters)
    fruitless, began = 0, time.monotonic() - training.seconds
    while training.step < stage.steps:
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(stage, training.step)
        loss = task.loss(training.step, setting.generator(training.stage, training.step))
        moved = _descend(optimiser, task, loss.total, stage.clip, setting.group)
        fruitless = 0 if moved else fruitless + 1
        if fruitless >= _PATIENCE:
            raise ValueError(_diverged(training))
        training.step += 1
        training.frames += loss.frames * setting.group.size
        training.seconds = time.monotonic() - began
        training.moments = optimiser.state_dict()["state"]
        yield loss


def _autoencoder(training: Training, setting: Setting) -> _Task:
    """The autoencoder alone: a prediction loss too early collapses to the mean picture."""
    model, hardware = training.model, setting.hardware
    model.train()
    count = setting.group.share(setting.preset.autoencoder.batch)
    frames = held_frames(setting.recording, hardware)

    def loss(_: int, rng: np.random.Generator) -> Loss:
        images = random_frames(frames, count, rng).to(hardware.device)
        return autoencoder_loss(model, images, hardware)

    statistics = [buffer for buffer in model.buffers() if buffer.is_floating_point()]
    return _Task(list(model.parameters()), statistics, loss)


def _dynamics(training: Training, setting: Setting) -> _Task:
    """Autoencoder and prediction, the predicted horizon growing.

    BatchNorm uses its running statistics from here on, so that what is trained is what is served.
    """
    model, preset = training.model, setting.preset
    model.train()
    model.freeze_statistics()
    blocks = list(model.encoder)
    trunk = nn.Sequential(*blocks[: preset.frozen_blocks])
    head = nn.Sequential(*blocks[preset.frozen_blocks :])
    roll = preset.roll_out(setting.recording.controls.shape[2])
    windows = Windows(setting.recording, trunk, _memory(setting), setting.hardware, setting.seed)
    _announce(windows, setting)
    objective = DynamicsLoss(head, model, training.dynamics, preset, roll, setting.hardware)
    count = setting.group.share(preset.dynamics.batch)

    def loss(step: int, rng: np.random.Generator) -> Loss:
        windows.go_to(step * windows.parts // preset.dynamics.steps)
        horizon = drawn_horizon(growing_horizon(step, preset, roll), roll, rng)
        fitted = int(rng.integers(roll.fit_frames[0], roll.fit_frames[1] + 1))
        batch = windows.draw(count, fitted + roll.after(horizon), rng)
        return objective(batch, fitted, horizon, rng)

    if training.step == 0:
        _start_dynamics(training, setting, windows, objective)
    parameters = [*head.parameters(), *model.decoder.parameters(), *training.dynamics.parameters()]
    return _Task(parameters, [], loss)


def _memory(setting: Setting) -> float:
    """For the frozen blocks' outputs [bytes]: the preset's less the frames, or a GPU's own."""
    free = setting.hardware.free_memory()
    return free / 4 if free else setting.preset.memory - setting.recording.frames.nbytes


def _announce(windows: Windows, setting: Setting) -> None:
    """Say what the user waits for: about a minute for a thousand trajectories."""
    if not (setting.preset.frozen_blocks and setting.group.leads):
        return
    setting.tell(f"computing the frozen blocks' outputs of {len(windows.first)} trajectories")
    if windows.parts > 1:
        setting.tell(
            f"memory holds no more at a time; training goes through {windows.parts} such parts of "
            "the recording, one after the other"
        )


@torch.no_grad()
def _start_dynamics(
    training: Training, setting: Setting, windows: Windows, objective: DynamicsLoss
) -> None:
    """Start what the dynamics learn at the least squares of one batch, unless it was learned."""
    if not training.dynamics.is_blank:
        return
    windows.go_to(0)
    rng = np.random.default_rng([setting.seed, len(STAGES)])
    batch = windows.draw(8 * setting.preset.dynamics.batch, objective.roll.fit_frames[1], rng)
    codes = objective.encode(batch)
    training.dynamics.initialise(*regressors(codes, batch.controls, setting.preset.history))
    setting.group.agree(list(training.dynamics.parameters()))


def _optimiser(training: Training, parameters: list[nn.Parameter]) -> torch.optim.Adam:
    """Adam over `parameters`, going on with the training's moments."""
    optimiser = torch.optim.Adam(parameters)
    for index, moments in training.moments.items():
        parameter = parameters[index]
        # In the parameter's own memory layout: another one may round differently.
        optimiser.state[parameter] = {
            name: torch.empty_like(parameter).copy_(moment) if moment.dim() else moment
            for name, moment in moments.items()
        }
    return optimiser


def _descend(
    optimiser: torch.optim.Optimizer, task: _Task, total: Tensor, clip: float, group: Group
) -> bool:
    """One step down the averaged gradient; False where it is not finite, and nothing moved."""
    optimiser.zero_grad(set_to_none=True)
    total.backward()
    gradients = [p.grad for p in task.parameters if p.grad is not None]
    with torch.no_grad():
        group.average([*gradients, *task.averaged])
    norm = torch.nn.utils.clip_grad_norm_(task.parameters, clip)
    finite = bool(torch.isfinite(norm))
    if finite:
        optimiser.step()
    return finite


def _diverged(training: Training) -> str:
    return (
        f"the loss has not been finite for {_PATIENCE} steps (stage {training.stage_name}, step "
        f"{training.step}); try another --seed, fewer --steps of a shorter horizon (--regime "
        "partial), --precision float32, or look whether the recording's frames are sound"
    )
