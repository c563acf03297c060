"""What a source keeps on disk until the service has it safe. Needs nothing but the core's packages.

Example::

    with open_session() as session, SourceLog("robot7.log") as log:
        with FrameSource(session, "line3/robot7", control_size=1, log=log) as source:
            ...
"""

from __future__ import annotations

import logging
import sqlite3
import time
from pathlib import Path
from types import TracebackType

import zenoh

from koop_clients.replay.file import CONTROL, FRAME, LogFile, Tail
from koop_clients.replay.server import LogServer
from koop_protocol import Control, Frame

log = logging.getLogger("koop.log")

DEFAULT_MAX_BYTES = 256 << 20
_EVERY = 10.0
"""Seconds between two complaints about a disk that takes nothing."""


class SourceLog:
    """A bounded log in one file, for all trajectories of this process.

    Every frame and control is written to it before it is put, and forgotten once the service says
    that it has it on disk. Whatever is killed meanwhile, service or source, what was put is not
    lost: it is served again out of a thread of the log's own. A file that a killed process left is
    simply opened again.

    Messages that do not fit into `max_bytes` push out the oldest, which are lost unless the service
    has them in memory; that is counted, logged, and told to the service.
    """

    def __init__(self, path: str | Path, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        """Open the file, or make it.

        Raises:
            ValueError: another process is using it, or it is of another version.
            OSError: it cannot be made or written.
        """
        self._file = LogFile(Path(path), max_bytes)
        self._server: LogServer | None = None
        self._session: zenoh.Session | None = None
        self._complained = -_EVERY
        self.failures = 0
        """Messages that the disk did not take; they were put without being logged."""

    @property
    def trajectories(self) -> list[str]:
        """All that are in the log, of this process and former ones."""
        return self._file.trajectories

    @property
    def bytes(self) -> int:
        """Size of all messages held."""
        return self._file.bytes

    def serve(self, session: zenoh.Session) -> None:
        """Let the service ask for what the log holds; a FrameSource with this log does so itself.

        Raises ValueError where it is served on another session already.
        """
        if self._session is not None and self._session is not session:
            raise ValueError(
                "the log is served on another session already; open one log for each session"
            )
        if self._server is None:
            self._session, self._server = session, LogServer(session, self._file)
            self._server.start()

    def attach(self, session: zenoh.Session, trajectory: str) -> None:
        """Serve on the session, this trajectory too, which may be a new one."""
        self.serve(session)
        if self._server is not None:
            self._server.serve(trajectory)

    def append(self, message: Frame | Control, data: bytes) -> bool:
        """Write a message, `data` as it will be put; False where the disk does not take it."""
        kind = FRAME if isinstance(message, Frame) else CONTROL
        try:
            self._file.append(message.trajectory, message.epoch, message.seq, kind, data)
        except sqlite3.Error as error:
            self.failures += 1
            self._complain(error)
            return False
        return True

    def tail(self, trajectory: str) -> Tail | None:
        """The newest frame that was put, or None."""
        return self._file.tail(trajectory)

    def close(self) -> None:
        """Stop serving and let go of the file; what it holds is served when it is opened again."""
        if self._server is not None:
            self._server.close()
            self._server = None
        self._file.close()

    def _complain(self, error: sqlite3.Error) -> None:
        now = time.monotonic()
        if now - self._complained >= _EVERY:
            self._complained = now
            log.warning(
                "the log %s takes nothing at present (%s); %d messages were put without it so far",
                self._file.path,
                error,
                self.failures,
            )

    def __enter__(self) -> SourceLog:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
