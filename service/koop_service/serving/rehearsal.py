"""Everything once before the first frame: libraries load and compile at their first call.

Unrehearsed, the first query with standard deviations waits a third of a second, and all others
with it.
"""

from __future__ import annotations

import numpy as np

from koop_service.control.problem import build_lqr
from koop_service.control.solve import solve_qp
from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.estimator import Bank, warm_up
from koop_service.estimation.settings import EstimatorSettings
from koop_service.prediction.model import LinearModel
from koop_service.prediction.uncertainty import rollout_std


def rehearse(codec: ImageCodec, settings: EstimatorSettings, batch: int) -> None:
    """Encode, learn, predict and control nothing in particular; `settings` have a control."""
    warm_up(settings)
    pictures = np.zeros((batch + 1, *codec.image_shape), np.uint8)
    for size in range(1, batch + 1):  # each once: the allocator then has what it will ever need
        codec.encode(pictures[:size])
    codec.decode(codec.encode(pictures[:2]), np.uint8)
    n, h, p = settings.code_size, settings.history, settings.control_size
    bank = Bank(settings)
    lane = bank.open()
    bank.status(lane)
    model = LinearModel.from_theta(bank.theta(lane), settings)
    model.spectral_radius()
    history, target = np.zeros((h, n)), np.ones(n)
    S, R = bank.covariance(lane), bank.factor(lane).R
    rollout_std(model, history, np.zeros((2, p)), S, R, settings.rho)
    solve_qp(build_lqr(model, history, target, 2, 1.0, 1.0, -np.ones(p), np.ones(p)))
