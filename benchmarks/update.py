"""Updates per second of the streaming estimator beside its peers, on one core, in one run.

    python benchmarks/update.py [--seconds 20] [--json]

One stream: as a caller in Python sees it, one call a measurement, theta not solved. Batched: one
call folds a measurement into each of B trajectories. Peers do what they offer for the same sizes:
odmd's OnlineDMD (square, so it maps d to d), padasip's RLS (one filter an output) and a NumPy
lstsq refit on the last 100 measurements. Repeats of all are interleaved; the medians are shown.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import itertools
import json
import time
from collections.abc import Callable, Iterator

import numpy as np
import odmd
import padasip

from koop_service.estimation import factor
from koop_service.estimation.factor_batch import FactorBatch
from koop_service.estimation.settings import EstimatorSettings

#: (d, n): the pendulum family and the fluid.
SIZES = {"17_8": EstimatorSettings(8, 2, 1), "65_32": EstimatorSettings(32, 2, 1)}
TRAJECTORIES = 1024
FORGETTING = 0.99
#: What one timing of a one-stream method lasts, about (s): short, so that a busy machine's
#: interruptions spoil some repeats and not all.
SLICE = 2e-3

#: A step takes no argument, folds `count` measurements and returns nothing.
Case = tuple[Callable[[], None], int]


def forgetful(settings: EstimatorSettings) -> EstimatorSettings:
    return EstimatorSettings(
        settings.code_size, settings.history, settings.control_size, forgetting=FORGETTING
    )


def measurements(settings: EstimatorSettings, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    d, n = settings.regressor_size, settings.code_size
    return rng.standard_normal((count, d)), rng.standard_normal((count, n))


def cycle(settings: EstimatorSettings) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Measurements without end, as separate arrays, at next to no cost."""
    return itertools.cycle(list(zip(*measurements(settings, 1000), strict=True)))


def one_stream(settings: EstimatorSettings) -> Case:
    state, source = factor.init(settings), cycle(settings)

    def step() -> None:
        w, y = next(source)
        factor.update(state, settings, w, y)

    return step, 1


def batched(settings: EstimatorSettings) -> Case:
    batch, lanes = FactorBatch(settings, TRAJECTORIES), np.arange(TRAJECTORIES)
    W, Y = measurements(settings, 8 * TRAJECTORIES)
    parts = [slice(k * TRAJECTORIES, (k + 1) * TRAJECTORIES) for k in range(8)]
    turn = itertools.cycle(parts)

    def step() -> None:
        part = next(turn)
        batch.update(lanes, W[part], Y[part])

    return step, TRAJECTORIES


def peer_odmd(settings: EstimatorSettings) -> Case:
    d, n = settings.regressor_size, settings.code_size
    model, source, target = odmd.OnlineDMD(d, FORGETTING), cycle(settings), np.zeros(d)

    def step() -> None:
        w, y = next(source)
        target[:n] = y
        model.update(w, target)

    return step, 1


def peer_padasip(settings: EstimatorSettings) -> Case:
    d, n = settings.regressor_size, settings.code_size
    filters = [padasip.filters.FilterRLS(d, mu=FORGETTING) for _ in range(n)]
    source = cycle(settings)

    def step() -> None:
        w, y = next(source)
        for output, one in zip(y, filters, strict=True):
            one.adapt(output, w)

    return step, 1


def peer_lstsq(settings: EstimatorSettings) -> Case:
    source = cycle(settings)
    W, Y = measurements(settings, 100)
    oldest = itertools.cycle(range(100))

    def step() -> None:
        k = next(oldest)
        W[k], Y[k] = next(source)
        np.linalg.lstsq(W, Y, rcond=None)

    return step, 1


def cases() -> dict[str, Case]:
    found: dict[str, Case] = {}
    for size, settings in SIZES.items():
        found[f"single_{size}"] = one_stream(settings)
        found[f"single_forgetting_{size}"] = one_stream(forgetful(settings))
        found[f"odmd_{size}"] = peer_odmd(settings)
        found[f"padasip_{size}"] = peer_padasip(settings)
        found[f"lstsq100_{size}"] = peer_lstsq(settings)
        found[f"batched_{size}"] = batched(settings)
        found[f"batched_forgetting_{size}"] = batched(forgetful(settings))
    return found


def timed(step: Callable[[], None], calls: int) -> float:
    """Seconds a call."""
    start = time.perf_counter()
    for _ in range(calls):
        step()
    return (time.perf_counter() - start) / calls


def measure(found: dict[str, Case], seconds: float) -> dict[str, float]:
    """Median updates per second of each case, their repeats interleaved for `seconds`."""
    calls = {}
    for name, (step, _) in found.items():
        timed(step, 3)
        calls[name] = max(1, int(SLICE / timed(step, 3)))
    spent: dict[str, list[float]] = {name: [] for name in found}
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or not all(spent.values()):
        for name, (step, _) in found.items():
            spent[name].append(timed(step, calls[name]))
    return {name: found[name][1] / float(np.median(times)) for name, times in spent.items()}


LABELS = {
    "single": "koop, one stream, a Python call each",
    "single_forgetting": f"  the same, forgetting {FORGETTING} with refill",
    "odmd": "odmd OnlineDMD",
    "padasip": "padasip RLS, a filter an output",
    "lstsq100": "numpy lstsq on the last 100",
    "batched": f"koop, batched over {TRAJECTORIES}",
    "batched_forgetting": f"  the same, forgetting {FORGETTING} with refill",
}


def table(rates: dict[str, float]) -> str:
    lines = [f"{'updates per second, one core':42}{'(17, 8)':>14}{'(65, 32)':>14}"]
    for key, label in LABELS.items():
        lines.append(f"{label:42}{rates[f'{key}_17_8']:14,.0f}{rates[f'{key}_65_32']:14,.0f}")
    ratios = [rates[f"single_{size}"] / rates[f"odmd_{size}"] for size in SIZES]
    lines.append(f"{'koop over odmd, one stream':42}{ratios[0]:13.1f}x{ratios[1]:13.1f}x")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="how long to repeat [s]")
    parser.add_argument("--json", action="store_true", help="end with one JSON object")
    options = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rates = measure(cases(), options.seconds)
    print(table(rates))
    if options.json:
        summary = {
            "ratio_odmd": rates["single_17_8"] / rates["odmd_17_8"],
            "ratio_odmd_65_32": rates["single_65_32"] / rates["odmd_65_32"],
            "batched_per_s": rates["batched_17_8"],
            "batched_per_s_65_32": rates["batched_65_32"],
            "batched_per_s_forgetting": rates["batched_forgetting_17_8"],
            "rates": rates,
        }
        print(json.dumps({key: rounded(value) for key, value in summary.items()}))


def rounded(value: float | dict[str, float]) -> float | dict[str, float]:
    if isinstance(value, dict):
        return {key: float(f"{rate:.4g}") for key, rate in value.items()}
    return float(f"{value:.4g}")


if __name__ == "__main__":
    main()
