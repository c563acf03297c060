"""Codes that are exactly linear, and results made up of known errors."""

from __future__ import annotations

import dataclasses

import numpy as np

from koop_service.encoding.weights import ModelCard
from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.assessment import Result
from koop_service.evaluation.forecasts import roll_out
from koop_service.evaluation.systems import SYSTEMS

SETTINGS = EstimatorSettings(code_size=2, history=2, control_size=1, affine=True, rho=1e-10)


def random_theta(rng: np.random.Generator) -> np.ndarray:
    """A slow rotation that neither dies nor grows, with random B and c: (2, 6)."""
    angle = rng.uniform(0.2, 0.5)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    older = 0.1 * np.eye(2)
    newer = rotation - older @ rotation.T  # so that z_t = rotation^t z_0 solves the recursion
    return np.concatenate([older, newer, rng.normal(size=(2, 2))], axis=1)


def linear_codes(
    trajectories: int = 3, frames: int = 40, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Codes (N, T, 2), controls (N, T-1, 1) and Theta (N, 2, 6), each trajectory with its own."""
    rng = np.random.default_rng(seed)
    Theta = np.stack([random_theta(rng) for _ in range(trajectories)])
    controls = rng.normal(size=(trajectories, frames - 1, 1))
    start = rng.normal(size=(trajectories, 2, 2))
    rest = roll_out(Theta, start, controls[:, 1:], SETTINGS)
    return np.concatenate([start, rest], axis=1), controls, Theta


def made_up_result(name: str, seed: int = 0, **levels: float) -> Result:
    """A result in which each method errs by the RMSE `levels` says after the fit, 0.02 before.

    Methods are named with underscores: learned_A. Those not named err by their place in a list.
    """
    system = SYSTEMS[name]
    rng = np.random.default_rng(seed)
    known = {"reconstruction": 0.02, "full": 0.021, "partial": 0.05, "offline": 0.1}
    known |= {"repeat-last": 0.2, "mean-frame": 0.15}
    known |= {method.replace("_", "-"): level for method, level in levels.items()}
    errors = {}
    for method, level in known.items():
        rmse = np.full((5, system.frames), 0.02)
        rmse[:, system.fit_frames :] = level
        errors[method] = rmse**2
    strip = {
        method: rng.integers(0, 255, (system.frames, 64, 64), dtype=np.uint8)
        for method in ("truth", *errors)
    }
    card = ModelCard("pendulum", "test", 0.05, training={"frames": 100, "command": "koop-train"})
    angles = {"offline": np.deg2rad([1.0, 2.0, 3.0, 4.0, 50.0])} if system.reads_angle else {}
    return Result(system, card, "0123456789abcdef", 0.05, errors, strip, angles)


def growing(result: Result, method: str, last: float) -> Result:
    """`result` with a method whose RMSE grows evenly from the fit to `last` at the end."""
    first = result.system.fit_frames
    errors = {m: e.copy() for m, e in result.errors.items()}
    steps = errors[method][:, first:]
    steps[:] = np.linspace(np.sqrt(steps[0, 0]), last, steps.shape[1]) ** 2
    return dataclasses.replace(result, errors=errors)
