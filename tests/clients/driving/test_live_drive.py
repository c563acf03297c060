"""`koop-sim-client --drive` end to end over real Zenoh, against services that cannot be wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from koop_clients.sim_client.record import Record
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
    client_token,
    command_key,
    decode,
    encode,
)

SHORT = ("--system", "cartpole", "--learn", "2", "--duration", "4.5")


def tasks(service: Any) -> list[LqrTask]:
    return [message for message in service.seen if isinstance(message, LqrTask)]


@pytest.mark.parametrize(("drive", "method"), [("lqr", "gain"), ("mpc", "qp")])
def test_the_service_drives_the_pole(
    knowing: Callable, command: Callable, drive: str, method: str
) -> None:
    options = ("--system", "cartpole", "--drive", drive, "--learn", "5", "--duration", "9")
    service = knowing(*options)
    out, _ = command(*options, "--json")
    result = json.loads(out)
    (drive_of_it,) = result["drives"]
    assert drive_of_it["outcome"]["success"]
    assert drive_of_it["began"] == 5.0
    assert drive_of_it["seconds"] == pytest.approx(4.0)
    assert drive_of_it["statuses"]["solved"] >= 80
    assert result["totals"]["success_rate"] == 1.0
    (task,) = tasks(service)
    assert (task.query.method, task.query.delay, task.frozen) == (method, 0, False)
    assert isinstance(service.seen[-1], LqrCancel)
    assert [frame.seq for frame in service.frames] == list(range(180))
    assert [control.seq for control in service.controls] == list(range(180))


@pytest.mark.parametrize("drive", ["pd", "state-lqr"])
def test_a_law_of_the_true_state_asks_nobody(
    knowing: Callable, command: Callable, drive: str
) -> None:
    options = ("--system", "pendulum", "--drive", drive, "--learn", "5", "--duration", "9")
    service = knowing(*options)
    out, _ = command(*options, "--json", "--starts", "-1", "1")
    result = json.loads(out)
    assert result["drives"][0]["outcome"]["success"]
    assert result["drives"][0]["command"] is None
    assert not tasks(service)


def test_a_frozen_model_and_a_slow_camera_are_told(knowing: Callable, command: Callable) -> None:
    options = (*SHORT, "--drive", "mpc", "--delay", "0.1", "--frozen", "--force")
    service = knowing(*options)
    out, _ = command(*options, "--json")
    (task,) = tasks(service)
    assert (task.query.delay, task.frozen, task.query.force) == (2, True, True)
    (drive,) = json.loads(out)["drives"]
    assert (drive["delay"], drive["began"]) == (2, 2.0)


def test_a_model_that_becomes_fit_later_drives_later(knowing: Callable, command: Callable) -> None:
    options = (*SHORT, "--drive", "mpc")
    service = knowing(*options)
    service.unfit = 20
    out, err = command(*options, "--json")
    (drive,) = json.loads(out)["drives"]
    assert len(tasks(service)) == 21
    assert drive["began"] == pytest.approx(39 * 0.05 + 20 * 0.05)
    assert drive["seconds"] == pytest.approx(2.5)  # all the same
    assert "cartpole-actuated/0 is not fit for control yet: the motor has hardly moved" in err


def test_a_model_that_never_becomes_fit_is_given_up(
    knowing: Callable, command: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    options = (*SHORT, "--drive", "mpc")
    service = knowing(*options)
    service.unfit = 10_000
    with pytest.raises(SystemExit, match="did not drive: the motor has hardly moved"):
        command(*options, "--json")
    result = json.loads(capsys.readouterr().out)
    assert result["drives"][0]["outcome"] is None
    assert result["totals"]["success_rate"] == 0.0
    assert len(tasks(service)) == 201


def test_trouble_is_not_streamed(knowing: Callable, command: Callable, tmp_path: Path) -> None:
    options = ("--system", "pendulum", "--drive", "state-lqr", "--learn", "2", "--duration", "5")
    service = knowing(*options)
    record, mishap = tmp_path / "run.npz", ("--kick", "1", "--kick-at", "1", "--noise", "0.5")
    command(*options, *mishap, "--change-mass-at", "2", "--record", str(record))
    saved = Record.load(record)
    torques = [control.u[0] for control in service.controls[40:]]
    assert saved.drives.shape == (1, 60, 3)
    assert saved.drive_torques.tolist() == torques
    rates = saved.drives[0, :, 1]
    assert np.argmax(np.abs(np.diff(rates[5:]))) + 5 in (19, 20)  # the kick, after a second
    assert np.abs(np.array(torques)).max() <= 20.0


class Puppeteer:
    """A service of constant torques, for as many plants as there are."""

    def __init__(self, hub: zenoh.Session, refusal: ErrorReply | None = None) -> None:
        self.tasks: dict[str, LqrTask] = {}
        self.cancelled: list[str] = []
        self.controls: dict[str, list[float]] = {}
        self.order: list[str] = []
        self._hub, self._refusal = hub, refusal
        self._epochs: dict[str, tuple[str, int]] = {}
        direct: Any = zenoh.handlers.Callback
        self._declared = [
            hub.declare_subscriber(f"koop/{kind}/**", direct(self._take, indirect=False))
            for kind in ("frame", "control")
        ]
        self._declared += [
            hub.declare_queryable("koop/lqr/**", direct(self._lqr, indirect=False)),
            hub.declare_queryable("koop/state/**", self._refuse),
            hub.declare_queryable("koop/predict/**", self._refuse),
        ]

    def _take(self, sample: zenoh.Sample) -> None:
        message = decode(bytes(sample.payload))
        if isinstance(message, Control):
            self.controls.setdefault(message.trajectory, []).append(float(message.u[0]))
        if isinstance(message, Frame):
            self.order.append(message.trajectory)
            self._epochs[message.trajectory] = (message.epoch, message.seq)
            task = self.tasks.get(message.trajectory)
            if task is not None:
                who = (message.trajectory, message.epoch, message.seq, message.seq)
                plan = np.full((10, 1), self._torque(message.trajectory))
                answer = Command(*who, plan, "solved", 1.0, 0.0, task.owner)
                self._hub.put(command_key(message.trajectory), encode(answer))

    @staticmethod
    def _torque(name: str) -> float:
        return 1.0 + int(name.rsplit("/")[-1])

    def _lqr(self, query: zenoh.Query) -> None:
        with query:
            name = str(query.key_expr).removeprefix("koop/lqr/")
            asked = decode(bytes(query.payload or b""))
            if isinstance(asked, LqrCancel):
                self.cancelled.append(name)
                self.tasks.pop(name)
                end = LqrEnd(name, asked.owner, EndReason.cancelled, "as asked")
                query.reply(query.key_expr, encode(end))
            elif self._refusal is not None:
                query.reply_err(encode(self._refusal))
            elif isinstance(asked, LqrTask):
                self.tasks[name] = asked
                plan = np.full((10, 1), self._torque(name))
                epoch, seq = self._epochs[name]
                reply = LqrReply(name, epoch, seq, "solved", 1.0, 0.0, plan, start=seq)
                query.reply(query.key_expr, encode(reply))

    def _refuse(self, query: zenoh.Query) -> None:
        with query:
            query.reply_err(encode(ErrorReply("warming_up", "warming up")))


@pytest.mark.parametrize("rate", ["realtime", "max"])
def test_several_plants_are_driven_at_once(
    hub: zenoh.Session, command: Callable, rate: str
) -> None:
    service = Puppeteer(hub)
    options = ("--learn", "0.5", "--duration", "1.5", "--trajectories", "3", "--first", "4")
    names = [f"cartpole-actuated/{i}" for i in (4, 5, 6)]
    out, err = command("--system", "cartpole", "--drive", "mpc", *options, "--json", rate=rate)
    result = json.loads(out)
    assert [drive["trajectory"] for drive in result["drives"]] == names
    assert result["totals"]["plants"] == result["totals"]["driven"] == 3
    assert result["totals"]["command"]["count"] >= 30
    assert sorted(service.cancelled) == names
    assert service.order == names * (len(service.order) // 3)
    for name in names:
        driven = service.controls[name][-15:]
        assert driven == pytest.approx([1.0 + int(name[-1])] * 15)
    assert len({drive["start"] for drive in result["drives"]}) == 1
    assert "0 of 3 at the target" in err


def test_another_s_plant_is_left_alone(hub: zenoh.Session, command: Callable) -> None:
    message = "line3 has a task on cartpole-actuated/0; wait for it to end"
    Puppeteer(hub, ErrorReply("task_taken", message, {"owner": "line3"}))
    with pytest.raises(SystemExit, match="line3 has a task on"):
        command(*SHORT, "--drive", "lqr")


def test_the_owner_is_alive_while_it_drives(hub: zenoh.Session, command: Callable) -> None:
    service = Puppeteer(hub)
    seen: list[tuple[str, bool]] = []

    def on_token(sample: zenoh.Sample) -> None:
        seen.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

    declared = hub.liveliness().declare_subscriber("koop/@client/*", on_token, history=True)
    command("--system", "cartpole", "--drive", "mpc", "--learn", "0.5", "--duration", "1")
    assert service.cancelled == ["cartpole-actuated/0"]
    (first, last) = seen
    assert first == (last[0], True)
    assert last == (first[0], False)
    assert client_token(first[0].rsplit("/")[-1]) == first[0]
    del declared
