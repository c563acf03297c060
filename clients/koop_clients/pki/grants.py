"""What each right means on the wire: which messages may cross the hub, from a party and to it.

Zenoh holds a message back unless a rule includes its key. So whoever asks by a wildcard needs a
right to all that the wildcard stands for.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from koop_clients.connection import FLUSH_KEY
from koop_clients.pki.party import Party
from koop_protocol import (
    CLIENT_TOKENS,
    COMMANDS,
    CONTROLS,
    DURABLES,
    FRAMES,
    HEALTH,
    LQRS,
    PREDICTIONS,
    REPLAYS,
    SOURCE_TOKENS,
    STATES,
    KeyKind,
)

WORKER_TOKENS = "koop/@worker/**"
"""Reserved: rules outlive the service that they were written for."""

Flow = Literal["ingress", "egress"]


@dataclass(frozen=True)
class Grant:
    """Messages of some kinds, on some keys, in one direction as the hub sees it.

    Attributes:
        flow: "ingress" is from the party, "egress" to it.
        messages: kinds in Zenoh's words.
        keys: key expressions.
    """

    flow: Flow
    messages: tuple[str, ...]
    keys: tuple[str, ...]


def grants_of(party: Party) -> list[Grant]:
    """All that the party may do; one grant for each direction and set of kinds."""
    views = (*party.publishes, *party.operates, *party.views)
    return _merged(
        [
            _sends(("liveliness_query",), FLUSH_KEY),
            *_publishing(party.publishes),
            *_operating(party.operates),
            *_viewing(views),
            *_recording(party.records),
            *(_serving() if party.serves else ()),
        ]
    )


def _publishing(patterns: tuple[str, ...]) -> list[Grant]:
    measurements = _sharded(KeyKind.frame, patterns) + _sharded(KeyKind.control, patterns)
    replays, durables = _sharded(KeyKind.replay, patterns), _sharded(KeyKind.durable, patterns)
    return [
        _sends(("put",), *measurements),
        # It learns that there is a subscriber at all; otherwise its session sends nothing.
        _gets(("declare_subscriber",), *((FRAMES, CONTROLS) if patterns else ())),
        _sends(("declare_queryable", "reply"), *replays),
        _gets(("query",), *replays),
        _sends(("liveliness_token",), *_sharded("@source", patterns)),
        _sends(("declare_subscriber",), *durables),
        _gets(("put",), *durables),
    ]


def _operating(patterns: tuple[str, ...]) -> list[Grant]:
    plans, commands = _plain(KeyKind.lqr, patterns), _plain(KeyKind.command, patterns)
    return [
        *_asking(plans, LQRS),
        _sends(("declare_subscriber",), *commands),
        _gets(("put",), *commands),
        # Owners draw their names at random, so the key cannot say whose token it is.
        _sends(("liveliness_token",), *((CLIENT_TOKENS,) if patterns else ())),
    ]


def _viewing(patterns: tuple[str, ...]) -> list[Grant]:
    states = _plain(KeyKind.state, patterns)
    return [
        *_asking(_plain(KeyKind.predict, patterns), PREDICTIONS),
        *_asking(states, STATES),
        *_asking((HEALTH,) if patterns else (), HEALTH),
        _sends(("declare_subscriber",), *states),
        _gets(("put",), *states),
    ]


def _recording(patterns: tuple[str, ...]) -> list[Grant]:
    measurements = _sharded(KeyKind.frame, patterns) + _sharded(KeyKind.control, patterns)
    return [_sends(("declare_subscriber",), *measurements), _gets(("put",), *measurements)]


def _serving() -> list[Grant]:
    """The service's own part, for a service that is a leaf of a router."""
    heard, asked = (FRAMES, CONTROLS), (REPLAYS,)
    answered = (PREDICTIONS, LQRS, STATES, HEALTH)
    told, tokens = (COMMANDS, STATES, DURABLES), (CLIENT_TOKENS, SOURCE_TOKENS)
    return [
        _sends(("declare_subscriber",), *heard),
        _gets(("put",), *heard),
        _sends(("declare_queryable", "reply"), *answered),
        _gets(("query",), *answered),
        _sends(("query",), *asked),
        _gets(("declare_queryable", "reply"), *asked),
        _sends(("put",), *told),
        _gets(("declare_subscriber",), *told),
        _sends(("declare_liveliness_subscriber", "liveliness_query"), *tokens),
        _gets(("liveliness_token",), *tokens),
        _sends(("liveliness_token",), WORKER_TOKENS),
    ]


def _asking(keys: tuple[str, ...], answered: str) -> list[Grant]:
    """Queries on the keys; `answered` is what the service answers on."""
    return [
        _sends(("query",), *keys),
        _gets(("reply",), *keys),
        # A declared querier waits for somebody who answers.
        _gets(("declare_queryable",), *((answered,) if keys else ())),
    ]


def _sends(messages: tuple[str, ...], *keys: str) -> Grant:
    return Grant("ingress", messages, keys)


def _gets(messages: tuple[str, ...], *keys: str) -> Grant:
    return Grant("egress", messages, keys)


def _plain(kind: str, patterns: Iterable[str]) -> tuple[str, ...]:
    return tuple(f"koop/{kind}/{pattern}" for pattern in patterns)


def _sharded(kind: str, patterns: Iterable[str]) -> tuple[str, ...]:
    """Keys in any shard: the shard follows from the name, and the service checks it."""
    return tuple(
        f"koop/{kind}/**" if pattern == "**" else f"koop/{kind}/*/{pattern}" for pattern in patterns
    )


def _merged(grants: Iterable[Grant]) -> list[Grant]:
    """One grant for each direction and set of kinds, without those on no key."""
    keys: dict[tuple[Flow, tuple[str, ...]], dict[str, None]] = {}
    for grant in grants:
        if grant.keys:
            keys.setdefault((grant.flow, grant.messages), {}).update(dict.fromkeys(grant.keys))
    return [Grant(flow, kinds, tuple(found)) for (flow, kinds), found in keys.items()]
