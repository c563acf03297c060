"""Zenoh keys of koop: what is sent where (docs/wire.md, "Keys").

A measurement's key carries a *shard*, so that a worker takes over thousands of trajectories
with a few subscriptions instead of one each.
"""

from __future__ import annotations

import re
import zlib
from enum import StrEnum
from typing import NamedTuple

from koop_protocol.errors import ErrorCode, ProtocolError
from koop_protocol.limits import MAX_NAME_LENGTH

SHARDS = 64
"""Number of shards; part of the contract, since both ends compute the shard."""

FRAMES = "koop/frame/**"
CONTROLS = "koop/control/**"
REPLAYS = "koop/replay/**"
PREDICTIONS = "koop/predict/**"
LQRS = "koop/lqr/**"
COMMANDS = "koop/command/**"
STATES = "koop/state/**"
DURABLES = "koop/durable/**"
HEALTH = "koop/health"
"""Key on which every worker says that it lives."""
CLIENT_TOKENS = "koop/@client/*"
"""Liveliness tokens of the clients that own tasks."""
SOURCE_TOKENS = "koop/@source/**"
"""Liveliness tokens of the trajectories whose source keeps a log."""

MAX_OWNER_LENGTH = 64
"""Longest name of an owner."""

# "@" is not in the set, so no chunk can be one of Zenoh's verbatim chunks.
_TRAJECTORY = re.compile(r"[A-Za-z0-9_.-]+(?:/[A-Za-z0-9_.-]+)*", re.ASCII)
_OWNER = re.compile(r"[A-Za-z0-9_.-]+", re.ASCII)
_REMEDY = "name the trajectory like 'cartpole/0' or 'line3/robot7'"


class KeyKind(StrEnum):
    """The second chunk of a key."""

    frame = "frame"
    control = "control"
    replay = "replay"
    predict = "predict"
    lqr = "lqr"
    command = "command"
    state = "state"
    durable = "durable"
    health = "health"


_SHARDED = frozenset({KeyKind.frame, KeyKind.control, KeyKind.replay, KeyKind.durable})
_KINDS = {kind.value: kind for kind in KeyKind if kind is not KeyKind.health}
"""Those whose keys name a trajectory."""


class KoopKey(NamedTuple):
    """A key taken apart."""

    kind: KeyKind
    trajectory: str


def check_trajectory(name: object, max_length: int = MAX_NAME_LENGTH) -> str:
    """Return ``name`` if it names a trajectory, else raise ProtocolError (wrong_type, bad_key)."""
    if not isinstance(name, str):
        raise ProtocolError(
            ErrorCode.wrong_type,
            f"the trajectory's name is of type {type(name).__name__}",
            "a string",
            _REMEDY,
        )
    if len(name) > max_length:
        raise ProtocolError(
            ErrorCode.bad_key,
            f"the trajectory's name has {len(name)} characters",
            f"at most {max_length}",
            "shorten the name",
            {"limit": max_length},
        )
    if _TRAJECTORY.fullmatch(name) is None:
        raise ProtocolError(
            ErrorCode.bad_key,
            f"{name!r} does not name a trajectory",
            "one or more chunks of letters, digits, '_', '.' or '-', separated by single '/'",
            _REMEDY,
        )
    return name


def shard_of(name: str) -> str:
    """Shard of a trajectory, two lower-case hex digits: CRC-32 (IEEE) of its name modulo 64.

    CRC-32 stands in every language's standard library and spreads numbered names evenly.
    """
    return f"{zlib.crc32(check_trajectory(name).encode('ascii')) % SHARDS:02x}"


def frame_key(name: str) -> str:
    """Key on which a source puts the trajectory's frames."""
    return f"koop/frame/{shard_of(name)}/{name}"


def control_key(name: str) -> str:
    """Key on which a source puts the trajectory's controls."""
    return f"koop/control/{shard_of(name)}/{name}"


def replay_key(name: str) -> str:
    """Key on which a source answers for past frames and controls, out of its log."""
    return f"koop/replay/{shard_of(name)}/{name}"


