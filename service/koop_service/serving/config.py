"""What `koop-serve` can be told: frozen settings that check themselves, and their help texts.

The field texts below are what `koop-serve --help` prints. A TOML file has one table for each
section, in the same names (`[network]`, `[estimator]`, ...), and one `[[models]]` for each model.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec

from koop_service.serving.instruments.process import tells_memory
from koop_service.serving.sharding.settings import PlacementSettings

LOOPBACK = "tcp/127.0.0.1:7447"
"""Where a client looks if nobody says otherwise: Zenoh's own port, on this machine only."""


@dataclass(frozen=True)
class NetworkSettings:
    """Zenoh: where clients reach the service."""

    listen: Annotated[
        tuple[str, ...] | None,
        arg(metavar="ENDPOINT ...", help_behavior_hint=f"(default: {LOOPBACK})"),
    ] = None
    """Endpoints of the Zenoh hub in this process, such as tcp/0.0.0.0:7447; port 0 takes any free
    one. Where --connect or --zenoh-config is given there is none by default."""
    connect: Annotated[
        tuple[str, ...], arg(metavar="ENDPOINT ...", help_behavior_hint="(default: none)")
    ] = ()
    """Zenoh routers to join, such as tcp/router:7447; the service waits until one is there."""
    scouting: bool = False
    """Find and be found by multicast on the local network."""
    shared_memory: bool = False
    """Take pictures from sources on this machine through shared memory. One of 260 KB comes about
    a millisecond sooner; but Zenoh keeps about 18 MB for every source that ever connected."""
    zenoh_config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """A raw Zenoh configuration file (JSON5 or YAML), for TLS and access control, such as koop-pki
    writes; its certificates lie beside it. The options above act on top of it, and without them it
    decides alone."""

    def __post_init__(self) -> None:
        if self.listen == ():
            raise ValueError("listen is empty; give an endpoint, or leave it out")
        for endpoint in (*(self.listen or ()), *self.connect):
            if "/" not in endpoint:
                raise ValueError(
                    f"{endpoint!r} is not a Zenoh endpoint; expected protocol/address, such as "
                    f"{LOOPBACK}"
                )
        _require_file("zenoh_config", self.zenoh_config)

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Endpoints to listen on."""
        if self.listen is not None:
            return self.listen
        return () if self.connect or self.zenoh_config else (LOOPBACK,)


@dataclass(frozen=True)
class ModelRule:
    """One model of the user's: weights, and the trajectories that they are for."""

    path: Path
    patterns: tuple[str, ...]
    name: str = ""

    def __post_init__(self) -> None:
        if not self.patterns or not all(self.patterns):
            raise ValueError(
                f"the model {self.path} has no patterns; expected those of its trajectories, "
                "such as 'cartpole/*'"
            )

    @classmethod
    def parse(cls, text: str) -> ModelRule:
        """The rule that a command line gives as PATTERN=PATH."""
        pattern, separator, path = text.rpartition("=")
        if not separator or not pattern:
            raise ValueError(
                f"{text!r} is not a model; expected PATTERN=PATH, such as "
                "'cartpole/*=cartpole.safetensors'"
            )
        return cls(Path(path), (pattern,))


_CARD = "(default: what the model's card recommends)"


@dataclass(frozen=True)
class EstimatorChoices:
    """Estimator of each trajectory."""

    history: Annotated[int | None, arg(metavar="FRAMES", help_behavior_hint=_CARD)] = None
    """Codes in a regressor (h); 2 gives the model velocities."""
    rho: Annotated[float | None, arg(metavar="WEIGHT", help_behavior_hint=_CARD)] = None
    """Weight of the prior, in units of a code's square; larger forgives more noise."""
    forgetting: Annotated[float | None, arg(metavar="WEIGHT", help_behavior_hint=_CARD)] = None
    """Weight of a frame one step older, 0.5 to 1; 1 forgets nothing, 0.99 remembers 100 frames."""
    window: Annotated[
        int | None, arg(metavar="FRAMES", help_behavior_hint="(default: every one)")
    ] = None
    """Newest frames that count at all."""
    affine: Annotated[bool | None, arg(metavar="{True,False}", help_behavior_hint=_CARD)] = None
    """Whether the model has a constant term."""

    def __post_init__(self) -> None:
        _require_at_least("history", self.history, 1)
        _require_at_least("window", self.window, 1)
        if self.rho is not None and not (math.isfinite(self.rho) and self.rho > 0):
            raise ValueError(f"rho is {self.rho}; expected a positive number")
        if self.forgetting is not None and not 0.5 <= self.forgetting <= 1:
            raise ValueError(f"forgetting is {self.forgetting}; expected 0.5 to 1")


