"""`koop-sim-client --system cylinder --drive ...`: who turns the cylinder, and how it is judged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from koop_clients.flow.cylinder import FREE_STREAM, CylinderFlow, Turn, in_units
from koop_clients.flow.forcing import schedule
from koop_clients.flow.plant import FlowPlant, natural_swing, starting
from koop_clients.flow.spinup import developed, steady
from koop_clients.sim_client.flowing.drivers import PARTS, Obeying
from koop_clients.sim_client.flowing.outcome import outcome
from koop_clients.sim_client.options import FlowOptions
from koop_protocol import (
    Command,
    Control,
    EndReason,
    ErrorReply,
    Frame,
    LqrCancel,
    LqrEnd,
    LqrReply,
    LqrTask,
    command_key,
    decode,
    encode,
)

LEARNED = 20  # frames


@pytest.fixture(autouse=True)
def coarse(
    small: CylinderFlow, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setattr(FlowOptions, "settings", small.settings)


class Metronome:
    """A service that answers frame k with the rotation k / 1000 for ever; unfit at first."""

    def __init__(self, session: zenoh.Session) -> None:
        self.seen: list[Any] = []
        self.task: LqrTask | None = None
        self.refusals = 2
        self._session = session
        direct: Any = zenoh.handlers.Callback
        self._declared: list[Any] = [
            session.declare_subscriber(f"koop/{kind}/**", direct(self._take, indirect=False))
            for kind in ("frame", "control")
        ]
        for key, handler in (("koop/lqr/**", self._lqr), ("koop/state/**", self._state)):
            declared = session.declare_queryable(key, direct(handler, indirect=False))
            self._declared.append(declared)

    def of_kind(self, kind: type) -> list[Any]:
        return [message for message in self.seen if isinstance(message, kind)]

    def _take(self, sample: zenoh.Sample) -> None:
        message = decode(bytes(sample.payload))
        self.seen.append(message)
        if isinstance(message, Frame) and self.task is not None:
            who = (message.trajectory, message.epoch, message.seq, message.seq)
            said = Command(*who, self._plan(message.seq), "solved", 1.0, 0.0, self.task.owner)
            self._session.put(command_key(message.trajectory), encode(said))

    def _plan(self, seq: int) -> np.ndarray:
        return np.full((16, 1), seq / 1000)

    def _lqr(self, query: zenoh.Query) -> None:
        with query:
            asked = decode(bytes(query.payload or b""))
            self.seen.append(asked)
            last = self.of_kind(Frame)[-1]
            who = (last.trajectory, last.epoch, last.seq)
            if isinstance(asked, LqrCancel):
                self.task = None
                reply: Any = LqrEnd(who[0], asked.owner, EndReason.cancelled, "it said so")
            elif self.refusals:
                self.refusals -= 1
                reply = LqrReply(*who, "unfit", 0.0, 0.0, fit=False, reasons=("too early",))
            else:
                self.task = asked
                reply = LqrReply(*who, "solved", 1.0, 0.0, self._plan(last.seq), start=last.seq)
            query.reply(query.key_expr, encode(reply))

    def _state(self, query: zenoh.Query) -> None:
        with query:
            query.reply_err(encode(ErrorReply("unknown_trajectory", "no frame has come")))


@pytest.fixture
def metronome(hub: zenoh.Session) -> Metronome:
    return Metronome(hub)


def drive(name: str) -> tuple[str, ...]:
    return ("--system", "cylinder", "--drive", name, "--learn", "3", "--duration", "9")


def test_the_cylinder_turns_as_the_service_says(
    small: CylinderFlow, metronome: Metronome, command: Callable, tmp_path: Path
) -> None:
    path = tmp_path / "drive.npz"
    out, _ = command(*drive("mpc"), "--rotation-bound", "0.3", "--json", "--record", str(path))
    frames, controls = metronome.of_kind(Frame), metronome.of_kind(Control)
    task = metronome.of_kind(LqrTask)[-1]
    assert np.array_equal(task.query.target_image, small.picture(steady(small)))
    assert (task.query.horizon, task.query.r, task.query.method) == (16, 0.01, "qp")
    assert (task.query.u_min, task.query.u_max) == ([-0.3], [0.3])
    (found,) = json.loads(out)["drives"]
    began = found["began"]
    assert LEARNED <= began <= LEARNED + 3
    turn, state = schedule((0, 0)), starting(small, (0, 0))
    for frame, control in zip(frames, [*controls, None], strict=True):
        assert np.array_equal(frame.image, small.picture(state))
        if control is not None:
            expected = turn(frame.seq, 0.0) if frame.seq < began else frame.seq / 1000
            assert control.u.tolist() == [expected]
            state = small.frame(state, expected)
    assert len(frames) == 60
    assert isinstance(metronome.seen[-1], LqrCancel)
    assert found["statuses"] == {"solved": 58 - began}  # the first plan is the task's own reply
    assert found["outcome"]["largest_rotation"] == 0.058
    kept = np.load(path)
    shown = [in_units(f.image)[1] / FREE_STREAM for f in frames[began:-1]]
    assert np.allclose(kept["momenta"], shown, atol=1e-6)
    assert np.allclose(kept["target"], in_units(task.query.target_image)[1] / FREE_STREAM)
    assert kept["rotations"].tolist() == [[k / 1000 for k in range(began, 59)]]
    assert kept["natural"] == natural_swing(small, developed(small))


def test_the_reference_controller_asks_nobody(
    small: CylinderFlow, metronome: Metronome, command: Callable
) -> None:
    out, _ = command(*drive("feedback"), "--json")
    assert not metronome.of_kind(LqrTask)
    controls = metronome.of_kind(Control)
    state, turn = starting(small, (0, 0)), schedule((0, 0))
    for control in controls:
        measured = 0.8 * small.probe(state)
        expected = turn(control.seq, 0.0) if control.seq < LEARNED else measured
        assert control.u[0] == pytest.approx(np.clip(expected, -1.27, 1.27))
        state = small.frame(state, control.u[0])
    (found,) = json.loads(out)["drives"]
    assert found["began"] == LEARNED
    assert found["command"] is None


def test_a_service_that_finds_its_model_unfit_for_good_is_told_of(
    metronome: Metronome, command: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    metronome.refusals = 1000
    with pytest.raises(SystemExit, match="the service did not drive: too early"):
        command(*drive("lqr"))
    assert "drive: NEVER BEGAN too early" in capsys.readouterr().out


def test_a_command_acts_from_the_moment_at_which_it_comes(
    small: CylinderFlow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Obeying, "control", lambda _self, _number, part: 0.1 * (part >= 4))
    plant = FlowPlant(small, lambda _number, _probe: 0.0, small.at_rest())
    turns = Obeying.turns(object.__new__(Obeying), plant)
    steps = small.settings.frame_steps
    early = steps * 4 // PARTS
    assert turns == [Turn(early, 0.0), Turn(steps - early, 0.1)]
    expected = small.turned(plant.state, turns)
    assert plant.turn(turns) == pytest.approx(0.1 * (steps - early) / steps)
    assert np.array_equal(plant.state, expected)
    assert plant.number == 1


def test_a_wake_is_calm_once_it_stays_below_a_tenth() -> None:
    loud, calm = [0.2] * 40, [0.01] * 30
    found = outcome([*loud, *calm], [0.3] * 70, 0.2)
    assert found is not None
    assert (found.success, found.calmed_after, found.largest_rotation) == (True, 40, 0.3)
    assert found.swing_at_end == 0.01
    late = outcome([*(4 * loud), *calm], [0.3] * 190, 0.2)
    assert late is not None
    assert (late.success, late.calmed_after) == (False, 160)
    passing = outcome([*loud, *calm, 0.1], [0.0] * 71, 0.2)
    assert passing is not None
    assert (passing.success, passing.calmed_after) == (False, None)
    assert outcome([], [], 0.2) is None
