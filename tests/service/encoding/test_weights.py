"""Weights files: what is written is read, and what does not fit is refused with a reason."""

import dataclasses
import json

import pytest
import torch
from safetensors.torch import save_file

from koop_service.encoding.architecture import FLOW, PAPER
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.weights import (
    EstimatorDefaults,
    ModelCard,
    fingerprint,
    load_card,
    load_weights,
    save_weights,
)

CARD = ModelCard(
    system="cartpole",
    renderer="koop-sdf-1",
    dt=0.05,
    estimator=EstimatorDefaults(rho=0.1, forgetting=0.98, band_scale=(1.0, 0.9, 0.5, 0.3, 0.25)),
    training={"seed": 3},
)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "model.safetensors"
    save_weights(path, initialised(8, 0), CARD)
    return path


def test_round_trip(saved):
    model, card = load_weights(saved)
    assert card == CARD
    fresh = initialised(8, 0).state_dict()
    assert all(torch.equal(tensor, fresh[name]) for name, tensor in model.state_dict().items())


def test_round_trip_of_a_model_of_fields(tmp_path):
    shape = (4, 64, 128)
    card = dataclasses.replace(
        CARD, code_size=6, image_shape=shape, value_range=(-35.5, 35.5), architecture=FLOW
    )
    path = tmp_path / "flow.safetensors"
    save_weights(path, initialised(6, 0, shape, FLOW), card)
    model, found = load_weights(path)
    assert found == card
    assert model.decode(model.encode(torch.zeros(2, *shape))).shape == (2, *shape)


def test_a_card_from_before_there_were_fields_is_of_the_papers_network(tmp_path):
    path = tmp_path / "old.safetensors"
    save_file({"x": torch.zeros(1)}, path, _metadata(_card_fields()))
    card = load_card(path)
    assert (card.architecture, card.value_range) == (PAPER, (0.0, 1.0))


@pytest.mark.parametrize(
    "wrong",
    [
        {"image_shape": [64]},
        {"image_shape": [100, 64]},
        {"architecture": {"channels": [16], "overlap": 3}},
        {"architecture": {"layers": 3}},
        {"value_range": [1.0, 0.0]},
        {"value_range": [0.0, float("inf")]},
    ],
)
def test_a_card_of_a_network_that_cannot_be_built(tmp_path, wrong):
    path = tmp_path / "wrong.safetensors"
    save_file({"x": torch.zeros(1)}, path, _metadata({**_card_fields(), **wrong}))
    with pytest.raises(ValueError, match="model card that cannot be read"):
        load_card(path)


def test_a_file_that_is_no_safetensors(tmp_path):
    path = tmp_path / "junk.safetensors"
    path.write_bytes(b"\x80\x04 not weights")
    with pytest.raises(ValueError, match="cannot be read as safetensors"):
        load_weights(path)


def test_somebody_elses_safetensors(tmp_path):
    path = tmp_path / "other.safetensors"
    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(ValueError, match=r"not a koop autoencoder.*koop-train"):
        load_weights(path)


def test_weights_of_another_shape(tmp_path):
    path = tmp_path / "short.safetensors"
    save_file({"encoder.0.0.weight": torch.zeros(1)}, path, _metadata(_card_fields()))
    with pytest.raises(ValueError, match="does not hold the weights"):
        load_weights(path)


def test_weights_that_are_not_finite(tmp_path):
    model = initialised(8, 0)
    model.encoder[0][0].weight.data[0] = float("nan")
    path = tmp_path / "nan.safetensors"
    save_weights(path, model, CARD)
    with pytest.raises(ValueError, match="not finite"):
        load_weights(path)


def test_a_broken_card(tmp_path):
    path = tmp_path / "card.safetensors"
    save_file({"x": torch.zeros(1)}, path, {"format": "koop-autoencoder-1", "card": "{"})
    with pytest.raises(ValueError, match="model card that cannot be read"):
        load_card(path)


