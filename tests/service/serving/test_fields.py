"""Frames of several channels and floats of any size: what is let in, and how it is answered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from koop_protocol import (
    Control,
    ErrorCode,
    Frame,
    Limits,
    LqrQuery,
    PredictQuery,
    PredictReply,
    ProtocolError,
    decode,
    encode,
    frame_key,
)
from koop_service.encoding.architecture import Architecture
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.weights import ModelCard, save_weights
from koop_service.serving.admission.arrivals import Arrival
from koop_service.serving.answering import queries
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.measurements import Measurements
from koop_service.serving.rehearsal import rehearse
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.steering.aims import aim_of
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory

SHAPE, SMALL = (4, 16, 32), Architecture((8, 8), overlap=2)
CARD = ModelCard(
    "flow", "solver", 0.15, code_size=3, image_shape=SHAPE, value_range=(-9.0, 9.0),
    architecture=SMALL,
)  # fmt: skip


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    return registry_in(tmp_path)


def registry_in(folder: Path) -> Registry:
    path = folder / "flow.safetensors"
    save_weights(path, initialised(3, 0, SHAPE, SMALL), CARD)
    catalogue = Catalogue([ModelEntry("flow", path, ("*",))])
    return Registry(catalogue, EstimatorChoices(), Refusals(Metrics()), 1)


def field(seq: int, dtype: type = np.float16) -> np.ndarray:
    return np.random.default_rng(seq).normal(size=SHAPE).astype(dtype)


def frame(seq: int, image: np.ndarray) -> Frame:
    return Frame("wake/0", "0" * 16, seq, 1, image, "solver")


def no_log(question: object) -> None:
    raise AssertionError(f"{question}: this source has no log")


def streamed(registry: Registry, dtype: type = np.float16, count: int = 40) -> Trajectory:
    """Frames and controls as they come off the network."""
    messages: list[Frame | Control] = []
    for seq in range(count):
        u = np.array([np.sin(seq)])
        messages += [frame(seq, field(seq, dtype)), Control("wake/0", "0" * 16, seq, u)]
    key = frame_key("wake/0")
    arrivals = [
        Arrival(key if isinstance(m, Frame) else key.replace("frame", "control", 1), encode(m), i)
        for i, m in enumerate(messages)
    ]
    metrics = Metrics()
    refusals = Refusals(metrics)
    recovery = Recovery(registry, no_log, metrics, Limits(), 1)
    Measurements(registry, refusals, recovery, metrics, Limits(), lambda _: None).process(arrivals)
    assert refusals.last("wake/0") is None
    found = registry.find("wake/0")
    assert found is not None
    return found


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_fields_are_answered_in_the_streams_own_type(registry: Registry, dtype: type) -> None:
    trajectory = streamed(registry, dtype)
    assert trajectory.ready
    reply = queries.predict(
        trajectory, PredictQuery(5, returns=frozenset({"frames", "codes"})), Limits()
    )
    found = decode(encode(reply))
    assert isinstance(found, PredictReply)
    assert found.frames is not None
    assert reply.codes is not None
    assert (found.frames.shape, found.frames.dtype) == ((5, *SHAPE), dtype)
    shown = trajectory.codec.decode(reply.codes, dtype)
    np.testing.assert_array_equal(found.frames, shown)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=float))))


def test_half_precision_of_normalised_fields_is_harmless(tmp_path: Path) -> None:
    """Codes and predictions move no more than the rounding, a thousandth of what they span."""
    half, single = (streamed(registry_in(tmp_path), dtype) for dtype in (np.float16, np.float32))
    fields = np.stack([field(seq, np.float32) for seq in range(40)])
    rounded = fields.astype(np.float16).astype(np.float32)
    codes = single.codec.encode(fields)
    assert 0 < rms(single.codec.encode(rounded) - codes) < 1e-3 * rms(codes - codes.mean(axis=0))
    query = PredictQuery(20, returns=frozenset({"codes", "frames"}))
    found, exact = (queries.predict(trajectory, query, Limits()) for trajectory in (half, single))
    assert found.codes is not None
    assert exact.codes is not None
    assert 0 < rms(found.codes - exact.codes) < 1e-3 * rms(codes - codes.mean(axis=0))
    assert found.frames is not None
    assert exact.frames is not None
    assert found.frames.dtype == np.float16
    assert rms(found.frames.astype(np.float32) - exact.frames) < 1e-3 * rms(exact.frames)


@pytest.mark.parametrize(
    ("image", "code", "words"),
    [
        (np.zeros(SHAPE, np.uint8), ErrorCode.wrong_dtype, r"uint8; .*float32 in \[-9, 9\]"),
        (field(0)[:3], ErrorCode.wrong_shape, r"\(3, 16, 32\).*\(4, 16, 32\)"),
        (field(0)[0], ErrorCode.wrong_shape, r"\(16, 32\).*\(4, 16, 32\)"),
        (field(0) * np.float16(5), ErrorCode.malformed, r"in \[-9, 9\].*normalise its channels"),
    ],
)
def test_what_the_model_does_not_take(
    registry: Registry, image: np.ndarray, code: ErrorCode, words: str
) -> None:
    with pytest.raises(ProtocolError, match=words) as caught:
        registry.admit(frame(0, image))
    assert caught.value.code == code
    assert len(registry) == 0


def test_a_field_that_is_not_finite_does_not_come_as_far_as_the_model() -> None:
    image = field(0)
    image[1, 2, 3] = np.nan
    with pytest.raises(ProtocolError, match="NaN or infinity") as caught:
        frame(0, image)
    assert caught.value.code == ErrorCode.not_finite


def test_one_field_or_several_are_a_target(registry: Registry) -> None:
    trajectory = streamed(registry)
    fields = np.stack([field(seq) for seq in range(3)])
    several = aim_of(trajectory, LqrQuery(5, target_image=fields))
    alone = [aim_of(trajectory, LqrQuery(5, target_image=image)) for image in fields]
    np.testing.assert_array_equal(several.codes, np.concatenate([aim.codes for aim in alone]))
    assert several.error == max(aim.error for aim in alone) > 0
    with pytest.raises(ProtocolError, match=r"in \[-9, 9\]"):
        aim_of(trajectory, LqrQuery(5, target_image=10 * fields))


def test_a_model_of_fields_can_be_rehearsed(registry: Registry, tmp_path: Path) -> None:
    entry = ModelEntry("flow", tmp_path / "flow.safetensors", ("*",))
    rehearse(*registry.equipment(entry, control_size=1))
