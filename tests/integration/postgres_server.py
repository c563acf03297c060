"""A real PostgreSQL server of one's own, on a Unix socket in a temporary folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import psycopg

_DEADLINE = 60.0  # s


def program(name: str) -> str:
    """PostgreSQL's server programs stand outside of PATH in Debian."""
    found = shutil.which(name) or next(
        (str(path) for path in sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))), None
    )
    assert found, f"PostgreSQL's {name} is missing; on Debian: apt-get install postgresql"
    return found


@dataclass
class PostgresServer:
    """The server; it can be killed and started again."""

    folder: Path
    owner: dict[str, Any]
    process: subprocess.Popen[bytes] | None = field(default=None)

    def url(self, schema: str = "public") -> str:
        """Of its database; every schema is as good as a database of its own."""
        options = quote(f"-csearch_path={schema}", safe="")
        return f"postgresql:///postgres?host={self.folder}&user=koop&options={options}"

    def new_schema(self, name: str) -> str:
        """The URL of an empty schema."""
        with psycopg.connect(self.url(), autocommit=True) as connection:
            connection.execute(f"CREATE SCHEMA {name}")
        return self.url(name)

    def start(self) -> None:
        settings = (f"unix_socket_directories={self.folder}", "listen_addresses=", "fsync=off")
        options = [word for setting in settings for word in ("-c", setting)]
        data = str(self.folder / "data")
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [program("postgres"), "-D", data, *options], stdout=log, stderr=log, **self.owner
            )
        end = time.monotonic() + _DEADLINE
        while True:
            try:
                psycopg.connect(self.url()).close()
                return
            except psycopg.OperationalError:
                told = (self.folder / "log").read_text()
                assert self.process.poll() is None, told
                assert time.monotonic() < end, told
                time.sleep(0.05)

    def kill(self) -> None:
        """As a machine that fails: connections break, what was committed stays."""
        if self.process is not None:
            self.process.send_signal(3)  # SIGQUIT: at once, without a checkpoint
            self.process.wait()
            self.process = None


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """A new server with a user `koop` and nothing in it. It refuses to run as root: nobody runs it
    then."""
    folder = Path(tempfile.mkdtemp(prefix="koop-pg-"))
    owner: dict[str, Any] = {}
    if os.getuid() == 0:
        shutil.chown(folder, "nobody")
        owner = {"user": "nobody", "group": os.stat(folder).st_gid, "extra_groups": []}
    try:
        subprocess.run(
            [program("initdb"), "-D", str(folder / "data"), "-U", "koop", "-A", "trust", "-N"],
            check=True,
            capture_output=True,
            **owner,
        )
        server = PostgresServer(folder, owner)
        server.start()
        try:
            yield server
        finally:
            server.kill()
    finally:
        shutil.rmtree(folder)