@dataclass(frozen=True)
class ComputeSettings:
    """Where and how the encoder runs."""

    device: str = "cpu"
    """torch device of the encoder: cpu, cuda, cuda:1."""
    threads: int = 1
    """Processor threads of the encoder. One core encodes about 4,500 frames a second."""
    batch: int = 64
    """Most frames encoded at once. A query waits for the batch in work, so this trades answer time
    for throughput; on a GPU, which always encodes 128 pictures at once, so many and more pay."""

    def __post_init__(self) -> None:
        _require_at_least("threads", self.threads, 1)
        _require_at_least("batch", self.batch, 1)


@dataclass(frozen=True)
class LimitSettings:
    """What the service is willing to take."""

    max_trajectories: int = 10_000
    """Trajectories in memory at once; for a further one the longest idle goes to disk."""
    evict_after: float = 900.0
    """Time without a message or a query after which a trajectory leaves memory for the disk [s];
    the next one brings it back, with the same bits. 0: none leaves, but to make room."""
    queue_messages: int = 2048
    """Measurements waiting at once; then the sources are held back, nothing is dropped."""
    queue_bytes: int = 64 << 20
    """Bytes of measurements waiting at once, then the sources are held back; and of each kind of
    query."""
    queue_queries: int = 256
    """Queries of each kind waiting at once; further ones are answered 'overloaded'."""
    max_query_rate: int = 1000
    """Predictions a second on one key; further ones are answered 'overloaded'. 0 is no limit."""
    max_memory: int = 0
    """Memory of the process [bytes] from which on a further trajectory takes another's place and
    costly predictions are answered 'overloaded'; 0 is no limit. A container's own limit should be a
    fifth larger."""
    max_message_bytes: int = 4 << 20
    """Largest message that is taken in [bytes]."""
    max_reply_bytes: int = 32 << 20
    """Largest answer [bytes]. Predicted frames fill it: 127 of the flow past the cylinder, which
    take half a second to draw."""
    max_horizon: int = 1000
    """Longest prediction or control sequence [frames]."""

    def __post_init__(self) -> None:
        for name in ("max_trajectories", "queue_messages", "queue_queries", "max_horizon"):
            _require_at_least(name, getattr(self, name), 1)
        for name in ("max_message_bytes", "max_reply_bytes"):
            _require_at_least(name, getattr(self, name), 1024)
        if not 0 <= self.evict_after < math.inf:
            raise ValueError(f"evict_after is {self.evict_after}; expected 0 or more seconds")
        for name in ("max_query_rate", "max_memory"):
            _require_at_least(name, getattr(self, name), 0)
        if self.max_memory and not tells_memory():
            raise ValueError("max_memory needs /proc, which this system has not; leave it at 0")
        _require_at_least("queue_bytes", self.queue_bytes, self.max_message_bytes)


@dataclass(frozen=True)
class DurabilitySettings:
    """What survives a kill of the service."""

    snapshot_every: Annotated[float, arg(metavar="SECONDS")] = 3.0
    """Time between two snapshots of all estimators that have changed; 0 takes one at the end only.
    Sources that keep a log need not keep what is in a snapshot."""

    forget_after: Annotated[float, arg(metavar="DAYS")] = 0.0
    """Time without a message or a query after which a trajectory's state is deleted from the disk;
    0 keeps all of them for ever."""

    def __post_init__(self) -> None:
        every, days = self.snapshot_every, self.forget_after
        if not (math.isfinite(every) and (every == 0 or every >= 0.1)):
            raise ValueError(f"snapshot_every is {every}; expected 0, or 0.1 s or more")
        if not (math.isfinite(days) and days >= 0):
            raise ValueError(f"forget_after is {days}; expected 0, or a number of days above it")


