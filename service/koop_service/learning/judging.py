"""What a trained model is given to work with, by what it does on trajectories it has never seen."""

from __future__ import annotations

import dataclasses

from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard
from koop_service.estimation.settings import Rows
from koop_service.learning.bands import band_scale
from koop_service.learning.evaluation import encode_all, evaluate, select
from koop_service.learning.pooled import plain_rows, pooled_theta
from koop_service.learning.recording import Recording
from koop_service.learning.train import Training


def judged(codec: ImageCodec, unseen: Recording, mean: Rows) -> ModelCard:
    """The codec's card with the best estimator settings, calibrated, and figures, on `unseen`.

    The prior's mean is zero or `mean`.
    """
    trajectories = encode_all(codec, unseen)
    chosen = select(trajectories, codec.card.estimator, mean)
    chosen = dataclasses.replace(chosen, band_scale=band_scale(trajectories, chosen))
    figures = dataclasses.asdict(evaluate(codec, trajectories, chosen))
    return dataclasses.replace(codec.card, estimator=chosen, figures=figures)


def prior_mean(training: Training, codec: ImageCodec, seen: Recording) -> Rows:
    """What was learned with the network, or else afterwards."""
    learned = training.dynamics.matrix
    if learned is None or not learned.any():  # no step was taken
        return pooled_theta(codec, seen)
    return plain_rows(learned)