def test_a_card_from_before_there_were_baselines_is_of_a_fitted_model(tmp_path):
    path = tmp_path / "old.safetensors"
    metadata = {"format": "koop-autoencoder-1", "card": json.dumps(_card_fields())}
    save_file(initialised(8, 0).state_dict(), path, metadata)
    assert load_weights(path)[1].dynamics == "fitted"


def test_a_baseline_is_not_served(tmp_path):
    path = tmp_path / "baseline.safetensors"
    card = dataclasses.replace(CARD, dynamics="learned-A")
    save_weights(path, initialised(8, 0), card, torch.zeros(8, 17))
    with pytest.raises(ValueError, match=r"baseline with learned-A dynamics.*--dynamics fitted"):
        _ = ModelEntry("baseline", path, ("*",)).card


def test_a_card_from_before_bands_were_calibrated(tmp_path):
    path = tmp_path / "old.safetensors"
    old = {**_card_fields(), "estimator": {"rho": 0.5}}
    save_file({"x": torch.zeros(1)}, path, _metadata(old))
    assert load_card(path).estimator == EstimatorDefaults(rho=0.5, band_scale=())


@pytest.mark.parametrize("scale", [[1.0, 2.0], [1.0, 1.0, 0.0, 1.0, 1.0], 3, ["wide"] * 5])
def test_a_card_with_impossible_bands(tmp_path, scale):
    path = tmp_path / "bands.safetensors"
    card = {**_card_fields(), "estimator": {"band_scale": scale}}
    save_file({"x": torch.zeros(1)}, path, _metadata(card))
    with pytest.raises(ValueError, match="model card that cannot be read"):
        load_card(path)


MEAN = tuple(tuple(0.1 * (row + column) for column in range(18)) for row in range(8))


def test_a_priors_mean_is_for_the_controls_that_it_was_learned_with(tmp_path):
    path = tmp_path / "mean.safetensors"
    card = dataclasses.replace(CARD, estimator=EstimatorDefaults(prior_mean=MEAN))
    save_weights(path, initialised(8, 0), card)
    assert load_card(path) == card
    assert card.estimator.settings(8, 1).prior_mean == MEAN
    assert card.estimator.settings(8, 0).prior_mean == ()
    assert card.estimator.settings(8, 2).prior_mean == ()


@pytest.mark.parametrize(
    "mean",
    [MEAN[:7], [*MEAN[:7], MEAN[7][:17]], [row[:16] for row in MEAN], [["wide"] * 18] * 8, 3, [[]],
     [[float("nan")] * 18] * 8],
)  # fmt: skip
def test_a_card_with_an_impossible_prior(tmp_path, mean):
    path = tmp_path / "mean.safetensors"
    card = {**_card_fields(), "estimator": {"prior_mean": mean}}
    save_file({"x": torch.zeros(1)}, path, _metadata(card))
    with pytest.raises(ValueError, match="model card that cannot be read"):
        load_card(path)


def test_the_users_models_come_before_the_bundled(saved):
    mine = ModelEntry("mine", saved, ("cartpole/*", "line3/*"))
    catalogue = Catalogue.bundled().preferring([mine])
    assert catalogue.match("cartpole/0") is mine
    assert catalogue.match("line3/robot7") is mine
    assert catalogue.match("unheard/of") is None
    assert catalogue.entries[0] is mine


def test_fingerprints_tell_weights_apart(saved, tmp_path):
    other = tmp_path / "other.safetensors"
    save_weights(other, initialised(8, 1), CARD)
    assert fingerprint(saved) != fingerprint(other)


def _card_fields() -> dict:
    return {"system": "s", "renderer": "r", "dt": 0.05, "estimator": {}, "image_shape": [64, 64]}


def _metadata(card: dict) -> dict[str, str]:
    return {"format": "koop-autoencoder-1", "card": json.dumps(card)}
