"""Training on a small recording: it learns, repeats itself, and refuses what does not fit."""

import dataclasses

import h5py
import numpy as np
import pytest
import torch

from koop_protocol import recording as names
from koop_service.encoding.weights import load_weights
from koop_service.learning import cli
from koop_service.learning.presets import PRESETS
from koop_service.learning.recording import Recording, load_recording
from koop_service.learning.train import growing_horizon, train


def moving_blobs(count: int = 3, frames: int = 120) -> np.ndarray:
    """A bright square on a circle: pictures of a rotation."""
    images = np.zeros((count, frames, 64, 64), np.uint8)
    for i in range(count):
        for t in range(frames):
            x, y = (32 + 20 * f(0.2 * t + i) for f in (np.cos, np.sin))
            images[i, t, int(y) - 4 : int(y) + 4, int(x) - 4 : int(x) + 4] = 255
    return images


def write(path, frames: np.ndarray, controls: np.ndarray | None = None, **attributes):
    if controls is None:
        controls = np.zeros((*frames.shape[:1], frames.shape[1] - 1, 1))
    with h5py.File(path, "w") as file:
        file[names.FRAMES_DATASET] = frames
        file[names.CONTROLS_DATASET] = controls
        known = {
            names.FORMAT_ATTRIBUTE: names.RECORDING_FORMAT,
            names.VERSION_ATTRIBUTE: names.RECORDING_VERSION,
            names.SYSTEM_ATTRIBUTE: "blobs",
            names.RENDERER_ATTRIBUTE: "test",
            names.DT_ATTRIBUTE: 0.05,
            names.SEED_ATTRIBUTE: 0,
        }
        file.attrs.update({**known, **attributes})
    return path


@pytest.fixture(scope="module")
def recording_file(tmp_path_factory):
    return write(tmp_path_factory.mktemp("data") / "blobs.h5", moving_blobs())


def test_training_lowers_the_error_and_repeats_itself(recording_file):
    recording = load_recording(recording_file)
    preset = dataclasses.replace(PRESETS["smoke"], warmup_steps=60, steps=4)
    models = [train(recording, preset, seed=5, keep=lambda _: None) for _ in range(2)]
    images = torch.from_numpy(recording.frames[0, :50]).float()[:, None] / 255
    error = ((models[0].decode(models[0].encode(images)) - images) ** 2).mean().item()
    assert error < 0.7 * images.var().item()
    first, second = (m.state_dict() for m in models)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_the_command_writes_weights_with_their_card(recording_file, tmp_path):
    out = tmp_path / "blobs.safetensors"
    cli.run(cli.Arguments(recording_file, out, preset="smoke", seed=1))
    _, card = load_weights(out)
    assert card.system == "blobs"
    assert card.renderer == "test"
    assert card.training["seed"] == 1
    assert card.figures["reconstruction"] > 0


def test_the_horizon_grows_from_one_to_its_end():
    preset = dataclasses.replace(PRESETS["smoke"], steps=100, horizon=20)
    horizons = [growing_horizon(step, preset) for step in range(100)]
    assert horizons[0] == 1
    assert horizons[-1] == 20
    assert horizons == sorted(horizons)


@pytest.mark.parametrize(
    ("frames", "controls", "attributes", "message"),
    [
        (np.zeros((1, 120, 32, 32), np.uint8), None, {}, "takes .64, 64. uint8"),
        (np.zeros((1, 120, 64, 64), np.float32), None, {}, "uint8"),
        (np.zeros((1, 120, 64, 64), np.uint8), np.zeros((1, 7, 1)), {}, "expected .1, 119."),
        (np.zeros((1, 9, 64, 64), np.uint8), np.full((1, 8, 1), np.nan), {}, "not finite"),
        (np.zeros((1, 9, 64, 64), np.uint8), None, {"format": "other"}, "koop-dataset"),
        (np.zeros((1, 9, 64, 64), np.uint8), None, {"version": 9}, "version 9"),
    ],
)
def test_recordings_that_do_not_fit(tmp_path, frames, controls, attributes, message):
    path = write(tmp_path / "wrong.h5", frames, controls, **attributes)
    with pytest.raises(ValueError, match=message):
        load_recording(path)


def test_a_recording_too_short_for_the_preset(tmp_path):
    path = write(tmp_path / "short.h5", np.zeros((2, 20, 64, 64), np.uint8))
    with pytest.raises(ValueError, match=r"trajectories of 20 frames.*needs at least 112"):
        cli.run(cli.Arguments(path, tmp_path / "out.safetensors", preset="smoke"))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match="cannot be read as HDF5"):
        load_recording(tmp_path / "nowhere.h5")


def test_recording_is_whole(recording_file):
    recording = load_recording(recording_file)
    assert isinstance(recording, Recording)
    assert recording.frames.shape == (3, 120, 64, 64)
    assert recording.controls.shape == (3, 119, 1)
