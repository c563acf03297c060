"""What all trajectories have in common, as a prior: learned from them, and taken where it helps."""

import numpy as np
import pytest
import torch

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import EstimatorDefaults, ModelCard
from koop_service.learning import pooled
from koop_service.learning.evaluation import select
from koop_service.learning.fit import regressors
from koop_service.learning.streaming import Encoded

ALIKE = np.array([[0.9, -0.3, 0.0, 0.5], [0.3, 0.9, 0.1, 0.0], [0.0, 0.1, 0.6, 0.2]])


def plants(count: int, seed: int) -> list[Encoded]:
    """Short trajectories of plants that differ little, each code seen with an error of its own."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        theta, states = ALIKE + rng.normal(size=ALIKE.shape) * 0.01, [rng.normal(size=3)]
        while len(states) < 50:
            states.append(theta @ np.append(states[-1], 1.0))
        codes = np.array(states) + rng.normal(size=(50, 3)) * 0.05
        found.append(Encoded(np.zeros(0), codes, np.zeros((49, 0))))
    return found


@pytest.mark.parametrize("together", [250, 32])
def test_it_is_the_least_squares_of_all_trajectories(recording, monkeypatch, together) -> None:
    monkeypatch.setattr(pooled, "_TOGETHER", together)
    codec = ImageCodec(initialised(8, 0), ModelCard("blobs", "test", 0.05))
    theta = np.array(pooled.pooled_theta(codec, recording))
    codes = np.stack([codec.encode(frames) for frames in recording.frames])
    W, Y = regressors(torch.from_numpy(codes), torch.from_numpy(recording.controls), 2)
    W, Y = (part.flatten(0, 1).double().numpy() for part in (W, Y))
    left = W.T @ (Y - W @ theta.T)
    np.testing.assert_allclose(left, 0, atol=1e-6 * np.abs(W.T @ Y).max())


def test_of_many_trajectories_some_are_enough(recording, monkeypatch) -> None:
    codec = ImageCodec(initialised(8, 0), ModelCard("blobs", "test", 0.05))
    of_all = pooled.pooled_theta(codec, recording)
    monkeypatch.setattr(pooled, "_FRAMES", 150)
    assert pooled.pooled_theta(codec, recording) != of_all


def test_it_is_taken_where_it_helps() -> None:
    defaults, seen = EstimatorDefaults(history=1), plants(20, 0)
    alike, strange = (tuple(map(tuple, theta.tolist())) for theta in (ALIKE, 50 - ALIKE))
    assert select(seen, defaults, alike).prior_mean == alike
    assert select(seen, defaults, strange).prior_mean == ()
    assert select(seen, defaults).prior_mean == ()
