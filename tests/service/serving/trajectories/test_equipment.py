"""What a trajectory's estimator is made of: the user's choices before the model card's."""

import pytest

from koop_protocol import ErrorCode, ProtocolError
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.weights import EstimatorDefaults, ModelCard, save_weights
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.trajectories.equipment import Equipment, settings_for

MEAN = tuple(tuple(0.1 * (row + column) for column in range(18)) for row in range(8))
DEFAULTS = EstimatorDefaults(rho=0.3, forgetting=0.98, prior_mean=MEAN)


@pytest.fixture(scope="module")
def entry(tmp_path_factory: pytest.TempPathFactory) -> ModelEntry:
    path = tmp_path_factory.mktemp("weights") / "model.safetensors"
    save_weights(path, initialised(8, 0), ModelCard("s", "r", 0.05, estimator=DEFAULTS))
    return ModelEntry("model", path, ("*",))


def test_the_cards_settings_hold_where_the_user_chose_none(entry: ModelEntry) -> None:
    settings = settings_for(entry, EstimatorChoices(), 1)
    assert settings == DEFAULTS.settings(8, 1)
    assert (settings.rho, settings.forgetting, settings.prior_mean) == (0.3, 0.98, MEAN)


def test_the_users_choices_come_first(entry: ModelEntry) -> None:
    settings = settings_for(entry, EstimatorChoices(rho=0.7, forgetting=0.9, window=30), 1)
    assert (settings.rho, settings.forgetting, settings.window) == (0.7, 0.9, 30)
    assert settings.prior_mean == MEAN


def test_to_choose_what_the_card_says_changes_nothing(entry: ModelEntry) -> None:
    """A record tells settings apart without the prior's mean, which must follow from the others."""
    choices = EstimatorChoices(history=2, affine=True, rho=0.3, forgetting=0.98)
    assert settings_for(entry, choices, 1) == settings_for(entry, EstimatorChoices(), 1)


@pytest.mark.parametrize(
    ("choices", "controls"),
    [
        (EstimatorChoices(history=1), 1),
        (EstimatorChoices(affine=False), 1),
        (EstimatorChoices(affine=False), 2),  # as many numbers in a regressor as the mean has
        (EstimatorChoices(), 2),
    ],
)
def test_a_prior_of_another_regressor_is_not_used(
    entry: ModelEntry, choices: EstimatorChoices, controls: int
) -> None:
    assert settings_for(entry, choices, controls).prior_mean == ()


@pytest.mark.parametrize("device", ["gpu", "cuda:99"])
def test_a_device_that_is_not_there_is_told(entry: ModelEntry, device: str) -> None:
    equipment = Equipment(Catalogue([entry]), EstimatorChoices(), device)
    told = f"'model' cannot be loaded onto '{device}': .*; expected a device .*'--device cpu'"
    with pytest.raises(ProtocolError, match=told) as caught:
        equipment.codec(entry)
    assert caught.value.code == ErrorCode.no_model
