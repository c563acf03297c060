"""`koop-health`: whether the service moves, in one line and an exit code.

For probes and for people. Needs numpy, msgpack and eclipse-zenoh, and imports nothing that takes
long.
"""

from __future__ import annotations

import argparse
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

from koop_clients.connection import DEFAULT_ENDPOINT, open_session
from koop_clients.queries import KoopClient, KoopError
from koop_protocol import Health

_DESCRIPTION = """\
Ask koop's workers whether they are well: exit code 0 where one answers, 1 where none does.

The thread that folds measurements answers, so an answer means that the service moves. One that is
degraded, such as by an overload, is alive: it exits with 0 and says so."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `koop-health`."""
    options = _parser().parse_args(arguments)
    try:
        with open_session(options.connect, config_file=options.zenoh_config) as session:
            workers = KoopClient(session, options.timeout).health()
    except (KoopError, OSError, ValueError) as error:
        sys.exit(f"koop-health: {error}")
    if options.here:
        workers = [worker for worker in workers if is_here(worker)]
        if not workers:
            sys.exit(f"koop-health: no worker of {socket.gethostname()} answered, but others did")
    print(*map(described, workers), sep="\n")


def is_here(health: Health) -> bool:
    """Whether the worker runs on this host, or in this container."""
    return health.worker.rpartition(":")[0] == socket.gethostname()


def described(health: Health) -> str:
    """One line about a worker."""
    state = ", ".join(health.degraded) if health.degraded else "healthy"
    fold = "none yet" if health.last_fold is None else f"{health.last_fold:.1f} s ago"
    return (
        f"{health.worker} is {state}: koop {health.version}, up {health.uptime:.0f} s, "
        f"{health.trajectories} trajectories, waiting {health.queue} measurements and "
        f"{health.queries} queries, last fold {fold}"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("koop-health", description=_DESCRIPTION)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--connect",
        metavar="ENDPOINT",
        nargs="+",
        help=f"the service or a router that it is connected to (default: {DEFAULT_ENDPOINT})",
    )
    parser.add_argument(
        "--zenoh-config", metavar="FILE", type=Path, help="a raw Zenoh configuration (JSON5)"
    )
    parser.add_argument(
        "--timeout", metavar="SECONDS", type=float, default=2.0, help="(default: %(default)g)"
    )
    parser.add_argument(
        "--here", action="store_true", help="only workers on this host, or in this container, count"
    )
    return parser


if __name__ == "__main__":
    main()
