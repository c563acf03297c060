"""A Zenoh session to the koop service: the one thing that every client opens first.

ConnectionError
├── NoServiceError    nobody listens
└── RefusedError      somebody does, and does not let us in
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import zenoh

from koop_clients.refusal import Credentials, is_listening, why_refused

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

# Under BLOCK Zenoh closes a link whose reader is slower than this, and what follows is lost without
# an exception. Its default is 5 s, a long garbage collection at the other end.
_WAIT_BEFORE_CLOSE = "transport/link/tx/queue/congestion_control/block/wait_before_close"
_ZENOH_DEFAULT_WAIT, _LONG_WAIT = 5_000_000, 600_000_000  # us

_TLS = "transport/link/tls"

_RETRY_INTERVAL = 0.2  # s
# Zenoh's own pauses before it looks again for a service that went away grow to 4 s.
_RECONNECT = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2}

FLUSH_KEY = "koop/@flush"
"""Nobody answers on it; asking says when what was put before has been handed on."""


class NoServiceError(ConnectionError):
    """Nobody listens at any of the endpoints."""

    def __init__(self, endpoints: list[str]) -> None:
        super().__init__(endpoints)
        self.endpoints = endpoints

    def __str__(self) -> str:
        where = " or ".join(self.endpoints) or "the endpoints of the Zenoh configuration"
        return f"no koop service at {where}; start one with `koop-serve`"


class RefusedError(ConnectionError):
    """Somebody listens at the endpoint, and no session comes about: certificates, mostly."""

    def __init__(self, endpoint: str, reason: str) -> None:
        super().__init__(endpoint, reason)
        self.endpoint = endpoint
        self.reason = reason

    def __str__(self) -> str:
        return f"the hub at {self.endpoint} is there, but {self.reason}"


def open_session(
    connect: str | list[str] | None = None,
    *,
    config_file: str | Path | None = None,
    wait: float = 0.0,
) -> zenoh.Session:
    """Open a Zenoh session in client mode; close it, or use it in a `with` statement.

    A session left open keeps the interpreter from ending.

    Args:
        connect: endpoints to try, such as "tcp/127.0.0.1:7447" (the default) or
            "tls/koop.example:7447".
        config_file: a Zenoh configuration in JSON5, for certificates and the like; `connect`, where
            given, replaces its endpoints. Certificates are looked for beside the file, unless their
            paths are absolute.
        wait: how long to go on trying while nobody listens [s].

    Raises:
        NoServiceError: nobody listens there.
        RefusedError: somebody does, and refuses this client; waiting would not help.
        ValueError: the endpoint, the file or a certificate that it names is not valid.
    """
    config = _client_config() if config_file is None else _read_config(Path(config_file))
    if connect is not None or config_file is None:
        _set_endpoints(config, connect or DEFAULT_ENDPOINT)
    _check_protocols(config)
    _raise_wait_before_close(config)
    return _open(config, wait)


def flush(session: zenoh.Session, timeout: float = 10.0) -> None:
    """Wait until what was put has reached the other end of this session's link.

    Closing a session drops what is still on its way, BLOCK or not. A question that nobody needs to
    answer travels behind it and comes back once it has been handed on.

    Args:
        session: an open session.
        timeout: the longest wait [s].
    """
    for _ in session.liveliness().get(FLUSH_KEY, timeout=timeout):
        pass


def _client_config() -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("connect/retry", json.dumps(_RECONNECT))
    return config


def _read_config(path: Path) -> zenoh.Config:
    if not path.is_file():
        raise ValueError(f"there is no Zenoh configuration at {path}")
    try:
        config = zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise ValueError(f"{path} is not a Zenoh configuration: {error}") from error
    _find_certificates(config, path)
    _credentials(config).context()
    return config


def _find_certificates(config: zenoh.Config, path: Path) -> None:
    """Make paths absolute: Zenoh takes them from the working directory, and reads them later on."""
    for name, value in json.loads(config.get_json(_TLS)).items():
        if not isinstance(value, str):
            continue
        file = path.absolute().parent / value
        if not file.is_file():
            raise ValueError(f"{path} names {value} as its {name}, but there is no file {file}")
        config.insert_json5(f"{_TLS}/{name}", json.dumps(str(file)))


def _credentials(config: zenoh.Config) -> Credentials:
    found = json.loads(config.get_json(_TLS))
    names = ("root_ca_certificate", "connect_certificate", "connect_private_key")
    files = (Path(found[name]) if found[name] else None for name in names)
    return Credentials(*files, verifies_name=found["verify_name_on_connect"] is not False)


def _set_endpoints(config: zenoh.Config, connect: str | list[str]) -> None:
    endpoints = [connect] if isinstance(connect, str) else connect
    try:
        config.insert_json5("connect/endpoints", json.dumps(endpoints))
    except zenoh.ZError as error:
        raise ValueError(
            f"{', '.join(endpoints)!r} is not a Zenoh endpoint; expected one like "
            f"{DEFAULT_ENDPOINT}"
        ) from error


def _check_protocols(config: zenoh.Config) -> None:
    """A configuration for TLS is not used in plain text by mistake."""
    allowed = json.loads(config.get_json("transport/link/protocols"))
    for endpoint in _endpoints(config):
        if allowed and endpoint.partition("/")[0] not in allowed:
            raise ValueError(
                f"the configuration does not allow {endpoint}; expected an endpoint that begins "
                f"with {' or '.join(f'{protocol}/' for protocol in allowed)}"
            )


def _raise_wait_before_close(config: zenoh.Config) -> None:
    if int(json.loads(config.get_json(_WAIT_BEFORE_CLOSE))) == _ZENOH_DEFAULT_WAIT:
        config.insert_json5(_WAIT_BEFORE_CLOSE, str(_LONG_WAIT))


def _open(config: zenoh.Config, wait: float) -> zenoh.Session:
    deadline = time.monotonic() + wait
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            over = time.monotonic() >= deadline
            _raise_refusal(config, error, over)
            if over:
                raise NoServiceError(_endpoints(config)) from error
        time.sleep(_RETRY_INTERVAL)


def _raise_refusal(config: zenoh.Config, error: zenoh.ZError, over: bool) -> None:
    """Raise RefusedError where waiting does not help, or where it is `over` and did not."""
    for endpoint in _endpoints(config):
        reason = why_refused(endpoint, _credentials(config))
        if reason is None and over and is_listening(endpoint):
            reason = f"no Zenoh session comes about: {str(error).split(' at /')[0].strip()}"
        if reason is not None:
            raise RefusedError(endpoint, reason) from error


def _endpoints(config: zenoh.Config) -> list[str]:
    value = json.loads(config.get_json("connect/endpoints"))
    # A configuration file may give endpoints by mode.
    return [str(item) for item in value] if isinstance(value, list) else []
