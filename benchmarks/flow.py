"""Lattice updates per second of the flow past the cylinder on one core, beside pylbm, in one run.

    python benchmarks/flow.py [--seconds 20] [--json]

A frame is 150 steps of the 448 x 256 lattice, then its picture: crop, four channels, half
precision. pylbm does the same D2Q9 flow on as many cells with a fixed cylinder, in double
precision (it knows no other), with C code that it generates and compiles at each start. It is not
a dependency of koop: the ratio is left out where `import pylbm` fails. Repeats of all are
interleaved; the medians are shown.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pylbm_flow

from koop_clients.flow.cylinder import CylinderFlow
from koop_clients.flow.settings import FlowSettings

SETTINGS = FlowSettings()
CELLS = SETTINGS.shape[0] * SETTINGS.shape[1]

#: Turns of the cylinder [U/D]: a wall that moves is what a live stream needs.
ROTATION = 0.3

#: Does some work once; its number of lattice updates, or 0 for a picture.
Case = tuple[Callable[[], None], int]


def stepping(dtype: Any) -> Case:
    flow = CylinderFlow(SETTINGS, dtype)
    held = [flow.frame(flow.at_rest())]

    def frame() -> None:
        held[0] = flow.frame(held[0], ROTATION)

    return frame, CELLS * SETTINGS.frame_steps


def picture() -> Case:
    flow = CylinderFlow(SETTINGS)
    state = flow.frame(flow.at_rest())

    def draw() -> None:
        flow.picture(state)

    return draw, 0


def peer_pylbm() -> Case | str:
    """pylbm on the same cells, or why not."""
    pylbm = pylbm_flow.load()
    if isinstance(pylbm, str):
        return pylbm
    simulation = pylbm_flow.compiled(pylbm, pylbm_flow.stock(pylbm, SETTINGS))
    return simulation.one_time_step, CELLS


def measure(cases: dict[str, Case], seconds: float) -> dict[str, float]:
    """Median seconds a call of each case, their repeats interleaved for `seconds`."""
    spent: dict[str, list[float]] = {name: [] for name in cases}
    for work, _ in cases.values():
        work()
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or not all(spent.values()):
        for name, (work, _) in cases.items():
            start = time.perf_counter()
            work()
            spent[name].append(time.perf_counter() - start)
    return {name: float(np.median(times)) for name, times in spent.items()}


def summary(cases: dict[str, Case], times: dict[str, float]) -> dict[str, float | None]:
    rates = {name: cases[name][1] / times[name] / 1e6 for name in cases}
    frame = times["single"] + times["picture"]
    peer = rates.get("pylbm")
    return {
        "mlups": rates["single"],
        "mlups_double": rates["double"],
        "frame_ms": 1e3 * frame,
        "picture_ms": 1e3 * times["picture"],
        "picture_share": times["picture"] / frame,
        "pylbm_mlups": peer,
        "ratio_pylbm": None if peer is None else rates["single"] / peer,
        "ratio_pylbm_double": None if peer is None else rates["double"] / peer,
    }


def table(found: dict[str, float | None], missing: str) -> str:
    lines = [
        f"{'one core':46}{'MLUPS':>9}{'ms a frame':>12}",
        _row("koop, single precision", found["mlups"]),
        _row("koop, double precision", found["mlups_double"]),
    ]
    if not missing:
        lines.append(_row("pylbm, double precision", found["pylbm_mlups"]))
        ratios = found["ratio_pylbm"], found["ratio_pylbm_double"]
        lines.append(f"koop over pylbm: {ratios[0]:.1f} (single), {ratios[1]:.1f} (double)")
    share = f"{100 * (found['picture_share'] or 0):.1f}% of {found['frame_ms']:.1f} ms"
    lines.append(f"crop and channels: {found['picture_ms']:.2f} ms, {share}")
    return "\n".join([*lines, missing] if missing else lines)


def _row(label: str, mlups: float | None) -> str:
    assert mlups is not None
    return f"{label:46}{mlups:9.0f}{CELLS * SETTINGS.frame_steps / mlups / 1e3:12.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="how long to repeat [s]")
    parser.add_argument("--json", action="store_true", help="end with one JSON object")
    options = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    cases = {"single": stepping(np.float32), "double": stepping(np.float64), "picture": picture()}
    peer = peer_pylbm()
    if not isinstance(peer, str):
        cases["pylbm"] = peer
    found = summary(cases, measure(cases, options.seconds))
    print(table(found, peer if isinstance(peer, str) else ""))
    if options.json:
        print(json.dumps({k: None if v is None else float(f"{v:.4g}") for k, v in found.items()}))


if __name__ == "__main__":
    main()
