"""Rounding error, drift and rest of the streaming estimator, against 50-digit arithmetic.

    python benchmarks/accuracy.py [--json]

Rounding: the factor takes K = 100 measurements one by one (d = 16, n = 8), then Theta_4 at
rho = 1e-8 is compared with Theta_4 of the paper's eq. 7 solved in 50 digits from the same float64
data, relative in the Frobenius norm: only rounding is left. Targets carry noise of 1e-3, as codes
do, so that no data set is consistent. Medians and maxima of several draws.
Drift: the same after a million updates whose exact sums are known; and a sliding window.
Rest: a day of identical frames (1.7 million at 20 a second), then motion; see `rest.py`.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "service" / "estimation"))

import oracles
import rest

from koop_service.estimation import factor
from koop_service.estimation.factor_batch import FactorBatch
from koop_service.estimation.proximal import solve
from koop_service.estimation.settings import EstimatorSettings

N, D, K, RHO, ITERATIONS, DRAWS = 8, 16, 100, 1e-8, 4, 5
NOISE = 1e-3
#: Frames of a day at 20 a second.
DAY = 1_728_000
UPDATES = 1_000_000
#: Just before a window's periodic rebuild, when its drift is largest.
WINDOW_UPDATES = 99_999

Draw = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]


def noisy(regressors: oracles.Regressors) -> Draw:
    """Targets of a random model, with noise."""

    def draw(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        W = regressors(rng, K, D)
        model = rng.standard_normal((D, N)) / np.sqrt(D)
        return W, W @ model + NOISE * rng.standard_normal((K, N))

    return draw


#: Data, and the error that a square-root method is known to reach on such (None: not known).
DATA: dict[str, tuple[Draw, float | None]] = {
    "well": (noisy(oracles.conditioned(1.8)), 1e-15),
    "cond_1e6": (noisy(oracles.conditioned(1e6)), 5e-11),
    "cond_1e10": (noisy(oracles.conditioned(1e10)), None),
    "singular": (noisy(oracles.singular), 5e-9),
    "pendulum": (lambda rng: oracles.lifted_pendulum(rng, K, N), 8e-14),
}


def streamed(W: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """Theta_4 as the service computes it, in 50-digit numbers."""
    settings = EstimatorSettings(N, history=D // N, rho=RHO, refinements=ITERATIONS)
    state = factor.init(settings)
    for w, y in zip(W, Y, strict=True):
        factor.update(state, settings, w, y)
    return oracles.exact(solve(state.R, state.D, RHO, ITERATIONS))


def by_gram(W: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """Theta_4 from the normal equations in float64, the method not taken."""
    M, Theta_T = W.T @ W + RHO * np.eye(D), np.zeros((D, N))
    for _ in range(ITERATIONS):
        Theta_T = np.linalg.solve(M, W.T @ Y + RHO * Theta_T)
    return oracles.exact(Theta_T.T)


def relative(found: np.ndarray, wanted: np.ndarray) -> float:
    difference = oracles.rounded(found - wanted)
    return float(np.linalg.norm(difference) / np.linalg.norm(oracles.rounded(wanted)))


def rounding(draw: Draw) -> dict[str, float]:
    """Median and largest error of the streamed Theta_4, the median of the normal equations'."""
    ours, gram = [], []
    for seed in range(DRAWS):
        W, Y = draw(np.random.default_rng(seed))
        wanted = oracles.theta_kkt(W, Y, RHO, ITERATIONS)
        ours.append(relative(streamed(W, Y), wanted))
        gram.append(relative(by_gram(W, Y), wanted))
    return {"median": float(np.median(ours)), "max": max(ours), "gram": float(np.median(gram))}


