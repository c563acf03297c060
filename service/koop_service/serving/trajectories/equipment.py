"""What a trajectory is opened with: its model, its encoder, a bank of estimators."""

from __future__ import annotations

from dataclasses import replace

from koop_protocol import ErrorCode, ProtocolError
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.estimator import Bank
from koop_service.estimation.settings import EstimatorSettings
from koop_service.serving.config import EstimatorChoices


def settings_for(entry: ModelEntry, chosen: EstimatorChoices, p: int) -> EstimatorSettings:
    """What the user chose, else what the model's card recommends, for p controls."""
    card = entry.card.estimator
    changes = {
        name: value
        for name in ("history", "affine", "rho", "forgetting")
        if (value := getattr(chosen, name)) not in (None, getattr(card, name))
    }
    if {"history", "affine"} & changes.keys():
        changes["prior_mean"] = ()  # it is of the card's regressor
    estimator = replace(card, **changes)
    return replace(estimator.settings(entry.card.code_size, p), window=chosen.window)


class Equipment:
    """Models and banks, each made when it is first needed."""

    def __init__(self, catalogue: Catalogue, choices: EstimatorChoices, device: str) -> None:
        self._catalogue = catalogue
        self._choices = choices
        self._device = device
        self._codecs: dict[str, ImageCodec] = {}
        self._settings: dict[tuple[str, int], EstimatorSettings] = {}
        self._banks: dict[tuple[str, int], Bank] = {}

    def match(self, name: str) -> ModelEntry | None:
        """The model of a trajectory, or None."""
        return self._catalogue.match(name)

    def settings(self, entry: ModelEntry, control_size: int) -> EstimatorSettings:
        """The estimator of a trajectory of this model; the same object for all of them."""
        key = (entry.name, control_size)
        if key not in self._settings:
            self._settings[key] = settings_for(entry, self._choices, control_size)
        return self._settings[key]

    def entry_for(self, name: str) -> ModelEntry:
        """The model of a trajectory. Raises ProtocolError (no_model) where there is none."""
        entry = self._catalogue.match(name)
        if entry is None:
            raise self.no_model(name)
        return entry

    def codec(self, entry: ModelEntry) -> ImageCodec:
        """The model's encoder. Raises ProtocolError (no_model) where it cannot be loaded."""
        if entry.name not in self._codecs:
            try:
                self._codecs[entry.name] = entry.load(self._device)
            except ValueError as error:
                raise ProtocolError(
                    ErrorCode.no_model, f"the model {entry.name!r} cannot be loaded: {error}"
                ) from error
            except (RuntimeError, AssertionError) as error:  # torch's way to tell of a device
                raise self._no_device(entry, error) from error
        return self._codecs[entry.name]

    def bank(self, entry: ModelEntry, settings: EstimatorSettings) -> Bank:
        """The estimators of all trajectories with this model and so many controls."""
        key = (entry.name, settings.control_size)
        if key not in self._banks:
            self._banks[key] = Bank(settings)
        return self._banks[key]

    def _no_device(self, entry: ModelEntry, error: Exception) -> ProtocolError:
        reason = str(error).partition("\n")[0]
        return ProtocolError(
            ErrorCode.no_model,
            f"the model {entry.name!r} cannot be loaded onto {self._device!r}: {reason}",
            "a device that this build of torch knows, with memory to spare",
            "see what nvidia-smi says, or start the service with '--device cpu'",
        )

    def no_model(self, name: str) -> ProtocolError:
        """What to tell whoever streams or asks for a trajectory without a model."""
        models = [f"{e.name} ({' '.join(e.patterns)})" for e in self._catalogue.entries]
        return ProtocolError(
            ErrorCode.no_model,
            f"no model for trajectory {name!r}",
            f"a name that one of the models is for: {', '.join(models) or 'there are none yet'}",
            "train one with 'koop-dataset ... && koop-train ...' and pass it with "
            f"--models '{name.split('/')[0]}/*=FILE'",
            {"trajectory": name},
        )
