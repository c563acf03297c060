"""The Zenoh session: a hub for one machine by default, or a leaf of somebody's network."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

# Zenoh reads a link on one of its receiver threads, and a source that is held back keeps its
# thread. With Zenoh's own two threads, two such sources would keep everybody's queries out.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 16))")

import zenoh

from koop_protocol import CLIENT_TOKENS, SOURCE_TOKENS
from koop_service.serving.config import NetworkSettings

_LARGEST_MESSAGE = 64 << 20
"""What Zenoh puts together at all [bytes]; the protocol's own limit is far lower, and answered."""
_PATIENCE = 1_000_000
"""How long an answer waits for a caller that does not read before its link is closed [us]."""
_HELLO = 2000
"""How long somebody who connects may take to say so [ms]. Zenoh lets a hundred do nothing at once,
and refuses all others meanwhile; with its own 10 s, a hundred idle sockets close the service."""
_TLS = "transport/link/tls"
_PROTOCOLS = "transport/link/protocols"
_COMMANDS = 16
"""Batches of commands that may wait on a link. Commands that find it full are dropped: with Zenoh's
own 2, one in sixty was, on a busy machine."""

_EVERYTHING = ["**", CLIENT_TOKENS, SOURCE_TOKENS]
"""All of koop's keys: ** leaves out chunks that begin with @."""
_MESSAGES = [
    *("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
]


class CannotListenError(OSError):
    """The hub could not open its endpoint; str() says what to do about it."""

    def __init__(self, endpoints: tuple[str, ...], reason: str) -> None:
        self.endpoints = endpoints
        self.reason = reason
        super().__init__(endpoints, reason)

    def __str__(self) -> str:
        where = ", ".join(self.endpoints)
        if "in use" in self.reason:
            return (
                f"{where} is already taken, perhaps by another koop-serve or a Zenoh router. "
                f"Stop that one, or join it with --connect {self.endpoints[0]}, or listen "
                "elsewhere with --listen tcp/127.0.0.1:7448 (and give the clients the same "
                "endpoint with --connect)."
            )
        return f"cannot listen on {where}: {self.reason}"


class UnreachableError(OSError):
    """None of the routers to connect to is there (yet)."""


def zenoh_config(settings: NetworkSettings, patience: int = _PATIENCE) -> zenoh.Config:
    """Zenoh's configuration: a router where we listen, else a client of the routers named.

    patience: how long a message waits for whoever does not read before its link is closed [us].
    """
    config = _base(settings.zenoh_config, patience)
    endpoints = settings.endpoints
    if settings.zenoh_config is None or endpoints or settings.connect:
        _set(config, "mode", "router" if endpoints else "client")
    if endpoints:
        _set(config, "listen/endpoints", list(endpoints))
    if settings.connect:
        _set(config, "connect/endpoints", list(settings.connect))
    _set(config, "connect/retry", _RETRY)
    if settings.zenoh_config is None or settings.shared_memory:
        _set(config, "transport/shared_memory/enabled", settings.shared_memory)
    if settings.zenoh_config is None or settings.scouting:
        _set(config, "scouting/multicast/enabled", settings.scouting)
        _set(config, "scouting/gossip/enabled", settings.scouting)
    if not settings.scouting and settings.zenoh_config is None:
        _set(config, "scouting/delay", 0)  # else a hub waits half a second for nobody
    return config


_RETRY = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2}


def listens(settings: NetworkSettings) -> bool:
    """Whether a session with these settings is a hub, by an option or by its Zenoh file."""
    config = zenoh_config(settings)
    return json.loads(config.get_json("mode")) != "client" and bool(_endpoints(config, "listen"))


def open_session(
    settings: NetworkSettings, patience: int = _PATIENCE, private: str | None = None
) -> zenoh.Session:
    """Open the session; use it as a context manager, an open one hangs the interpreter's exit.

    private: one more endpoint to listen on, a socket file: who reaches it may do everything.
    Raises CannotListenError, UnreachableError, or OSError for anything else that Zenoh objects to.
    """
    zenoh.try_init_log_from_env()  # says nothing unless RUST_LOG asks for it
    config = zenoh_config(settings, patience)
    if private is not None:
        _listen_as_well(config, private)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = str(error).split(" at /")[0]
        if "listener" in reason or "in use" in reason:
            raise CannotListenError(_endpoints(config, "listen"), reason) from error
        if "onnect" in reason:
            raise UnreachableError(_unreachable(config)) from error
        where = ", ".join((*settings.endpoints, *settings.connect)) or settings.zenoh_config
        raise OSError(f"cannot open the Zenoh session on {where}: {reason}") from error


