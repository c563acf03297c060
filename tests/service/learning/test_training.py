"""Training on a small recording: it learns, repeats itself, and refuses what does not fit."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import (
    EstimatorDefaults,
    ModelCard,
    load_card,
    load_weights,
    save_weights,
)
from koop_service.learning import cli, look
from koop_service.learning.dynamics import load_learned
from koop_service.learning.hardware import choose
from koop_service.learning.judging import prior_mean
from koop_service.learning.log import COLUMNS
from koop_service.learning.pooled import plain_rows, pooled_theta
from koop_service.learning.recording import load_recording
from koop_service.learning.train import Setting, Warm, advance, begin

from .blobs import moving_blobs, pushes, smoke, write

HARDWARE = choose("cpu", "float32")


def trained(recording, preset, seed=5, dynamics="fitted"):
    setting = Setting(recording, preset, seed, HARDWARE)
    training = begin(setting, dynamics)
    losses = list(advance(training, setting))
    return training, losses


def test_training_lowers_the_error(recording):
    training, losses = trained(recording, smoke(60, 4))
    model = training.model
    images = torch.from_numpy(recording.frames[0, :50]).float()[:, None] / 255
    error = ((model.decode(model.encode(images)) - images) ** 2).mean().item()
    assert error < 0.7 * images.var().item()
    assert not model.training
    assert [loss.horizon for loss in losses[:60]] == [0] * 60
    assert training.frames == sum(loss.frames for loss in losses)


def test_training_repeats_itself(recording):
    first, second = (trained(recording, smoke())[0].model.state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = trained(recording, smoke(), seed=6)[0].model.state_dict()
    assert not torch.equal(first["decoder.5.0.weight"], other["decoder.5.0.weight"])


@pytest.mark.parametrize("frozen", [0, 3])
def test_frozen_blocks_stay_as_they_were(recording, frozen):
    before = begin(Setting(recording, smoke(0, 3), 1, HARDWARE), "fitted").model.state_dict()
    before = {name: tensor.clone() for name, tensor in before.items()}
    after = trained(recording, smoke(0, 3, frozen_blocks=frozen), seed=1)[0].model.state_dict()
    first, last = "encoder.2.0.weight", "encoder.3.0.weight"
    assert torch.equal(before[first], after[first]) == (frozen == 3)
    assert not torch.equal(before[last], after[last])


def test_a_loss_that_stays_not_finite_is_told(recording):
    setting = Setting(recording, smoke(30, 0), 0, HARDWARE)
    training = begin(setting, "fitted")
    with torch.no_grad():
        training.model.encoder[0][0].weight.fill_(float("nan"))
    with pytest.raises(ValueError, match="has not been finite for 20 steps"):
        list(advance(training, setting))


def test_mixed_precision_learns_as_well(recording):
    losses = {}
    for precision in ("float32", "bfloat16"):
        setting = Setting(recording, smoke(40, 4), 5, choose("cpu", precision))
        losses[precision] = list(advance(begin(setting, "fitted"), setting))
    single, half = (np.mean([x.reconstruction for x in ls[30:]]) for ls in losses.values())
    assert half == pytest.approx(single, rel=0.1)


@pytest.fixture(scope="module")
def written(recording_file, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("out") / "blobs.safetensors"
    cli.run(cli.Arguments(recording_file, out, preset="smoke", seed=1, steps=3))
    return out


def test_the_command_writes_weights_with_their_card(written):
    _, card = load_weights(written)
    assert (card.system, card.renderer, card.dynamics) == ("blobs", "test", "fitted")
    assert card.training["seed"] == 1
    assert card.figures["reconstruction"] > 0
    assert card.figures["offline"]["1"] > 0
    assert load_learned(written) is None
    assert not written.with_name(written.name + ".checkpoint").exists()


def test_the_command_writes_a_log(written):
    with written.with_suffix(".csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert [(row["stage"], row["step"]) for row in rows] == [
        ("autoencoder", "20"),
        ("dynamics", "3"),
    ]
    assert float(rows[1]["codes"]) > 0
    assert int(rows[1]["frames"]) > int(rows[0]["frames"]) == 20 * 16


def test_the_command_draws_a_strip(written):
    assert written.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_the_closing_line_names_files_and_figures(recording_file, tmp_path, capsys):
    out = tmp_path / "a.safetensors"
    cli.run(cli.Arguments(recording_file, out, preset="smoke", warm_up=1, steps=1))
    told = capsys.readouterr().out
    assert f"wrote {out}, a.csv, a.png" in told
    assert "minutes" in told


@pytest.mark.parametrize("kind", ["learned-A", "learned-B"])
def test_baselines_go_the_same_way(recording_file, tmp_path, kind):
    out = tmp_path / "baseline.safetensors"
    cli.run(cli.Arguments(recording_file, out, preset="smoke", warm_up=2, steps=2, dynamics=kind))
    learned = load_learned(out)
    assert learned is not None
    assert learned.matrix.shape == {"learned-A": (8, 18), "learned-B": (8, 1)}[kind]
    assert np.abs(learned.matrix).sum() > 0
    assert load_weights(out)[1].figures["offline"]["1"] > 0


def test_training_goes_on_from_weights(written, recording_file, tmp_path):
    out = tmp_path / "more.safetensors"
    cli.run(cli.Arguments(recording_file, out, preset="smoke", start_from=written, steps=0))
    before, after = (load_weights(path)[0].state_dict() for path in (written, out))
    assert all(torch.equal(before[name], after[name]) for name in before)
    training = load_card(out).training
    assert training["started_from"] == load_card(written).training
    with pytest.raises(ValueError, match="has codes of size 8, not --code-size 4"):
        cli.run(cli.Arguments(recording_file, out, start_from=written, code_size=4))


def test_a_prior_that_is_learned_with_the_network_or_else_afterwards(recording):
    preset = smoke(2, 2)
    roll = dataclasses.replace(preset.actuated, around_mean=1.0)
    preset = dataclasses.replace(preset, actuated=roll)
    training, _ = trained(recording, preset)
    codec = ImageCodec(training.model, ModelCard("blobs", "test", 0.05))
    learned = prior_mean(training, codec, recording)
    assert learned == plain_rows(training.dynamics.matrix)
    assert np.shape(learned) == (8, 18)
    afterwards = pooled_theta(codec, recording)
    assert learned != afterwards
    untrained = begin(Setting(recording, preset, 5, HARDWARE), "fitted", Warm(training.model))
    assert prior_mean(untrained, codec, recording) == afterwards


def test_what_the_dynamics_learned_is_gone_on_from(recording_file, tmp_path):
    first, more, other = (tmp_path / f"{name}.safetensors" for name in ("first", "more", "other"))
    arguments = cli.Arguments(
        recording_file, first, preset="smoke", warm_up=1, steps=2, dynamics="learned-A"
    )
    cli.run(arguments)
    arguments = dataclasses.replace(arguments, warm_up=None, start_from=first, steps=0)
    cli.run(dataclasses.replace(arguments, out=more))
    learned = load_learned(first).matrix
    assert np.array_equal(load_learned(more).matrix, learned)
    cli.run(dataclasses.replace(arguments, out=other, steps=1))
    moved = np.abs(load_learned(other).matrix - learned)
    assert 0 < moved.max() <= 1.1e-3  # one step of Adam
    # Of codes that are trained on alone, or of other dynamics, nothing is known.
    setting = Setting(load_recording(recording_file), smoke(1, 1), 0, HARDWARE)
    warm = Warm(load_weights(first)[0], torch.from_numpy(learned))
    assert begin(setting, "learned-A", warm).dynamics.is_blank
    assert begin(setting, "learned-B", warm).dynamics.is_blank


def test_a_learned_prior_is_gone_on_from(recording, tmp_path):
    mean = tuple(tuple(0.01 * (row - column) for column in range(18)) for row in range(8))
    card = ModelCard("blobs", "test", 0.05, estimator=EstimatorDefaults(prior_mean=mean))
    path = tmp_path / "centred.safetensors"
    save_weights(path, initialised(8, 0), card)
    warm = cli._start(path, recording, "fitted")
    assert np.array_equal(warm.matrix, mean)
    assert cli._start(path, recording, "learned-A").matrix is None


def test_codes_of_another_size(free_file, tmp_path):
    out = tmp_path / "four.safetensors"
    cli.run(cli.Arguments(free_file, out, preset="smoke", code_size=4, warm_up=1, steps=1))
    model, card = load_weights(out)
    assert (model.code_size, card.code_size) == (4, 4)


def test_a_strip_shows_truth_above_prediction():
    truth, predicted = np.ones((2, 12, 64, 64)), np.zeros((2, 12, 64, 64))
    view = look.Forecast(truth, predicted, np.zeros((2, 64, 64)), dt=0.1)
    picture, middles = look._mosaic(view, [1, 5, 10])
    assert len(middles) == 4
    assert (picture[:64, :64] == 1).all()
    assert (picture[65:129, :64] == 0).all()
    assert view.errors()["offline"] == {1: 1.0, 5: 1.0, 10: 1.0}


@pytest.mark.parametrize(
    ("frames", "controls", "change", "message"),
    [
        (moving_blobs(2, 20), 1, {}, r"trajectories of 20 frames.*at least 58"),
        (np.full((2, 70, 64, 64), 7, np.uint8), 1, {}, "every pixel of every frame is 7"),
        (moving_blobs(2), 0, {"dynamics": "learned-B"}, "the recording has none"),
        (moving_blobs(1), 1, {}, "training needs at least 2"),
    ],
)
def test_recordings_that_do_not_fit(tmp_path, frames, controls, change, message):
    path = write(tmp_path / "wrong.h5", frames, pushes(frames, controls))
    arguments = cli.Arguments(path, tmp_path / "out.safetensors", preset="smoke")
    with pytest.raises(ValueError, match=message):
        cli.run(dataclasses.replace(arguments, **change))


def test_weights_for_another_renderer(written, tmp_path):
    frames = moving_blobs(2)
    path = write(tmp_path / "other.h5", frames, pushes(frames), renderer="other")
    arguments = cli.Arguments(path, tmp_path / "out.safetensors", start_from=written)
    with pytest.raises(ValueError, match=r"drawn by 'test'.*drawn by 'other'"):
        cli.run(arguments)


def test_a_folder_that_cannot_be_written(recording_file, tmp_path):
    (tmp_path / "file").touch()
    arguments = cli.Arguments(recording_file, tmp_path / "file" / "out.safetensors")
    with pytest.raises(ValueError, match=r"cannot write.*choose another --out"):
        cli.run(arguments)
    with pytest.raises(ValueError, match="is a folder"):
        cli.run(cli.Arguments(recording_file, tmp_path))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"device": "tpu"}, "unknown device"), ({"precision": "int8"}, "unknown precision")],
)
def test_hardware_that_there_is_not(options, message):
    with pytest.raises(ValueError, match=message):
        choose(**options)
