"""What lies in the place of a log: another version, another's, damaged, or not to be written."""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from koop_clients.replay.file import FRAME, LogFile
from koop_protocol import ReplayQuery

from .filled import LARGE, A, fill, read_all


def test_two_processes_never_share_it(tmp_path: Path) -> None:
    with (
        closing(LogFile(tmp_path / "log", LARGE)),
        pytest.raises(ValueError, match="another process is using the log"),
    ):
        LogFile(tmp_path / "log", LARGE)
    LogFile(tmp_path / "log", LARGE).close()


def test_a_file_that_is_no_log_any_more_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "log").write_bytes(b"rubbish" * 1000)
    with caplog.at_level(logging.WARNING), closing(LogFile(tmp_path / "log", LARGE)) as file:
        fill(file, "a", A, 1)
        assert len(read_all(file, "a")) == 2
    assert "is damaged" in caplog.text
    (aside,) = tmp_path.glob("log.*.unfit")
    assert aside.read_bytes() == b"rubbish" * 1000


FORMER = """
CREATE TABLE trajectories (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, dropped INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE messages (
    position INTEGER PRIMARY KEY, trajectory INTEGER NOT NULL,
    epoch TEXT NOT NULL, seq INTEGER NOT NULL, kind INTEGER NOT NULL, data BLOB NOT NULL
);
CREATE INDEX by_trajectory ON messages (trajectory, position);
INSERT INTO trajectories VALUES (1, 'a', 3), (2, 'b', 0);
PRAGMA user_version = 1;
"""


def test_a_file_of_the_former_version_goes_on(tmp_path: Path) -> None:
    messages = [f"{number}".encode() for number in range(200)]
    with closing(sqlite3.connect(tmp_path / "log")) as connection:
        connection.executescript(FORMER)
        rows = [(5 + k, 1 + k % 2, A, k, FRAME, data) for k, data in enumerate(messages)]
        connection.executemany("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?)", rows)
        connection.commit()
    for _ in range(2):
        with closing(LogFile(tmp_path / "log", LARGE)) as file:
            assert (read_all(file, "a"), read_all(file, "b")) == (messages[::2], messages[1::2])
            assert file.read("a", ReplayQuery()).dropped == 3
            file.append("a", A, 200 + len(messages), FRAME, b"more")
            messages += [b"more", b"of b"]
            file.append("b", A, 200 + len(messages), FRAME, b"of b")
    with closing(sqlite3.connect(tmp_path / "log")) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (2,)
        assert not connection.execute(
            "SELECT * FROM sqlite_master WHERE name GLOB 'by_*'"
        ).fetchall()


def test_a_file_that_is_damaged_within_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(LogFile(tmp_path / "log", LARGE)) as file:
        fill(file, "a", A, 300, 100)
    with (tmp_path / "log").open("r+b") as raw:
        raw.seek(6 * 4096)
        raw.write(b"rubbish!" * 512)
    with caplog.at_level(logging.WARNING), closing(LogFile(tmp_path / "log", LARGE)) as file:
        assert read_all(file, "a") == []
        assert read_all(file, "b") == []
        file.append("a", A, 0, FRAME, b"goes on")
        assert read_all(file, "a") == [b"goes on"]
    assert "is damaged" in caplog.text
    assert len(list(tmp_path.glob("log.*.unfit"))) == 1


def test_a_file_with_a_row_that_is_no_message_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(LogFile(tmp_path / "log", LARGE)) as file:
        fill(file, "a", A, 3)
    with closing(sqlite3.connect(tmp_path / "log")) as connection:
        connection.execute("UPDATE messages SET seq = 'one' WHERE seq = 1")
        connection.commit()
    with caplog.at_level(logging.WARNING), closing(LogFile(tmp_path / "log", LARGE)) as file:
        assert file.bytes == 0
    assert "is damaged (a row is no message" in caplog.text


def test_another_version_is_left_alone(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "log")) as connection:
        connection.execute("PRAGMA user_version = 9")
    with pytest.raises(ValueError, match="is of version 9; this koop knows version 2"):
        LogFile(tmp_path / "log", LARGE)


def test_a_place_that_cannot_be_written_is_explained(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    with pytest.raises(OSError, match=r"the log .* cannot be used"):
        LogFile(tmp_path / "log", LARGE)
    with pytest.raises(ValueError, match="max_bytes is 0"):
        LogFile(tmp_path / "other", 0)