def durable_key(name: str) -> str:
    """Key on which the service tells a source what its log need not keep any longer."""
    return f"koop/durable/{shard_of(name)}/{name}"


def predict_key(name: str) -> str:
    """Key on which the service predicts the trajectory."""
    return f"koop/predict/{check_trajectory(name)}"


def lqr_key(name: str) -> str:
    """Key on which the service computes controls to a target."""
    return f"koop/lqr/{check_trajectory(name)}"


def command_key(name: str) -> str:
    """Key on which the service puts closed-loop controls, and the end of a task."""
    return f"koop/command/{check_trajectory(name)}"


def state_key(name: str) -> str:
    """Key of the trajectory's estimator status."""
    return f"koop/state/{check_trajectory(name)}"


def check_owner(name: object) -> str:
    """Return ``name`` if it names an owner, else raise ProtocolError (wrong_type, bad_key)."""
    if not isinstance(name, str):
        raise ProtocolError(
            ErrorCode.wrong_type, f"the owner's name is of type {type(name).__name__}", "a string"
        )
    if len(name) > MAX_OWNER_LENGTH or _OWNER.fullmatch(name) is None:
        raise ProtocolError(
            ErrorCode.bad_key,
            f"{name[: 2 * MAX_OWNER_LENGTH]!r} does not name an owner",
            f"1 to {MAX_OWNER_LENGTH} letters, digits, '_', '.' or '-'",
            "draw a name at random when the client starts, for instance 16 hex digits",
            {"field": "owner"},
        )
    return name


def client_token(owner: str) -> str:
    """Key of the liveliness token that an owner declares for as long as it wants commands."""
    return f"koop/@client/{check_owner(owner)}"


def owner_of(token: str) -> str:
    """The owner whose liveliness token has this key; ProtocolError (bad_key) if it is none."""
    prefix, _, owner = token.rpartition("/")
    if f"{prefix}/*" != CLIENT_TOKENS:
        raise ProtocolError(
            ErrorCode.bad_key, f"{token[:MAX_NAME_LENGTH]!r} is no owner's token", CLIENT_TOKENS
        )
    return check_owner(owner)


def source_token(name: str) -> str:
    """Key of the liveliness token that stands for a trajectory as long as its log can be asked."""
    return f"koop/@source/{shard_of(name)}/{name}"


def trajectory_of(token: str) -> str:
    """The trajectory whose source's token has this key; ProtocolError (bad_key) if it is none."""
    prefix = SOURCE_TOKENS.removesuffix("**")
    if not token.startswith(prefix):
        raise ProtocolError(
            ErrorCode.bad_key, f"{token[:MAX_NAME_LENGTH]!r} is no source's token", SOURCE_TOKENS
        )
    shard, _, name = token.removeprefix(prefix).partition("/")
    _check_shard(shard, check_trajectory(name))
    return name


def parse_key(key: str) -> KoopKey:
    """Take a key without wildcards apart; raise ProtocolError (bad_key) where it is not koop's."""
    root, _, rest = key.partition("/")
    word, _, rest = rest.partition("/")
    kind = _KINDS.get(word)
    if root != "koop" or kind is None:
        raise ProtocolError(
            ErrorCode.bad_key,
            f"{key[:MAX_NAME_LENGTH]!r} is not a key of a trajectory",
            f"koop/<kind>/... with a kind of {', '.join(_KINDS)}",
            "build keys with the functions of koop_protocol.keys",
        )
    if kind not in _SHARDED:
        return KoopKey(kind, check_trajectory(rest))
    shard, _, name = rest.partition("/")
    _check_shard(shard, check_trajectory(name))
    return KoopKey(kind, name)


def _check_shard(shard: str, name: str) -> None:
    expected = shard_of(name)
    if shard != expected:
        raise ProtocolError(
            ErrorCode.bad_key,
            f"the key puts trajectory {name!r} into shard {shard[:MAX_NAME_LENGTH]!r}",
            f"shard {expected!r}",
            "the shard is the CRC-32 of the trajectory's name modulo 64, as two hex digits",
            {"shard": expected},
        )