def locators(session: zenoh.Session) -> list[str]:
    """Endpoints that the session really listens on, port 0 resolved."""
    status: list[str] = []
    for reply in session.get(f"@/{session.info.zid()}/*", timeout=2.0):
        if reply.ok is not None:
            status += json.loads(reply.ok.payload.to_string()).get("locators", [])
    return status


def _base(path: Path | None, patience: int) -> zenoh.Config:
    try:
        config = zenoh.Config() if path is None else zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise OSError(f"{path} is not a Zenoh configuration: {error}") from error
    if path is not None:
        _find_certificates(config, path)
    else:
        _set(config, "transport/unicast/accept_timeout", _HELLO)
        _set(config, "transport/link/rx/max_message_size", _LARGEST_MESSAGE)
        _set(config, "transport/link/tx/queue/congestion_control/block/wait_before_close", patience)
        _set(config, "transport/link/tx/queue/size/real_time", _COMMANDS)
    _set(config, "adminspace/enabled", True)
    return config


def _find_certificates(config: zenoh.Config, path: Path) -> None:
    """Certificates lie beside the file that names them; Zenoh would look in the working directory.

    Raises OSError where one is missing.
    """
    for name, value in json.loads(config.get_json(_TLS)).items():
        if not isinstance(value, str):
            continue
        file = path.absolute().parent / value
        if not file.is_file():
            raise OSError(f"{path} names {value} as its {name}, but there is no file {file}")
        _set(config, f"{_TLS}/{name}", str(file))


def _listen_as_well(config: zenoh.Config, endpoint: str) -> None:
    protocol = endpoint.partition("/")[0]
    _set(config, "listen/endpoints", [*_listed(config, "listen"), endpoint])
    allowed = json.loads(config.get_json(_PROTOCOLS))
    if allowed:
        _set(config, _PROTOCOLS, [*allowed, protocol])
    _admit(config, protocol)


def _admit(config: zenoh.Config, protocol: str) -> None:
    """Let whoever comes over links of this protocol do everything, where there are access rules."""
    rules = json.loads(config.get_json("access_control"))
    if not rules["enabled"]:
        return
    name = "workers"
    rule = {"id": name, "permission": "allow", "key_exprs": _EVERYTHING, "messages": _MESSAGES}
    for kind, entry in (
        ("rules", rule | {"flows": ["ingress", "egress"]}),
        ("subjects", {"id": name, "link_protocols": [protocol]}),
        ("policies", {"rules": [name], "subjects": [name]}),
    ):
        rules[kind] = [*(rules[kind] or []), entry]
    _set(config, "access_control", rules)


def _endpoints(config: zenoh.Config, kind: str) -> tuple[str, ...]:
    """Where a configuration listens or connects, without the parameters of its endpoints."""
    return tuple(endpoint.partition("#")[0] for endpoint in _listed(config, kind))


def _listed(config: zenoh.Config, kind: str) -> list[str]:
    found = json.loads(config.get_json(f"{kind}/endpoints"))
    if isinstance(found, dict):  # a file may give them by mode
        found = found.get(json.loads(config.get_json("mode")), [])
    return [str(endpoint) for endpoint in found]


def _unreachable(config: zenoh.Config) -> str:
    """Why there is no session yet, as far as Zenoh tells."""
    where = ", ".join(_endpoints(config, "connect")) or "the routers of the Zenoh configuration"
    if "tls/" not in where:
        return f"no router at {where} yet"
    return f"no router at {where} yet, or one refuses the certificates (RUST_LOG=zenoh=warn tells)"


def _set(config: zenoh.Config, path: str, value: Any) -> None:
    config.insert_json5(path, json.dumps(value))
