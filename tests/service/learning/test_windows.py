"""Random windows: what is held of the frozen blocks is what they compute."""

import numpy as np
import pytest
import torch
from torch import nn

from koop_service.encoding.autoencoder import initialised
from koop_service.learning.hardware import choose
from koop_service.learning.windows import Batch, Windows, as_images

HARDWARE = choose("cpu", "float32")
TRAJECTORY = 70 * 64 * 8 * 8 * 2  # bytes of one trajectory's outputs


def trunk(blocks: int = 3) -> nn.Sequential:
    model = initialised(8, 0).eval()
    return nn.Sequential(*list(model.encoder)[:blocks])


def windows(recording, blocks: int, trajectories: float = 10) -> Windows:
    return Windows(recording, trunk(blocks), trajectories * TRAJECTORY, HARDWARE, seed=0)


def everything(batch: Batch) -> torch.Tensor:
    return batch.images(torch.arange(batch.shape[0] * batch.shape[1]))


def test_windows_are_stretches_of_the_recording(recording):
    source = windows(recording, blocks=0)
    batch = source.draw(4, 20, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    which, starts = rng.integers(3, size=4), rng.integers(70 - 20 + 1, size=4)
    for i, (trajectory, start) in enumerate(zip(which, starts, strict=True)):
        expected = recording.frames[trajectory, start : start + 20]
        found = batch.images(20 * i + torch.arange(20))
        torch.testing.assert_close(found, as_images(torch.from_numpy(expected)))
        pushed = recording.controls[trajectory, start : start + 19]
        np.testing.assert_allclose(batch.controls[i].numpy(), pushed, rtol=1e-6)
    torch.testing.assert_close(batch.inputs, everything(batch))


def test_the_frozen_blocks_outputs_are_held(recording):
    source = windows(recording, blocks=3)
    source.go_to(0)
    batch = source.draw(2, 20, np.random.default_rng(1))
    with torch.no_grad():
        expected = trunk()(everything(batch))
    torch.testing.assert_close(batch.inputs, expected, atol=1e-2, rtol=1e-2)


def test_little_memory_deals_the_trajectories_into_parts(recording):
    source = windows(recording, blocks=3, trajectories=2.5)
    assert source.parts == 2
    seen = []
    for part in range(source.parts):
        source.go_to(part)
        seen += list(source.held)
        batch = source.draw(3, 30, np.random.default_rng(part))
        with torch.no_grad():
            expected = trunk()(everything(batch))
        torch.testing.assert_close(batch.inputs, expected, atol=1e-2, rtol=1e-2)
    assert sorted(seen) == [0, 1, 2]


def test_no_memory_for_a_single_trajectory(recording):
    with pytest.raises(ValueError, match="too little for a trajectory"):
        windows(recording, blocks=3, trajectories=0.5)
