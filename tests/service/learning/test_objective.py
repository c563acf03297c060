"""The loss in the paper's regimes, in a world whose code is the brightness of the picture."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import nn

from koop_service.encoding.autoencoder import initialised
from koop_service.learning.dynamics import Dynamics, Sizes
from koop_service.learning.hardware import choose
from koop_service.learning.objective import DynamicsLoss, Loss, autoencoder_loss
from koop_service.learning.presets import RollOut
from koop_service.learning.windows import Batch, as_images

from .blobs import smoke

HARDWARE = choose("cpu", "float32")
FITTED = 40


class Brightness(nn.Module):
    """Encodes a picture as its mean, and decodes that as a picture of this brightness."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean((1, 2, 3))[:, None]

    def decode(self, codes: torch.Tensor) -> torch.Tensor:
        return codes[:, :, None, None].expand(-1, 1, 64, 64)


def swinging(frames: int, change_at: int, pace_then: float = 0.55) -> Batch:
    """Two windows whose brightness swings, at another pace from `change_at` on."""
    pace = np.where(np.arange(frames) < change_at, 0.5, pace_then)
    brightness = 0.5 + 0.4 * np.sin(np.cumsum(pace) + np.array([[0.0], [1.0]]))
    images = torch.from_numpy(np.rint(255 * brightness).astype(np.uint8))
    images = images[:, :, None, None].expand(-1, -1, 64, 64)
    inputs, starts = as_images(images.flatten(0, 1)), torch.zeros(2, dtype=torch.long)
    return Batch(inputs, images, torch.arange(2), starts, torch.zeros(2, frames - 1, 0))


def loss(roll: RollOut, batch: Batch, horizon: int, dynamics: Dynamics | None = None) -> Loss:
    world, preset = Brightness(), smoke(history=2, predicted=4096)
    dynamics = dynamics or Dynamics("fitted", Sizes(1, 2, 0), roll.rho, 2)
    head = nn.Sequential(world)
    objective = DynamicsLoss(head, world, dynamics, preset, roll, HARDWARE)  # pyright: ignore
    return objective(batch, FITTED, horizon, np.random.default_rng(0))


def constant(*row: float) -> Dynamics:
    """Dynamics of one code that are the same whatever is measured."""
    dynamics = Dynamics("learned-A", Sizes(1, 2, 0), 1e-4, 2)
    with torch.no_grad():
        dynamics.matrix.copy_(torch.tensor([row]))
    return dynamics


def test_a_linear_world_is_predicted_and_its_fit_leaves_no_residual():
    roll = RollOut(fit_frames=(FITTED, FITTED), horizon=30, rho=1e-8)
    found = loss(roll, swinging(FITTED + 30, change_at=1000), 30)
    assert found.prediction < 0.02
    assert found.codes < 0.02
    assert found.reconstruction < 1e-6
    assert found.frames == 2 * (FITTED + 30)


def test_updates_follow_a_world_that_changes():
    batch = swinging(FITTED + 90, change_at=FITTED + 2)
    roll = RollOut(fit_frames=(FITTED, FITTED), horizon=90, rho=1e-4)
    offline = loss(roll, batch, 90)
    partial = loss(dataclasses.replace(roll, horizon=15, restarts=6, refit=True), batch, 15)
    full = loss(dataclasses.replace(roll, horizon=1, restarts=90, refit=True), batch, 1)
    assert full.prediction < 0.5 * partial.prediction
    assert partial.prediction < 0.7 * offline.prediction


def test_each_restart_of_an_update_has_its_own_fit():
    batch = swinging(FITTED + 90, change_at=FITTED + 2, pace_then=0.9)
    roll = RollOut((FITTED, FITTED), horizon=1, rho=1e-6, restarts=90, refit=True)
    turn = 2 * np.cos(0.5)  # z_{t+1} = turn z_t - z_{t-1}, about the mean brightness
    as_before = constant(-1.0, turn, 0.5 * (2 - turn))
    before = loss(roll, swinging(FITTED + 90, change_at=1000), 1, as_before)
    assert before.prediction < 0.01
    assert loss(roll, batch, 1).prediction < 0.7 * loss(roll, batch, 1, as_before).prediction


def test_restarts_lower_the_error_where_the_fit_is_wrong():
    batch = swinging(FITTED + 60, change_at=FITTED + 2)
    roll = RollOut((FITTED, FITTED), horizon=60, rho=1e-4, beyond=60)
    shot = dataclasses.replace(roll, horizon=5, restarts=20)
    assert loss(shot, batch, 5).prediction < 0.7 * loss(roll, batch, 60).prediction


def test_a_diverged_prediction_counts_no_more_than_logarithmically():
    batch = swinging(FITTED + 90, change_at=1000)
    roll = RollOut((FITTED, FITTED), horizon=90, rho=1e-4)
    assert 0 < float(loss(roll, batch, 90, constant(0.0, 1.2, 0.0)).total.detach()) < 10


def test_the_autoencoders_loss_is_the_mean_square():
    model, images = initialised(8, 0).eval(), torch.rand(3, 1, 64, 64)
    found = autoencoder_loss(model, images, HARDWARE)
    expected = ((model.decode(model.encode(images)) - images) ** 2).mean()
    torch.testing.assert_close(found.total, expected)
    assert found.reconstruction == pytest.approx(float(expected.detach()) ** 0.5)