@dataclass(frozen=True)
class MonitoringSettings:
    """Metrics and logs."""

    metrics_port: Annotated[
        int | None, arg(metavar="PORT", help_behavior_hint="(default: none are served)")
    ] = None
    """Serve Prometheus metrics on this port; 0 takes any free one."""
    metrics_address: str = "127.0.0.1"
    """Address that the metrics are served on; 0.0.0.0 shows them to the network."""
    log_format: Literal["text", "json"] = "text"
    """Logs on standard error: text for people, json with one object a line for machines."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severe log lines shown."""
    stuck_after: float = 60.0
    """Time without a turn of the pipeline, or in which nothing could be encoded, after which it is
    taken for stuck and every thread's stack is logged [s], 2 or more; 0 never looks."""
    exit_when_stuck: bool = True
    """End a stuck process, for its supervisor to start anew: it answers nobody and holds its
    sources back, while a new one continues from the last snapshots."""

    def __post_init__(self) -> None:
        _require_at_least("metrics_port", self.metrics_port, 0)
        if not (self.stuck_after == 0 or 2 <= self.stuck_after < math.inf):
            raise ValueError(f"stuck_after is {self.stuck_after}; expected 0, or 2 or more")
        _require_one_of("log_format", self.log_format, ("text", "json"))
        _require_one_of("log_level", self.log_level, ("debug", "info", "warning", "error"))


_RULE = PrimitiveConstructorSpec(
    nargs=1,
    metavar="PATTERN=FILE",
    instance_from_str=lambda words: ModelRule.parse(words[0]),
    is_instance=lambda value: isinstance(value, ModelRule),
    str_from_instance=lambda rule: [f"{rule.patterns[0]}={rule.path}"],
)


def default_state_folder() -> Path:
    """`koop` in the user's state folder, as the XDG base directory specification has it."""
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if base.startswith("/") else Path.home() / ".local" / "state") / "koop"


@dataclass(frozen=True)
class ServiceConfig:
    """Everything that `koop-serve` can be told."""

    models: Annotated[
        tuple[Annotated[ModelRule, _RULE], ...],
        arg(metavar="PATTERN=FILE ...", help_behavior_hint="(default: the bundled models)"),
    ] = ()
    """Models that go before the bundled ones, such as 'line3/*=mine.safetensors', or the name of a
    bundled one, such as 'line3/*=pendulum-high': a trajectory takes the first whose pattern
    matches its name."""
    state_folder: Annotated[Path, arg(metavar="FOLDER")] = field(
        default_factory=default_state_folder
    )
    """Where the estimators are kept from one run to the next."""
    state_store: Annotated[
        str | None, arg(metavar="URL", help_behavior_hint="(default: the state folder)")
    ] = None
    """A PostgreSQL database that keeps them instead, for workers on several machines, such as
    postgresql://koop@db/koop; needs koop[cluster]. Passwords belong into PGPASSWORD or a
    PGPASSFILE."""
    network: NetworkSettings = field(default_factory=NetworkSettings)
    placement: PlacementSettings = field(default_factory=PlacementSettings)
    estimator: EstimatorChoices = field(default_factory=EstimatorChoices)
    compute: ComputeSettings = field(default_factory=ComputeSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    durability: DurabilitySettings = field(default_factory=DurabilitySettings)
    monitoring: MonitoringSettings = field(default_factory=MonitoringSettings)

    def __post_init__(self) -> None:
        store = self.state_store
        if store is not None and not store.startswith(("postgresql://", "postgres://")):
            raise ValueError(
                f"state_store is {store!r}; expected postgresql://USER@HOST/DATABASE, or leave it "
                "out to use --state-folder"
            )


def _require_at_least(name: str, value: object, least: int) -> None:
    if value is None and name in ("history", "window", "metrics_port"):
        return
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} is {value!r}; expected a whole number, {least} or more")


def _require_one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} is {value!r}; expected one of {', '.join(choices)}")


def _require_file(name: str, path: Path | None) -> None:
    if path is not None and not path.is_file():
        raise ValueError(f"{name}: there is no file {path}")
