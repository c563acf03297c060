"""A trajectory whose codes are those of a known linear system: its pictures are never looked at."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.linalg import solve_discrete_are

from koop_protocol import Control, Frame
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.weights import EstimatorDefaults, ModelCard, save_weights
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.trajectories.records import snapshot_of
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.sealing import seal
from koop_service.serving.trajectories.trajectory import Trajectory

N = 8
EPOCH = "0" * 16
PICTURE = np.zeros((64, 64), np.uint8)


def registry_of(folder: Path, figures: Mapping[str, object] | None = None) -> Registry:
    path = folder / "linear.safetensors"
    card = ModelCard(
        "test", "test", 0.05, estimator=EstimatorDefaults(affine=False), figures=figures or {}
    )
    save_weights(path, initialised(N, 0), card)
    catalogue = Catalogue([ModelEntry("test", path, ("*",))])
    return Registry(catalogue, EstimatorChoices(), Refusals(Metrics()), 100)


class Plant:
    """z_{k+1} = A z_k + B u_k + noise, one mode of which grows by 5% a step if left alone."""

    def __init__(
        self,
        registry: Registry,
        name: str = "cart/0",
        controls: int = 1,
        noise: float = 1e-3,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        basis = np.linalg.qr(rng.normal(size=(N, N)))[0]
        self.A = basis @ np.diag(np.linspace(0.3, 1.05, N)) @ basis.T
        self.B = rng.normal(size=(N, controls))
        self.K = _gain(self.A, self.B)
        self.code = np.zeros(N)
        self.epoch = EPOCH
        self.seq = -1
        self._registry = registry
        self._name = name
        self._noise = noise
        self._rng = rng
        self.show()

    @property
    def trajectory(self) -> Trajectory:
        found = self._registry.find(self._name)
        assert found is not None
        return found

    def trajectory_records(self) -> Mapping[str, bytes]:
        """What the service would store now."""
        return {t.name: seal(snapshot_of(t)) for t in self._registry}

    def show(self) -> None:
        """The next frame is folded."""
        self.seq += 1
        size = self.B.shape[1]
        frame = Frame(self._name, self.epoch, self.seq, size, PICTURE, "test")
        trajectory = self._registry.admit(frame)
        trajectory.fold_frame(frame, self.code.copy())
        self._registry.update_estimators([trajectory])

    def step(self, u: np.ndarray, *, told: bool = True) -> None:
        """The control acts until the next frame, and the service hears of it or does not."""
        if told:
            self.trajectory.fold_control(Control(self._name, self.epoch, self.seq, u))
        noise = self._noise * self._rng.normal(size=N)
        self.code = self.A @ self.code + self.B @ u + noise
        self.show()

    def excite(self, frames: int = 120) -> Plant:
        """Random controls, about a feedback that holds it."""
        for _ in range(frames):
            self.step(0.3 * self._rng.normal(size=self.B.shape[1]) - self.K @ self.code)
        return self


def _gain(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    R = np.eye(B.shape[1])
    P = solve_discrete_are(A, B, np.eye(N), R)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
