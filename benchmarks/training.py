"""Training's frames per second against the machine's own matrix product; memory of a training run.

    python benchmarks/training.py [--seconds 60] [--trajectories 1200] [--threads 1] [--json]

Limit: float32 matrix products of 1024 x 1024, in the same process, thread count and run. A stage's
share of it: the floating-point operations of one training step, counted by torch (convolutions and
matrix products, forward and backward; normalisation, pooling and the optimiser are not counted),
over the time of that step. Repeats of all are interleaved; the medians are shown.
Memory: the largest resident set of a `koop-train --preset cpu` of 220 steps on a recording of the
usual size (1200 trajectories of 200 frames); most is the recording and what is held of its frozen
blocks' outputs. No figure depends on what the frames show.
"""

import argparse
import dataclasses
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from koop_protocol import recording as names
from koop_service.learning.hardware import choose
from koop_service.learning.objective import Loss
from koop_service.learning.presets import PRESETS, Preset
from koop_service.learning.recording import Recording
from koop_service.learning.train import Setting, Training, advance, begin

FRAMES, DT, SIDE = 200, 0.05, 1024
#: More than any measurement takes: stages are measured while they run.
ENDLESS = 1_000_000

#: Runs one step and returns the frames that it trained on.
Step = Callable[[], int]


def pictures(trajectories: int) -> np.ndarray:
    """A disc that swings (N, T, 64, 64) uint8."""
    rows, columns = np.mgrid[:64, :64]
    frames = np.empty((trajectories, FRAMES, 64, 64), np.uint8)
    for i, angle in enumerate(np.random.default_rng(0).uniform(0, 6.28, trajectories)):
        x = 32 + 20 * np.sin(0.3 * np.arange(FRAMES) + angle)[:, None, None]
        frames[i] = 255 * ((columns - x) ** 2 + (rows - 40) ** 2 < 16)
    return frames


def recording(trajectories: int) -> Recording:
    controls = np.zeros((trajectories, FRAMES - 1, 0))
    return Recording(pictures(trajectories), controls, "disc", "", DT, 0)


def schedule(warm_up: int, steps: int, frozen_blocks: int) -> Preset:
    """The cpu preset with the whole horizon from the second step on."""
    preset = PRESETS["cpu"]
    return dataclasses.replace(
        preset,
        autoencoder=dataclasses.replace(preset.autoencoder, steps=warm_up),
        dynamics=dataclasses.replace(preset.dynamics, steps=steps),
        growth=0.0,
        frozen_blocks=frozen_blocks,
    )


def stage(preset: Preset, data: Recording) -> Step:
    """The steps of the first stage of `preset` that has any."""
    setting = Setting(data, preset, 0, choose("cpu", "float32"))
    training: Training = begin(setting, "fitted")
    losses: Iterator[Loss] = advance(training, setting)
    return lambda: next(losses).frames


def stages() -> dict[str, Step]:
    data = recording(16)
    return {
        "autoencoder": stage(schedule(ENDLESS, 0, 0), data),
        "dynamics": stage(schedule(0, ENDLESS, PRESETS["cpu"].frozen_blocks), data),
        "end_to_end": stage(schedule(0, ENDLESS, 0), data),
    }


def operations(step: Step) -> float:
    """Floating-point operations a frame, by torch's count of one step."""
    with FlopCounterMode(display=False) as counter:
        frames = step()
    return counter.get_total_flops() / frames


def limit() -> float:
    """Floating-point operations a second of a matrix product."""
    a = torch.rand(SIDE, SIDE)
    start = time.perf_counter()
    for _ in range(3):
        a @ a
    return 3 * 2 * SIDE**3 / (time.perf_counter() - start)


def rate(step: Step) -> float:
    """Frames a second of one step."""
    start = time.perf_counter()
    return step() / (time.perf_counter() - start)


def measure(seconds: float) -> dict[str, dict[str, float]]:
    """Of each stage: frames and operations a second, and the share of the limit."""
    steps = stages()
    for step in steps.values():  # fills the caches, and reaches the whole horizon
        step()
    counted = {name: operations(step) for name, step in steps.items()}
    rates: dict[str, list[float]] = {name: [] for name in steps}
    limits: list[float] = [limit()]
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(limits) < 4:
        limits.append(limit())
        for name, step in steps.items():
            rates[name].append(rate(step))
    most = float(np.median(limits[1:]))
    found = {name: float(np.median(values)) for name, values in rates.items()}
    return {
        "limit": {"gflop_per_s": most / 1e9},
        **{
            name: {
                "frames_per_s": found[name],
                "mflop_per_frame": counted[name] / 1e6,
                "share_of_limit": found[name] * counted[name] / most,
            }
            for name in steps
        },
    }


def write(path: Path, trajectories: int) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset(
            names.FRAMES_DATASET,
            data=pictures(trajectories),
            chunks=(1, FRAMES, 64, 64),
            **hdf5plugin.Zstd(3),
        )
        file[names.CONTROLS_DATASET] = np.zeros((trajectories, FRAMES - 1, 0))
        file[names.PARAMETERS_DATASET] = ["{}"] * trajectories
        file.attrs.update(
            {
                names.FORMAT_ATTRIBUTE: names.RECORDING_FORMAT,
                names.VERSION_ATTRIBUTE: names.RECORDING_VERSION,
                names.SYSTEM_ATTRIBUTE: "disc",
                names.RENDERER_ATTRIBUTE: "",
                names.DT_ATTRIBUTE: DT,
                names.SEED_ATTRIBUTE: 0,
            }
        )


def memory(trajectories: int, threads: int) -> float:
    """Largest resident set of a short training run, judged as any [GB]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "disc.h5"
        write(path, trajectories)
        command = [sys.executable, "-m", "koop_service.learning.cli", str(path)]
        options = ["--out", f"{folder}/disc.safetensors", "--warm-up=20", "--steps=200"]
        command += [*options, f"--threads={threads}"]
        subprocess.run(command, check=True, stdout=sys.stderr)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e9


def table(found: dict[str, dict[str, float]], gigabytes: float, options: argparse.Namespace) -> str:
    labels = {
        "autoencoder": "the autoencoder alone",
        "dynamics": "with dynamics, three blocks frozen",
        "end_to_end": "with dynamics, end to end",
    }
    lines = [
        f"float32 matrix product, {options.threads} threads: "
        f"{found['limit']['gflop_per_s']:.0f} GFLOP/s",
        f"{'training':36}{'frames/s':>12}{'MFLOP/frame':>14}{'of the limit':>14}",
    ]
    for name, label in labels.items():
        f = found[name]
        lines.append(
            f"{label:36}{f['frames_per_s']:12,.0f}{f['mflop_per_frame']:14.1f}"
            f"{f['share_of_limit']:13.0%}"
        )
    lines.append(f"memory, {options.trajectories} x {FRAMES} frames: {gigabytes:.2f} GB")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to repeat [s]")
    parser.add_argument("--trajectories", type=int, default=1200, help="of the recording in memory")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--json", action="store_true", help="end with one JSON object")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    found = measure(options.seconds)
    gigabytes = memory(options.trajectories, options.threads)
    print(table(found, gigabytes, options))
    if options.json:
        print(json.dumps({**found, "memory_gb": round(gigabytes, 2), "threads": options.threads}))


if __name__ == "__main__":
    main()
