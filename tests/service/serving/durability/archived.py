"""A registry with a real store behind it, and streams of codes for it: no encoder, no network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
from koop_service.serving.sharding.ownership import EVERY_SHARD
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry
from koop_service.serving.trajectories.trajectory import Trajectory

PICTURE = np.zeros((64, 64), np.uint8)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def write_model(folder: Path) -> Path:
    path = folder / "model.safetensors"
    save_weights(path, initialised(8, 0), ModelCard("test", "test", 0.05))
    return path


class House:
    """`most` places in memory. `tasks` are spared; `pressed` is a want of memory."""

    def __init__(self, model: Path, most: int, store: LmdbStore | None, after: float = 0.0) -> None:
        catalogue = Catalogue([ModelEntry("test", model, ("*",))])
        self.metrics, self.clock = Metrics(), Clock()
        self.tasks: set[str] = set()
        self.pressed, self.ends = False, []
        self.registry = Registry(
            catalogue, EstimatorChoices(), Refusals(self.metrics), most, clock=self.clock
        )
        self.registry.ended = lambda *end: self.ends.append(end)
        if store is not None:
            claim = store.claim("test", EVERY_SHARD)
            self.keeper = Keeper(store, claim, lambda *_: None, self.metrics)
            self.snapshotter = Snapshotter(
                self.registry,
                self.keeper,
                Archive(store.find),
                lambda _: False,
                1.0,
                self.clock,
            )
            self.eviction = Eviction(
                self.registry,
                self.snapshotter,
                self.metrics,
                after,
                self.tasks.__contains__,
                lambda: self.pressed,
            )

    def show(self, name: str, seq: int, code: np.ndarray, epoch: str = "0" * 16) -> Trajectory:
        """One frame of a trajectory, as the pipeline has it."""
        frame = Frame(name, epoch, seq, 0, PICTURE, "test")
        trajectory = self.registry.admit(frame)
        trajectory.fold_frame(frame, code)
        self.registry.update_estimators([trajectory])
        if hasattr(self, "snapshotter"):
            self.snapshotter.note([trajectory])
        return trajectory

    def turn(self, seconds: float = 0.0) -> None:
        """Between two batches, some time later."""
        self.clock.now += seconds
        self.snapshotter.step()
        self.eviction.step()


@contextmanager
def housed(folder: Path, model: Path, most: int, after: float = 0.0) -> Iterator[House]:
    """A house whose keeper works, as long as the context is open."""
    store = LmdbStore(folder)
    house = House(model, most, store, after)
    house.keeper.start()
    try:
        yield house
    finally:
        house.keeper.stop()
        store.close()
