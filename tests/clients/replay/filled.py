"""Logs with something in them, and all that they hold."""

from __future__ import annotations

from dataclasses import replace

from koop_clients.replay.file import CONTROL, FRAME, LogFile
from koop_protocol import ReplayQuery

A, B, C = "00000000000000aa", "00000000000000bb", "00000000000000cc"
LARGE = 1 << 30


def fill(file: LogFile, name: str, epoch: str, count: int, size: int = 10) -> list[bytes]:
    """Frames and controls 0 ... count-1, each with bytes of its own."""
    messages = []
    for seq in range(count):
        for kind in (FRAME, CONTROL):
            data = f"{name} {epoch} {seq} {kind}".encode().ljust(size)
            file.append(name, epoch, seq, kind, data)
            messages.append(data)
    return messages


def read_all(file: LogFile, name: str, query: ReplayQuery | None = None) -> list[bytes]:
    """Batch by batch, as the service does."""
    query = query or ReplayQuery()
    reply = file.read(name, query)
    messages = list(reply.messages)
    while not reply.end:
        before = reply.position
        reply = file.read(name, replace(query, after=reply.position))
        assert reply.position > before
        messages += reply.messages
    return messages
