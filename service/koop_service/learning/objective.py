"""The training losses: eq. 12 and 17 in the paper's regimes, and with restarts.

The model is fitted on a window's first frames and rolled out from its end, or from several measured
histories: long open-loop roll-outs of a plant that is unstable without its controller explode. A
robust consistency term in code space reaches every predicted step; a random part of them is
decoded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from koop_service.encoding.autoencoder import Autoencoder
from koop_service.learning.dynamics import Dynamics
from koop_service.learning.fit import regressors, roll_out
from koop_service.learning.hardware import Hardware
from koop_service.learning.presets import Preset, RollOut
from koop_service.learning.windows import Batch


@dataclass(frozen=True, eq=False)
class Loss:
    """`total` is minimised. `reconstruction` and `prediction` are RMSE a pixel (robust by picture).

    `codes` is the residual of the fit, ||z_{t+1} - Theta w_t|| over the codes' spread (the paper's
    figure 17). `frames` went through the network; `horizon` of them were predicted in a row.
    """

    total: Tensor
    frames: int
    reconstruction: float
    prediction: float = float("nan")
    codes: float = float("nan")
    horizon: int = 0


def autoencoder_loss(model: Autoencoder, images: Tensor, hardware: Hardware) -> Loss:
    """Mean squared error a pixel of images (B, C, H, W) encoded and decoded."""
    codes = encoded(model.encoder, images, hardware)
    with hardware.autocast():
        decoded = model.decode(codes)
    error = ((decoded.float() - images) ** 2).mean()
    return Loss(error, len(images), float(error.detach().sqrt()))


def encoded(blocks: nn.Sequential, inputs: Tensor, hardware: Hardware) -> Tensor:
    """Codes (B, n) float32 of what the encoder's last `blocks` see.

    The last block is float32 in mixed precision too: rounded codes make the fit worse (a code error
    of 0.4% of the spread raised that of predictions by a third at 100 steps).
    """
    with hardware.autocast():
        features = blocks[:-1](inputs)
    return blocks[-1](features.float()).flatten(1)


@dataclass(frozen=True, eq=False)
class DynamicsLoss:
    """Reconstruction, decoded prediction and code consistency. `head` encodes a batch's inputs."""

    head: nn.Sequential
    model: Autoencoder
    dynamics: Dynamics
    preset: Preset
    roll: RollOut
    hardware: Hardware

    def __call__(self, batch: Batch, fitted: int, horizon: int, rng: np.random.Generator) -> Loss:
        """The loss of windows that are fitted on their first `fitted` frames."""
        codes = self.encode(batch)
        W, Y = regressors(codes, batch.controls, self.preset.history)
        known = fitted - self.preset.history
        theta = self.dynamics(W[:, :known], Y[:, :known])
        spread = codes.detach().flatten(0, 1).var(0).mean()
        predictions = [
            self._predict(theta, W, Y, codes, batch.controls, restarts, steps)
            for restarts, steps in self._restarts(codes.shape[:2], fitted, horizon, rng)
        ]
        relative = [((p.codes - _pick(codes, p.aims)) ** 2).mean(3) / spread for p in predictions]
        consistency = sum(torch.log1p(10 * r).mean() for r in relative) / (10 * len(relative))

        prediction, reconstruction = self._decoded(codes, predictions, batch, rng)
        residual = ((W[:, :known].double() @ theta.mT - Y[:, :known]) ** 2).mean() / spread
        return Loss(
            prediction + reconstruction + self.preset.consistency * consistency,
            codes.shape[0] * codes.shape[1],
            float(reconstruction.detach().sqrt()),
            float(prediction.detach().sqrt()),
            float(residual.detach().sqrt()),
            horizon,
        )

    def encode(self, batch: Batch) -> Tensor:
        """Codes (B, L, n) float32."""
        codes = encoded(self.head, batch.inputs, self.hardware)
        return codes.unflatten(0, batch.shape)

    def _restarts(
        self, shape: torch.Size, fitted: int, horizon: int, rng: np.random.Generator
    ) -> list[tuple[Tensor, int]]:
        """Frames (B, S) to start from and the steps to predict from them, longest first."""
        windows, length = shape
        count, device = self.roll.restarts, self.hardware.device
        if self.roll.refit:
            follow = np.tile(fitted - 1 + horizon * np.arange(count), (windows, 1))
            return [(torch.from_numpy(follow).to(device), horizon)]
        end = torch.full((windows, 1), fitted - 1, device=device)
        if count == 1:
            return [(end, horizon)]
        short = min(self.roll.short or horizon, horizon)
        others = rng.integers(self.preset.history - 1, length - short, (windows, count - 1))
        return [(end, horizon), (torch.from_numpy(others).to(device), short)]

    def _predict(
        self,
        theta: Tensor,
        W: Tensor,
        Y: Tensor,
        codes: Tensor,
        controls: Tensor,
        restarts: Tensor,
        horizon: int,
    ) -> _Predicted:
        """K = `horizon` codes from each of the frames `restarts` (B, S)."""
        h = self.preset.history
        thetas = theta[:, None]
        if self.roll.refit:  # restarts are the same in each window
            known = [int(restart) + 1 - h for restart in restarts[0]]
            thetas = torch.stack([self.dynamics(W[:, :k], Y[:, :k]) for k in known], dim=1)
        steps = torch.arange(horizon, device=restarts.device)
        back = torch.arange(1 - h, 1, device=restarts.device)
        history = _pick(codes, restarts[:, :, None] + back)
        future = _pick(controls, restarts[:, :, None] + steps)
        return _Predicted(roll_out(thetas, history, future), restarts[:, :, None] + 1 + steps)

    def _decoded(
        self,
        codes: Tensor,
        predictions: list[_Predicted],
        batch: Batch,
        rng: np.random.Generator,
    ) -> tuple[Tensor, Tensor]:
        """Squared pixel errors of random predicted codes and of random codes, robust by picture.

        A diverged code decodes to anything; its error counts no more than logarithmically beyond
        the pictures' own variance, or one of them would drown a whole batch.
        """
        windows, length = batch.shape
        share = self.preset.predicted // len(predictions)
        ahead = [p.sample(length, share, rng) for p in predictions]
        known = _choose(windows * length, self.preset.reconstructed, rng).to(codes.device)
        inputs = torch.cat([*(chosen for chosen, _ in ahead), codes.flatten(0, 1)[known]])
        frames = torch.cat([*(aims for _, aims in ahead), known])
        truth = batch.images(frames).to(codes.device)
        with self.hardware.autocast():
            decoded = self.model.decode(inputs)
        error = ((decoded.float() - truth) ** 2).mean((1, 2, 3))
        scale = truth.var()
        robust = scale * torch.log1p(error / scale)
        return robust[: -len(known)].mean(), robust[-len(known) :].mean()


