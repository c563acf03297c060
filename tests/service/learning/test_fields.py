"""Training on one long trajectory of fields: floats of several channels."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from koop_service.encoding.architecture import FLOW, Architecture
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import load_weights
from koop_service.learning import cli, look
from koop_service.learning.hardware import choose
from koop_service.learning.presets import PRESETS, RollOut
from koop_service.learning.recording import Recording, load_recording
from koop_service.learning.train import Setting, advance, begin
from koop_service.learning.windows import Windows, as_images

from .blobs import pushes, smoke, write

HARDWARE = choose("cpu", "float32")
SHAPE, SMALL = (2, 16, 32), Architecture((8, 16), overlap=2)
ROLL_OUT = RollOut(fit_frames=(16, 16), horizon=6, rho=1e-3, restarts=3, short=3, beyond=8)
QUICK = {
    "architecture": SMALL,
    "free": ROLL_OUT,
    "actuated": ROLL_OUT,
    "frozen_blocks": 1,
    "held_out": 0.3,
    "segment": 44,
    "history": 1,
}


def travelling_waves(frames: int = 160, count: int = 1) -> np.ndarray:
    """Two fields (count, frames, 2, 16, 32) float16: a wave, and its shadow of another mean."""
    t, y, x = np.ogrid[:frames, :16, :32]
    wave = np.sin(0.7 * t + 2 * np.pi * x / 32 + 0 * y)
    fields = np.stack([wave, 3 - 0.5 * wave], axis=1).astype(np.float16)
    return np.stack([fields] * count)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frames = travelling_waves()
    return write(tmp_path_factory.mktemp("data") / "waves.h5", frames, pushes(frames))


@pytest.fixture(scope="module")
def recording(file: Path) -> Recording:
    return load_recording(file)


@pytest.fixture(scope="module")
def written(file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "waves.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(cli.PRESETS, "flow", smoke(**QUICK))
        cli.run(cli.Arguments(file, out, preset="flow", code_size=4, warm_up=30, steps=4))
    return out


def test_a_model_is_judged_on_another_recording(
    written: Path, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(cli.PRESETS, "flow", smoke(**QUICK))
    frames = travelling_waves(frames=100) * np.float16(0.5)
    other = write(tmp_path / "other.h5", frames, pushes(frames))
    out = tmp_path / "judged.safetensors"
    arguments = cli.Arguments(file, out, preset="flow", start_from=written, steps=0)
    cli.run(dataclasses.replace(arguments, judged_on=other))
    repeated = [
        load_weights(path)[1].figures["offline_repeat_last"]["1"] for path in (written, out)
    ]
    assert repeated[1] == pytest.approx(repeated[0] / 2, rel=0.1)  # half the waves, half the error
    foreign = write(tmp_path / "foreign.h5", frames, pushes(frames), renderer="other")
    with pytest.raises(ValueError, match=r"--judged-on .*frames of the same kind"):
        cli.run(dataclasses.replace(arguments, judged_on=foreign))


def test_floats_are_read_as_they_are_with_their_range(recording: Recording) -> None:
    assert recording.frames.dtype == np.float16
    assert recording.image_shape == SHAPE
    np.testing.assert_array_equal(recording.frames, travelling_waves())
    assert recording.value_range == (-35.0, 35.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.astype(np.float64), r"float64; .*or \(C, H, W\) float16 or float32"),
        (lambda f: f[:, :, 0], r"\(1, 160, 16, 32\) float16; .*\(C, H, W\)"),
        (lambda f: f[..., :0], r"\(1, 160, 2, 16, 0\) float16"),
        (lambda f: np.where(f > 3.4, np.nan, f), "frames that are not finite"),
        (lambda f: np.where(f < -0.9, -np.inf, f).astype(np.float32), "not finite"),
    ],
)
def test_fields_that_do_not_fit(tmp_path: Path, change, words: str) -> None:
    frames = change(travelling_waves())
    with pytest.raises(ValueError, match=words):
        load_recording(write(tmp_path / "wrong.h5", frames, pushes(travelling_waves())))


@pytest.mark.parametrize(("share", "sequences"), [(0.01, 1), (0.25, 1), (0.5, 2), (0.8, 3)])
def test_sequences_out_of_long_trajectories_are_held_out(share: float, sequences: int) -> None:
    """Frame k and control k of trajectory i are told apart by 1000 i + k."""
    numbers = np.arange(160.0) + 1000 * np.arange(2)[:, None]
    frames = np.tile(numbers[..., None, None, None], SHAPE)
    recording = Recording(frames, numbers[:, :-1, None], "waves", "", 0.15, 0)
    seen, unseen = recording.split_in_time(share, 40)
    stretch = 160 // sequences
    assert seen.frames.shape[:2] == (2 * sequences, stretch - 40)
    assert unseen.frames.shape[:2] == (2 * sequences, 40)
    for part in (seen, unseen):
        np.testing.assert_array_equal(part.controls[..., 0], part.frames[:, :-1, 0, 0, 0])
        assert (np.diff(part.controls[..., 0]) == 1).all()
    kept = np.concatenate([part.frames[..., 0, 0, 0].ravel() for part in (seen, unseen)])
    assert len(np.unique(kept)) == len(kept) == 2 * sequences * stretch
    assert set(kept) <= set(numbers.ravel())


def test_trajectories_without_controls_are_cut_alike() -> None:
    recording = Recording(np.zeros((2, 160, 1, 2, 2)), np.zeros((2, 159, 0)), "waves", "", 0.15, 0)
    seen, unseen = recording.split_in_time(0.5, 40)
    assert seen.controls.shape == (4, 39, 0)
    assert unseen.controls.shape == (4, 39, 0)


def test_a_trajectory_too_short_to_hold_some_of_it_out(recording: Recording) -> None:
    with pytest.raises(ValueError, match=r"160 frames, of which 159 are held out; .*longer ones"):
        recording.split_in_time(0.1, 159)


def test_the_network_sees_fields_as_they_are(recording: Recording) -> None:
    frames = torch.from_numpy(recording.frames[0, :3])
    assert torch.equal(as_images(frames), frames.float())


def test_a_fresh_decoder_begins_with_each_channels_mean_and_spread(recording: Recording) -> None:
    model = begin(Setting(recording, smoke(**QUICK), 0, HARDWARE), "fitted").model
    last = [m for m in model.decoder.modules() if isinstance(m, nn.BatchNorm2d)][-1]
    some = recording.frames[0, ::10].astype(np.float32)
    np.testing.assert_allclose(last.bias.detach(), some.mean((0, 2, 3)), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(last.weight.detach(), some.std((0, 2, 3)), rtol=1e-4)


def test_the_frozen_blocks_outputs_of_fields_are_held(recording: Recording) -> None:
    setting = Setting(recording, smoke(**QUICK), 0, HARDWARE)
    trunk = nn.Sequential(*list(begin(setting, "fitted").model.eval().encoder)[:1])
    source = Windows(recording, trunk, 1e9, HARDWARE, seed=0)
    source.go_to(0)
    batch = source.draw(2, 20, np.random.default_rng(1))
    with torch.no_grad():
        expected = trunk(batch.images(torch.arange(40)))
    torch.testing.assert_close(batch.inputs, expected, atol=1e-2, rtol=1e-2)


def test_training_lowers_the_error(recording: Recording) -> None:
    setting = Setting(recording, smoke(150, 4, **QUICK), 0, HARDWARE)
    training = begin(setting, "fitted")
    losses = list(advance(training, setting))
    images = as_images(torch.from_numpy(recording.frames[0, ::7]))
    with torch.no_grad():
        error = ((training.model.decode(training.model.encode(images)) - images) ** 2).mean()
    assert error < 0.3 * images.var((0, 2, 3)).mean()
    assert losses[-1].horizon == ROLL_OUT.horizon


def test_the_command_writes_a_model_that_encodes_fields(written: Path) -> None:
    model, card = load_weights(written)
    assert (card.image_shape, card.architecture) == (SHAPE, SMALL)
    assert card.value_range == (-35.0, 35.0)
    assert set(card.figures) >= {"reconstruction", "offline", "offline_repeat_last"}
    codec, frames = ImageCodec(model, card), travelling_waves()[0, :3]
    shown = codec.decode(codec.encode(frames), frames.dtype)
    assert (shown.shape, shown.dtype) == (frames.shape, np.float16)


def test_the_command_draws_fields(written: Path) -> None:
    assert written.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_a_strip_shows_the_second_channel_in_the_range_of_the_truth() -> None:
    truth = np.zeros((1, 5, 4, 16, 32))
    truth[:, :, 1] = np.linspace(-2, 6, 5)[:, None, None]
    view = look.Forecast(truth, truth + 1.0, truth[:, 0], dt=0.15)
    shown, predicted = view.pictures()
    np.testing.assert_allclose(shown[0, :, 3, 3], [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(predicted - shown, 1 / 8)
    picture, middles = look._mosaic(view, [1, 5])
    assert picture.shape == (16 + 16 + 2, 2 * 33)
    assert middles == [7.5, 24.5]


def test_training_goes_on_from_weights_of_the_same_frames_only(
    written: Path, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(cli.PRESETS, "flow", smoke(**{**QUICK, "architecture": Architecture((4,))}))
    arguments = cli.Arguments(
        file, tmp_path / "more.safetensors", preset="flow", start_from=written, steps=1
    )
    cli.run(arguments)
    assert load_weights(arguments.out)[1].architecture == SMALL
    frames = travelling_waves()[..., :16]
    other = write(tmp_path / "other.h5", frames, pushes(frames))
    with pytest.raises(ValueError, match=r"frames \(2, 16, 32\), .*holds frames \(2, 16, 16\)"):
        cli.run(dataclasses.replace(arguments, recording=other))


def test_frames_that_the_presets_network_cannot_halve(tmp_path: Path) -> None:
    frames = travelling_waves()
    path = write(tmp_path / "waves.h5", frames, pushes(frames))
    arguments = cli.Arguments(path, tmp_path / "out.safetensors", preset="flow")
    with pytest.raises(ValueError, match=r"waves\.h5: .*16 x 32 cannot be halved 6 times"):
        cli.run(arguments)


def test_codes_too_large_to_be_judged(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(cli.PRESETS, "flow", smoke(**QUICK))
    arguments = cli.Arguments(file, tmp_path / "out.safetensors", preset="flow", code_size=16)
    words = r"sequences of 44 frames; codes of size 16 need 61: choose a smaller --code-size"
    with pytest.raises(ValueError, match=words):
        cli.run(arguments)


def test_the_flow_preset_is_the_papers() -> None:
    preset = PRESETS["flow"]
    assert (preset.dynamics.batch, preset.dynamics.rate, preset.architecture) == (16, 1e-3, FLOW)
    assert preset.free.fit_frames == (16, 16)
    assert {16 + preset.free.after(horizon) for horizon in range(1, 17)} == {32}


def test_the_flow_presets_fit_a_forced_wake_around_what_all_have_in_common() -> None:
    for roll in (PRESETS["flow"].actuated, PRESETS["flow-gpu"].actuated):
        assert roll.around_mean > roll.rho
        assert roll.longest == 140
