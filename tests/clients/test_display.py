"""Progress that a person can read, and that a log file can keep."""

from __future__ import annotations

import io
import json
import math

import pytest

from koop_clients.sim_client import display as module
from koop_clients.sim_client.display import (
    DRIVING_HEADING,
    Display,
    driving_row,
    learning_heading,
    learning_row,
    usual,
)
from koop_clients.sim_client.driving.driver import Account
from koop_clients.sim_client.driving.outcome import Outcome
from koop_clients.sim_client.report import Driven, Result, latency, totals
from koop_clients.sim_client.scoring import Errors

ERRORS = Errors((1, 20), (0.0123, 0.2), (0.1, 0.15), 5)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def test_a_terminal_s_row_renews_itself(clock: list[float]) -> None:
    out = Terminal()
    display = Display(out)
    for text in ("one", "two"):
        display.row("heading", text)
        clock[0] += 1.0
    display.say("done")
    assert out.getvalue().endswith("heading\x1b[0m\n\r\x1b[Kone\r\x1b[Ktwo\ndone\n")
    assert out.getvalue().count("heading") == 1


def test_a_log_gets_plain_lines(clock: list[float]) -> None:
    out = io.StringIO()
    display = Display(out)
    for text in ("one", "two"):
        display.row("heading", text)
        clock[0] += 10.0
    display.close()
    assert out.getvalue() == "\nheading\none\ntwo\n"


def test_rows_come_as_often_as_one_can_read(clock: list[float]) -> None:
    for out, period in ((Terminal(), 0.5), (io.StringIO(), 5.0)):
        display = Display(out)
        assert display.due("a")
        display.row("a", "row")
        assert not display.due("a")
        assert display.due("b")
        clock[0] += 0.9 * period
        assert not display.due("a")
        clock[0] += 0.2 * period
        assert display.due("a")


def test_no_colour_where_none_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    assert Display(Terminal()).good("x") == "x"
    monkeypatch.delenv("NO_COLOR")
    assert Display(Terminal()).good("x") == "\x1b[32mx\x1b[0m"
    assert Display(io.StringIO()).good("x") == "x"


def test_a_learning_row_stands_under_its_heading() -> None:
    heading = learning_heading((1, 20)).splitlines()[1]
    row = learning_row(Display(io.StringIO()), 50, 51, ERRORS, "", 0.012)
    assert row == "   2.5 s      51  0.012/.100 0.200/.150 12 ms"
    assert heading == "    time  frames  50 ms      1 s        answer"
    assert heading.index("50 ms") == row.index("0.012")
    assert heading.index("1 s") == row.index("0.200")


def test_only_what_is_better_is_green() -> None:
    row = learning_row(Display(Terminal()), 0, 1, ERRORS, "", math.nan)
    assert "\x1b[32m0.012\x1b[0m" in row
    assert "\x1b[32m0.200" not in row


def test_a_row_tells_why_there_are_no_figures() -> None:
    display = Display(io.StringIO())
    assert learning_row(display, 0, 1, None, "warming up, 1 of 36 frames", math.nan).endswith(
        "warming up, 1 of 36 frames"
    )
    assert learning_row(display, 0, 1, None, "", 0.01).endswith(
        "waiting for the predicted frames to happen"
    )


def test_a_driving_row_stands_under_its_heading() -> None:
    row = driving_row(200, 3.1, -0.04, -20.0, "", 0.0061)
    assert row == "  10.0 s     201  +3.10 rad  -0.04 rad  -20.00 N m   6 ms"
    assert DRIVING_HEADING.index("answer") == row.index("6 ms")
    assert driving_row(200, 0, 0, 0, "nobody answered", 0.006).endswith("nobody answered")


def test_the_usual_latency_is_the_median_of_the_newest() -> None:
    assert math.isnan(usual([]))
    assert usual([9.0] * 100 + [0.001] * 11 + [0.005] * 9) == 0.001


GOOD = Outcome(True, 12.5, 1.25, 0.01, 0.0, 0.02, 20.0)
BAD = Outcome(False, 99.0, None, 1.0, 0.0, 2.0, 20.0)


def driven(found: Outcome | None, **changes: object) -> Driven:
    values = {
        "trajectory": "cartpole-actuated/0", "start": 1.0, "target": 0.0, "began": 10.0,
        "seconds": 8.0, "outcome": found, "command": latency([0.01, 0.03]), "late": 0,
        "statuses": {"solved": 2}, "delay": 0, "reasons": (), "warnings": (),
    }  # fmt: skip
    return Driven(**{**values, **changes})


def result(*drives: Driven, **changes: object) -> Result:
    accounts = [Account(late=drive.late) for drive in drives]
    for account in accounts:
        account.latencies.extend([0.01, 0.03])
    values = {
        "system": "cartpole", "drive": "mpc", "trajectories": max(1, len(drives)), "frames": 100,
        "simulated": 5.0, "elapsed": 2.0, "early": ERRORS, "late": None, "others": None,
        "predict": latency([0.01, 0.02]), "refused": 3, "drives": list(drives),
        "totals": totals(drives, accounts), "completed": True,
    }  # fmt: skip
    return Result(**{**values, **changes})


def test_the_summary_tells_what_was_measured() -> None:
    text = result().to_text()
    assert "streamed 100 frames in 2.0 s (50 frames/s), 5.0 s simulated" in text
    assert "first predictions      0.0123    0.2000" in text
    assert "repeating a frame    0.1000    0.1500" in text
    assert "last predictions" not in text
    assert "round trip of a prediction: 15.0 ms (p50), 19.9 ms (p99) over 2" in text
    assert "predictions without an answer: 3" in text
    assert "drive" not in text


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        (driven(GOOD), "reached and held the target"),
        (driven(GOOD), "for good after 1.25 s, with at most 20.0 N m, cost 12.50"),
        (driven(GOOD), "frame put to command there: 20.0 ms (p50)"),
        (driven(GOOD, late=4), "4 commands came after their interval was over"),
        (driven(GOOD, warnings=("far away",)), "the service says: far away"),
        (driven(BAD), "DID NOT hold the target"),
        (driven(BAD), "never settled there"),
        (driven(None, reasons=("too little torque",)), "NEVER BEGAN too little torque"),
    ],
)
def test_the_summary_tells_how_the_drive_went(drive: Driven, words: str) -> None:
    assert words in result(drive).to_text()


def test_the_drives_of_several_plants_are_summed_up() -> None:
    never = driven(None, reasons=("why",), late=1)
    found = result(driven(GOOD), driven(BAD, late=2), never)
    text = found.to_text()
    assert "drive: 1 of 3 reached and held the target, mean cost 55.75" in text
    assert "1 never driven" in text
    assert "3 commands came after" in text
    assert found.totals is not None
    assert found.totals.success_rate == pytest.approx(1 / 3)
    assert found.totals.command is not None
    assert found.totals.command.count == 6
    assert found.refusal == ""
    assert result(never, never).refusal == "why"


def test_the_summary_for_machines_is_one_line() -> None:
    line = result(driven(GOOD), driven(None)).to_json()
    assert "\n" not in line
    values = json.loads(line)
    assert values["frames_per_s"] == 50.0
    assert values["early"]["error"] == [0.0123, 0.2]
    assert values["late"] is None
    first, second = values["drives"]
    assert (first["outcome"]["success"], first["outcome"]["cost"]) == (True, 12.5)
    assert (first["statuses"], first["command"]["p50"]) == ({"solved": 2}, 0.02)
    assert second["outcome"] is None
    assert values["totals"]["success_rate"] == 0.5
    assert values["predict"]["count"] == 2