@dataclass(frozen=True, eq=False)
class _Predicted:
    """`codes` (B, S, K, n) and the frames `aims` (B, S, K) of the windows that they predict."""

    codes: Tensor
    aims: Tensor

    def sample(self, length: int, count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """`count` random codes, near steps rather than far ones where several restarts compete,
        and the frames that they predict, counted through all windows of `length` frames."""
        windows, restarts, steps = self.aims.shape
        weights = 1 / np.arange(1, steps + 1) if restarts > 1 else np.ones(steps)
        chosen = _choose(self.aims.numel(), count, rng, np.tile(weights, windows * restarts))
        chosen = chosen.to(self.aims.device)
        window = torch.arange(windows, device=self.aims.device)[:, None, None]
        frames = self.aims + length * window
        return self.codes.flatten(0, 2)[chosen], frames.flatten()[chosen]


def _choose(
    total: int, count: int, rng: np.random.Generator, weights: np.ndarray | None = None
) -> Tensor:
    """At most `count` different numbers below `total`."""
    share = None if weights is None else weights / weights.sum()
    return torch.from_numpy(rng.choice(total, min(count, total), False, share))


def _pick(sequence: Tensor, index: Tensor) -> Tensor:
    """sequence (B, T, c) at index (B, S, K): (B, S, K, c)."""
    rows = torch.arange(len(sequence), device=sequence.device)
    return sequence[rows[:, None, None], index]
