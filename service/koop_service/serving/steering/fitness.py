"""Whether a trajectory's present model may steer it to an aim, and what else to tell about that."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koop_service.control.certificate import Certificate, certify
from koop_service.control.equilibrium import nearest_equilibrium, why_unreachable
from koop_service.control.probing import multisine
from koop_service.estimation.innovation import RECENT
from koop_service.estimation.settings import EstimatorSettings
from koop_service.prediction.model import LinearModel
from koop_service.serving.steering.aims import Aim
from koop_service.serving.trajectories.trajectory import Posterior

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Verdict:
    """certificate: the numbers. reasons: why the model is not fit; none where it is.
    warnings: what a person should know besides. probing: (T, p), an input to learn from."""

    certificate: Certificate
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    probing: Array | None

    @property
    def fit(self) -> bool:
        """Whether nothing speaks against control."""
        return not self.reasons


def judge(
    model: LinearModel,
    posterior: Posterior,
    settings: EstimatorSettings,
    history: Array,
    aim: Aim,
) -> Verdict:
    """Certificate of the model and doubts about the aim; history (h, n) is the newest codes."""
    S, R, innovations = posterior.S, posterior.R, posterior.innovations
    certificate = certify(model, S, R, settings.ignorance, innovations, *aim.bounds)
    reasons = (*certificate.reasons, _why_early(len(innovations)), aim.doubt)
    warnings = (_why_not_held(model, S, history, aim), aim.doubt)
    fit = not any(reasons)
    probing = None if fit else multisine(3 * len(R), model.control_size, *aim.bounds)
    return Verdict(certificate, _said(reasons), _said(warnings), probing)


def _why_early(judged: int) -> str:
    """Until some codes were predicted, nobody knows how well: the noise would seem to be zero."""
    if judged >= RECENT:
        return ""
    return (
        f"the model has proved itself on {judged} frames only; expected {RECENT}: ask again after"
        " the next ones"
    )


def _why_not_held(model: LinearModel, S: Array, history: Array, aim: Aim) -> str:
    target = aim.codes[-1]
    rest = nearest_equilibrium(model, target, aim.query.u_min, aim.query.u_max)
    return why_unreachable(rest, target, history, S)


def _said(sentences: Iterable[str]) -> tuple[str, ...]:
    return tuple(sentence for sentence in sentences if sentence)
