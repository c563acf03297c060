"""Prometheus metrics of one service: counters by event, no labels by trajectory."""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server

_SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)


class Metrics:
    """All metrics; the pipeline adds to them once a batch, not once a frame."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.frames = self._counter("frames", "Frames folded into an estimator")
        self.controls = self._counter("controls", "Controls folded into an estimator")
        self.updates = self._counter("updates", "Transitions that an estimator learned from")
        self.rejected = self._counter("rejected", "Messages rejected, by reason", ["reason"])
        self.lost = self._counter("lost", "Messages taken in and then lost by a fault of ours")
        self.refused = self._counter("refused", "Queries answered by an error, by code", ["code"])
        self.unsent = self._counter("unsent", "Answers given up because callers did not read them")
        self.evicted = self._counter("evicted", "Trajectories that left memory for the disk")
        self.revived = self._counter("revived", "Trajectories that came back from the disk")
        self.shed = self._counter("shed", "Queries refused to make room, by reason", ["reason"])
        self.stuck = self._counter("stuck", "Times the pipeline stood still for too long")
        self.held = self._counter("held", "Times a source was held back by a full queue")
        self.commands = self._counter("commands", "Commands put, by the plan's status", ["status"])
        self.replays = self._counter("replays", "Questions to the logs of sources")
        self.replayed = self._counter("replayed", "Messages folded out of the logs of sources")
        self.deferred = self._counter(
            "deferred", "Live messages passed over while the logs of their sources were read"
        )
        self.snapshots = self._counter("snapshots", "States of trajectories stored")
        self.forgotten = self._counter("forgotten", "States deleted, unheard of for too long")
        self.unstored = self._counter("unstored", "Batches of states that could not be stored")
        self.batch = Histogram(
            "koop_batch_frames",
            "Frames in one encoder batch",
            buckets=(1, 2, 4, 8, 16, 32, 64, 128, 256, 512),
            registry=self.registry,
        )
        self.encoding = Histogram(
            "koop_encode_seconds",
            "Time to encode one batch [s]",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.queries = Histogram(
            "koop_query_seconds",
            "Time from a query's arrival to its last answer [s]",
            ["kind"],
            buckets=_SECONDS,
            registry=self.registry,
        )

        self.commanding = Histogram(
            "koop_command_seconds",
            "Time from a frame's arrival to its command's hand-out [s]",
            buckets=_SECONDS,
            registry=self.registry,
        )

        self.catching_up = Histogram(
            "koop_catch_up_seconds",
            "Time from a trajectory's falling behind until it follows its source again [s]",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.storing = Histogram(
            "koop_store_seconds",
            "Time to store one batch of states [s]",
            buckets=_SECONDS,
            registry=self.registry,
        )

    def watch(self, name: str, text: str, read: Callable[[], float]) -> None:
        """A gauge that is read when somebody asks."""
        Gauge(f"koop_{name}", text, registry=self.registry).set_function(read)

    def value(self, name: str, **labels: str) -> float:
        """A metric's present value, 0 where it never happened."""
        return self.registry.get_sample_value(name, labels) or 0.0

    def serve(self, port: int, address: str) -> tuple[int, Callable[[], None]]:
        """Serve them over HTTP; returns the port and a function that stops it."""
        server, thread = start_http_server(port, address, self.registry)

        def stop() -> None:
            server.shutdown()
            server.server_close()
            thread.join(1.0)

        return server.server_port, stop

    def _counter(self, name: str, text: str, labels: list[str] | None = None) -> Counter:
        return Counter(f"koop_{name}", text, labels or [], registry=self.registry)
