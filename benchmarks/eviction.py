"""Trajectories that go to disk and come back: how many a second, and what memory they take.

Thousands of trajectories take turns in a hundred places, as the pipeline's thread has them, with a
real store behind; codes are made up, since the encoder is not what is measured. Times are of the
processor, the thread that stores included.

    python benchmarks/eviction.py                        # 10,000 through 100 places
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from koop_protocol import Frame
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.weights import ModelCard, save_weights
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.durability.archive import Archive
from koop_service.serving.durability.eviction import Eviction
from koop_service.serving.durability.keeper import Keeper
from koop_service.serving.durability.lmdb_store import LmdbStore
from koop_service.serving.durability.snapshotter import Snapshotter
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.instruments.process import own_bytes
from koop_service.serving.sharding.ownership import EVERY_SHARD
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry

PICTURE = np.zeros((64, 64), np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trajectories", type=int, default=10_000)
    parser.add_argument("--places", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    for places in (options.places, options.trajectories):
        with tempfile.TemporaryDirectory() as folder:
            measure(Path(folder), options.trajectories, places, options.rounds)


def measure(folder: Path, trajectories: int, places: int, rounds: int) -> None:
    """Show a frame of each in turn, `rounds` times, and print what it took."""
    metrics, store = Metrics(), LmdbStore(folder)
    registry = registry_of(folder, places, metrics)
    keeper = Keeper(store, store.claim("benchmark", EVERY_SHARD), lambda *_: None, metrics)
    snapshotter = Snapshotter(registry, keeper, Archive(store.find), lambda _: False, 3.0)
    eviction = Eviction(registry, snapshotter, metrics, 0.0, lambda _: False, lambda: False)
    keeper.start()
    codes = np.random.default_rng(0).normal(size=(rounds, 8))
    before, seconds = own_bytes(), []
    for seq, code in enumerate(codes):
        start = time.process_time()
        for number in range(trajectories):
            show(registry, snapshotter, Frame(f"t/{number}", "0" * 16, seq, 0, PICTURE, "b"), code)
            eviction.step()
        seconds.append(time.process_time() - start)
    grown = own_bytes() - before
    snapshotter.finish()
    keeper.stop()
    store.close()
    print(
        f"{trajectories} trajectories in {places} places: {1e6 * seconds[0] / trajectories:.0f} us "
        f"for a first frame, {1e6 * seconds[-1] / trajectories:.0f} us for a later one; "
        f"{metrics.value('koop_evicted_total'):.0f} evictions, "
        f"{metrics.value('koop_revived_total'):.0f} revivals; memory grew by {grown / 1e6:.0f} MB"
    )


def show(registry: Registry, snapshotter: Snapshotter, frame: Frame, code: np.ndarray) -> None:
    trajectory = registry.admit(frame)
    trajectory.fold_frame(frame, code)
    registry.update_estimators([trajectory])
    snapshotter.note([trajectory])
    snapshotter.step()


def registry_of(folder: Path, places: int, metrics: Metrics) -> Registry:
    path = folder / "model.safetensors"
    save_weights(path, initialised(8, 0), ModelCard("benchmark", "b", 0.05))
    catalogue = Catalogue([ModelEntry("benchmark", path, ("*",))])
    return Registry(catalogue, EstimatorChoices(), Refusals(metrics), places)


if __name__ == "__main__":
    main()
