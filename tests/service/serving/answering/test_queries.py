"""Answers about one trajectory, without a network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from koop_protocol import ErrorCode, Frame, Limits, PredictQuery, ProtocolError, encode
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.weights import EstimatorDefaults, ModelCard, save_weights
from koop_service.prediction.uncertainty import calibrated
from koop_service.serving.answering import queries
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory

SCALE = (2.0, 0.5, 0.25, 4.0, 3.0)


def watched(folder: Path, scale: tuple[float, ...]) -> Trajectory:
    """A trajectory of 60 frames, seen through a model whose card has these factors."""
    path = folder / f"{len(scale)}.safetensors"
    card = ModelCard("test", "test", 0.05, estimator=EstimatorDefaults(band_scale=scale))
    save_weights(path, initialised(8, 0), card)
    catalogue = Catalogue([ModelEntry("test", path, ("*",))])
    registry = Registry(catalogue, EstimatorChoices(), Refusals(Metrics()), 1)
    codes = np.random.default_rng(0).normal(size=(60, 8))
    for seq, code in enumerate(codes):
        frame = Frame("cart/0", "0" * 16, seq, 0, np.zeros((64, 64), np.uint8), "test")
        trajectory = registry.admit(frame)
        trajectory.fold_frame(frame, code)
    registry.update_estimators([trajectory])
    return trajectory


@pytest.mark.parametrize("parts", ["std", "codes,std"])
def test_standard_deviations_are_scaled_as_the_card_says(tmp_path: Path, parts: str) -> None:
    query = PredictQuery(25, returns=frozenset(parts.split(",")))
    raw = queries.predict(watched(tmp_path, ()), query, Limits()).std
    scaled = queries.predict(watched(tmp_path, SCALE), query, Limits()).std
    assert raw is not None
    np.testing.assert_allclose(scaled, calibrated(raw, SCALE))
    assert not np.allclose(scaled, raw)


def test_frames_that_no_reply_can_hold_are_not_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trajectory, limits = watched(tmp_path, ()), Limits(max_message_bytes=50_000)
    parts = frozenset({"codes", "frames", "std"})
    with pytest.raises(ProtocolError) as caught:
        queries.predict(trajectory, PredictQuery(1000, returns=parts), limits)
    assert caught.value.code == ErrorCode.too_large
    most = int(caught.value.details["frames"])
    encode(queries.predict(trajectory, PredictQuery(most, returns=parts), limits), limits)
    assert most * 64 * 64 > 0.8 * limits.max_message_bytes
    monkeypatch.setattr(Trajectory, "show", None)
    with pytest.raises(ProtocolError, match=f"at most {most} in one reply"):
        queries.predict(trajectory, PredictQuery(most + 1, returns=parts), limits)
