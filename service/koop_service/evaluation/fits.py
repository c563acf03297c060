"""Where Theta comes from: ours (the proximal fit), truncated SVD, and the two learned baselines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from koop_service.estimation.factor_batch import FactorBatch
from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.forecasts import Array, transitions

SVD_THRESHOLD = 1e-3
"""Singular values below this share of the largest are cut; chosen once, not by the test sets."""


class Proximal:
    """Ours: eq. 5 to 7 by the service's own square-root factor, one lane a trajectory."""

    def __init__(self, settings: EstimatorSettings) -> None:
        self.settings = settings

    def thetas(self, codes: Array, controls: Array, lasts: Sequence[int]) -> Iterator[Array]:
        """Theta (N, n, d) after each of the frames `lasts`."""
        lanes = np.arange(len(codes))
        factors, done = FactorBatch(self.settings, len(codes)), 0
        for last in lasts:
            for W, Y in transitions(codes, controls, done + 1, last, self.settings):
                factors.update(lanes, W, Y)
            done = last
            yield np.stack([factors.theta(lane) for lane in range(len(codes))])


class TruncatedSVD:
    """The classical DMD route: Y W^+ with the singular values below a threshold cut (eq. 4)."""

    def __init__(self, settings: EstimatorSettings, threshold: float = SVD_THRESHOLD) -> None:
        self.settings = settings
        self.threshold = threshold

    def thetas(self, codes: Array, controls: Array, lasts: Sequence[int]) -> Iterator[Array]:
        """Theta (N, n, d) after each of the frames `lasts`."""
        for last in lasts:
            pairs = list(transitions(codes, controls, 1, last, self.settings))
            W, Y = (np.stack(part, axis=1) for part in zip(*pairs, strict=True))
            inverse = np.linalg.pinv(W, rcond=self.threshold)
            yield (inverse @ Y).swapaxes(1, 2)


class Constant:
    """Baseline [17]: one Theta (n, d), learned with the autoencoder, for every trajectory."""

    def __init__(self, Theta: Array, settings: EstimatorSettings) -> None:
        expected = (settings.code_size, settings.regressor_size)
        if Theta.shape != expected:
            raise ValueError(f"the learned A has shape {Theta.shape}; expected {expected}")
        self.settings = settings
        self._Theta = Theta

    def thetas(self, codes: Array, controls: Array, lasts: Sequence[int]) -> Iterator[Array]:  # noqa: ARG002
        """The same Theta (N, n, d) after each of the frames `lasts`."""
        for _ in lasts:
            yield np.broadcast_to(self._Theta, (len(codes), *self._Theta.shape))


class ConstantControl:
    """Baseline [6]: B (n, p) is learned with the autoencoder; A and the constant are fitted.

    They are the proximal fit of z_{t+1} - B u_t on the regressor without u_t.
    """

    def __init__(self, B: Array, settings: EstimatorSettings) -> None:
        expected = (settings.code_size, settings.control_size)
        if B.shape != expected:
            raise ValueError(f"the learned B has shape {B.shape}; expected {expected}")
        self.settings = settings
        self._B = B

    def thetas(self, codes: Array, controls: Array, lasts: Sequence[int]) -> Iterator[Array]:
        """Theta (N, n, d) after each of the frames `lasts`."""
        s = self.settings
        hn, unforced = s.history * s.code_size, replace(s, control_size=0, prior_mean=())
        keep = np.r_[0:hn, hn + s.control_size : s.regressor_size]
        lanes = np.arange(len(codes))
        factors, done = FactorBatch(unforced, len(codes)), 0
        for last in lasts:
            for W, Y in transitions(codes, controls, done + 1, last, s):
                u = W[:, hn : hn + s.control_size]
                factors.update(lanes, W[:, keep], Y - u @ self._B.T)
            done = last
            yield self._with_control(np.stack([factors.theta(lane) for lane in range(len(codes))]))

    def _with_control(self, fitted: Array) -> Array:
        hn = self.settings.history * self.settings.code_size
        B = np.broadcast_to(self._B, (len(fitted), *self._B.shape))
        return np.concatenate([fitted[:, :, :hn], B, fitted[:, :, hn:]], axis=2)
