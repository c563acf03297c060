"""Everything once before the first frame: libraries load and compile at their first call.

Unrehearsed, the first query with standard deviations waits a third of a second, and all others
with it.
"""

from __future__ import annotations

import numpy as np

from koop_protocol import LqrQuery
from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.estimator import Bank, warm_up
from koop_service.estimation.settings import EstimatorSettings
from koop_service.prediction.model import LinearModel
from koop_service.prediction.uncertainty import rollout_std
from koop_service.serving.steering.aims import Aim
from koop_service.serving.steering.courses import Course, Schedule
from koop_service.serving.steering.fitness import judge
from koop_service.serving.trajectories.trajectory import Posterior


def rehearse(codec: ImageCodec, settings: EstimatorSettings) -> None:
    """Encode, learn, predict and control nothing in particular; `settings` have a control."""
    warm_up(settings)
    # The largest batch too: the allocator then has what it will ever need.
    pictures = np.zeros((codec.largest_batch, *codec.image_shape), np.float32)
    codec.encode(pictures[:1])
    codec.decode(codec.encode(pictures), np.float32)
    n, h, p = settings.code_size, settings.history, settings.control_size
    bank = Bank(settings)
    lane = bank.open()
    bank.status(lane)
    model = LinearModel.from_theta(bank.theta(lane), settings)
    model.spectral_radius()
    history = np.zeros((h, n))
    posterior = Posterior(bank.covariance(lane), bank.factor(lane).R, bank.innovations(lane))
    rollout_std(model, history, np.zeros((2, p)), posterior.S, posterior.R, settings.ignorance)
    _control(model, posterior, settings, history)


def _control(
    model: LinearModel, posterior: Posterior, settings: EstimatorSettings, history: np.ndarray
) -> None:
    """The verdict, and two plans in a row by each method."""
    n, p = settings.code_size, settings.control_size
    for method in ("qp", "gain"):
        bound = np.ones(p)
        query = LqrQuery(
            2, target_code=np.ones(n), u_min=-bound, u_max=bound, qf="riccati", method=method
        )
        aim = Aim(query, np.ones((1, n)))
        judge(model, posterior, settings, history, aim)
        course = Course(aim, 0, Schedule(0, np.zeros(p)))
        for seq in (0, 1):
            course.plan(model, history, seq)