def drift(draw: Draw) -> dict[str, float]:
    """Relative errors of R^T R and of Theta_4 after a million updates, and Theta_4's after a tenth.

    The same 100 measurements come again and again, so the exact sums are known.
    """
    settings = EstimatorSettings(N, history=D // N, rho=RHO, refinements=ITERATIONS)
    W, Y = draw(np.random.default_rng(0))
    batch, lanes, errors = FactorBatch(settings), np.zeros(100 * K, dtype=np.int64), {}
    for updates in range(100 * K, UPDATES + 1, 100 * K):
        batch.update(lanes, np.tile(W, (100, 1)), np.tile(Y, (100, 1)))
        if updates in (UPDATES // 10, UPDATES):
            M, Theta = repeated(W, Y, updates // K)
            errors[f"theta_{updates}"] = relative(oracles.exact(batch.theta(0)), Theta)
    R = oracles.exact(batch.extract(0).R)
    return {**errors, "information": relative(R.T @ R, M)}


def repeated(W: np.ndarray, Y: np.ndarray, times: int) -> tuple[np.ndarray, np.ndarray]:
    """Exact R^T R and Theta_4 when each measurement came `times` times."""
    W, Y = oracles.exact(W), oracles.exact(Y)
    M = times * (W.T @ W) + oracles.exact(RHO * np.eye(D))
    L, Theta_T = oracles.factorise(M), oracles.exact(np.zeros((D, N)))
    for _ in range(ITERATIONS):
        Theta_T = oracles.solve_factorised(L, times * (W.T @ Y) + RHO * Theta_T)
    return M, Theta_T.T


def window_drift() -> float:
    """Relative error of R^T R after many updates with a window of 200."""
    settings = EstimatorSettings(N, history=D // N, rho=1e-2, window=200)
    rng, batch = np.random.default_rng(0), FactorBatch(settings)
    W, Y = rng.standard_normal((WINDOW_UPDATES, D)), rng.standard_normal((WINDOW_UPDATES, N))
    batch.update(np.zeros(len(W), dtype=np.int64), W, Y)
    R, last = oracles.exact(batch.extract(0).R), oracles.exact(W[-200:])
    return relative(R.T @ R, last.T @ last + settings.rho * oracles.exact(np.eye(D)))


def rested() -> dict[str, rest.Recovery]:
    levels = {"zero": np.zeros(N), "still": np.random.default_rng(1).standard_normal(N)}
    return {
        f"{forgetting}_{name}": rest.rest_then_move(forgetting, DAY, z0)
        for forgetting in (0.9, 0.99)
        for name, z0 in levels.items()
    }


def report(
    errors: dict[str, dict[str, float]],
    drifts: dict[str, dict[str, float]],
    window: float,
    recoveries: dict[str, rest.Recovery],
) -> str:
    lines = [f"{'rounding error of Theta_4':28}{'median':>10}{'max':>10}{'known':>10}{'gram':>10}"]
    for name, error in errors.items():
        known = DATA[name][1]
        shown = f"{known:10.0e}" if known else f"{'-':>10}"
        lines.append(
            f"{name:28}{error['median']:10.1e}{error['max']:10.1e}{shown}{error['gram']:10.1e}"
        )
    lines += ["", f"{'drift, 1,000,000 updates':28}{'at a tenth':>12}{'Theta_4':>10}{'R^T R':>10}"]
    for name, error in drifts.items():
        lines.append(f"{name:30}" + "".join(f"{value:10.1e}" for value in error.values()))
    lines += [f"{f'window of 200, {WINDOW_UPDATES:,} updates':50}{window:10.1e}", ""]
    lines.append("after a day at rest             finite   frames until motion is learned")
    for name, recovery in recoveries.items():
        lines.append(f"{name:28}{recovery.finite!s:>10}{recovery.frames:10d}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="end with one JSON object")
    options = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    errors = {name: rounding(draw) for name, (draw, _) in DATA.items()}
    drifts = {name: drift(DATA[name][0]) for name in ("well", "cond_1e6", "singular")}
    window, recoveries = window_drift(), rested()
    print(report(errors, drifts, window, recoveries))
    if options.json:
        summary = {
            **{f"rounding_{name}": error["median"] for name, error in errors.items()},
            **{f"rounding_max_{name}": error["max"] for name, error in errors.items()},
            **{f"drift_{name}": error[f"theta_{UPDATES}"] for name, error in drifts.items()},
            "drift_information": max(error["information"] for error in drifts.values()),
            "drift_window": window,
            "rest_finite": all(recovery.finite for recovery in recoveries.values()),
            "rest_frames": max(recovery.frames for recovery in recoveries.values()),
        }
        print(json.dumps(summary))


if __name__ == "__main__":
    main()
