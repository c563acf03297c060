"""Closed-loop tasks over real Zenoh: commands at each frame, until somebody ends them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
from integration.loopback import (
    Inbox,
    Loop,
    Source,
    client,
    config_for,
    picture,
    wait_until,
)

from koop_protocol import (
    EndReason,
    ErrorReply,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    client_token,
    command_key,
    encode,
    lqr_key,
)
from koop_service.assembly import running
from koop_service.serving.session import locators, open_session

BOUND = np.array([0.5])
QUERY = LqrQuery(10, picture(0, 100), u_min=-BOUND, u_max=BOUND, force=True)
TASK = LqrTask("me", QUERY)


@pytest.fixture
def owned(koop: Loop) -> Iterator[Loop]:
    with koop.owner("me"):
        yield koop


def advance(source: Source, seq: int) -> None:
    """The next frame, and the control that led to it."""
    source.put(source.control(seq - 1))
    source.put(source.frame(seq))


def test_a_command_comes_at_each_frame_until_the_task_is_cancelled(owned: Loop, cart: Source):
    with owned.commands("cart/0") as inbox:
        first = owned.task("cart/0", replace(TASK, query=replace(QUERY, delay=2)))
        assert isinstance(first, LqrReply), first
        assert (first.seq, first.start) == (39, 41)
        for seq in range(40, 45):
            advance(cart, seq)
            command = inbox.of_frame(seq)
            assert (command.trajectory, command.epoch) == ("cart/0", cart.epoch)
            assert (command.owner, command.status, command.start) == ("me", "solved", seq + 2)
            assert command.controls.shape == (10, 1)
            assert (np.abs(command.controls) <= 0.5).all()
        assert owned.service.metrics.value("koop_tasks") == 1
        end = owned.task("cart/0", LqrCancel("me"))
        assert isinstance(end, LqrEnd)
        assert end.reason == EndReason.cancelled
        assert inbox.end() == end
        advance(cart, 45)
        assert owned.state("cart/0").next_seq == 46
        assert len(inbox.commands()) == 5
    value = owned.service.metrics.value
    assert value("koop_commands_total", status="solved") == 5
    assert value("koop_command_seconds_count") == 5
    assert value("koop_tasks") == 0


def test_the_first_command_goes_on_where_the_reply_left_off(owned: Loop, cart: Source):
    """The same codes give the same plan, in a query and in a task."""
    asked = owned.lqr("cart/0", QUERY)
    begun = owned.task("cart/0", TASK)
    np.testing.assert_array_equal(asked.controls, begun.controls)
    with owned.commands("cart/0") as inbox:
        advance(cart, 40)
        command = inbox.of_frame(40)
        again = owned.lqr("cart/0", QUERY)
        np.testing.assert_allclose(command.controls, again.controls, atol=1e-6)


def test_its_owner_changes_the_target(owned: Loop, cart: Source):
    owned.task("cart/0", TASK)
    with owned.commands("cart/0") as inbox:
        owned.task("cart/0", replace(TASK, query=replace(QUERY, horizon=7)))
        advance(cart, 40)
        assert inbox.of_frame(40).controls.shape == (7, 1)
        assert inbox.ends() == []
    assert owned.service.metrics.value("koop_tasks") == 1


CLIENT = """
import sys, time
from integration.loopback import client
from koop_protocol import client_token
with client(sys.argv[1]) as session:
    token = session.liveliness().declare_token(client_token("mortal"))
    payload = bytes.fromhex(sys.argv[2])
    (reply,) = session.get("koop/lqr/cart/0", payload=payload, timeout=30.0)
    print("begun" if reply.ok else reply.err.payload.to_bytes(), flush=True)
    time.sleep(600)
"""


def test_a_client_that_is_killed_gets_no_further_commands(koop: Loop, cart: Source):
    script = [sys.executable, "-c", CLIENT, koop.service.endpoints[0]]
    task = LqrTask("mortal", replace(QUERY, target_image=None, target_code=np.zeros(8)))
    folders = {"PYTHONPATH": ":".join(sys.path)}
    with (
        koop.commands("cart/0") as inbox,
        subprocess.Popen(
            [*script, encode(task).hex()], stdout=subprocess.PIPE, text=True, env=folders
        ) as process,
    ):
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "begun\n"
            advance(cart, 40)
            assert inbox.of_frame(40).owner == "mortal"
        finally:
            process.kill()
        end = inbox.end()
        assert (end.owner, end.reason) == ("mortal", EndReason.owner_gone)
        advance(cart, 41)
        assert koop.state("cart/0").next_seq == 42
        assert len(inbox.commands()) == 1


def test_a_second_owner_is_refused_until_the_first_is_gone(koop: Loop, cart: Source):
    with koop.commands("cart/0") as inbox, koop.owner("you"):
        with koop.owner("me"):
            assert isinstance(koop.task("cart/0", TASK), LqrReply)
            for order in (replace(TASK, owner="you"), LqrCancel("you")):
                refusal = koop.task("cart/0", order)
                assert isinstance(refusal, ErrorReply)
                assert refusal.code == "task_taken"
                assert refusal.details == {"owner": "me", "trajectory": "cart/0"}
            advance(cart, 40)
            assert inbox.of_frame(40).owner == "me"
        assert inbox.end().reason == EndReason.owner_gone
        assert isinstance(koop.task("cart/0", replace(TASK, owner="you")), LqrReply)


@pytest.mark.usefixtures("cart")
def test_an_owner_of_another_session_counts_too_as_long_as_it_is_there(koop: Loop):
    """A token goes before the task that was asked for after it, every time."""
    for _ in range(20):
        with client(koop.service.endpoints[0]) as other:
            token = other.liveliness().declare_token(client_token("me"))  # until it is collected
            (reply,) = other.get(lqr_key("cart/0"), payload=encode(TASK), timeout=30.0)
            assert reply.ok is not None, reply.err.payload.to_bytes()
            token.undeclare()
        wait_until(lambda: koop.service.metrics.value("koop_tasks") == 0, "its end")
    assert koop.task("cart/0", TASK).code == "no_owner"


@pytest.mark.usefixtures("cart")
def test_a_task_ends_when_its_time_is_over_though_no_frame_comes(owned: Loop):
    with owned.commands("cart/0") as inbox:
        owned.task("cart/0", replace(TASK, seconds=0.05))
        assert inbox.end().reason == EndReason.expired


def test_a_new_epoch_ends_the_task(owned: Loop, cart: Source):
    with owned.commands("cart/0") as inbox:
        owned.task("cart/0", TASK)
        replace(cart, epoch="00000000000000bb").stream(2)
        assert inbox.end().reason == EndReason.replaced_epoch
        assert inbox.commands() == []


def test_a_stopping_service_ends_its_tasks(tmp_path: Path, model: Path):
    config = config_for(tmp_path, model)
    with open_session(config.network) as hub, client(locators(hub)[0]) as session:
        inbox = Inbox()
        subscriber = session.declare_subscriber(command_key("cart/0"), inbox.put)
        token = session.liveliness().declare_token(client_token("me"))
        with running(config, hub) as service:
            koop = Loop(service, session, config)
            Source(session, "cart/0").stream(40)
            assert isinstance(koop.task("cart/0", TASK), LqrReply)
        assert inbox.end().reason == EndReason.shutdown
        token.undeclare()
        subscriber.undeclare()


@pytest.mark.parametrize("forced", [False, True])
def test_an_unfit_model_gives_a_probing_input_and_no_task(owned: Loop, cart: Source, forced: bool):
    """What the discs do has nothing to do with the controls, and the certificate says so."""
    cart.stream(80, start=40)
    reply = owned.task("cart/0", replace(TASK, query=replace(QUERY, force=forced)))
    assert isinstance(reply, LqrReply)
    assert not reply.fit
    assert reply.reasons
    assert (reply.controls is None) == (not forced)
    assert (reply.probing is None) == forced
    assert forced or (np.abs(reply.probing) <= 0.5).all()
    assert owned.service.metrics.value("koop_tasks") == forced


@pytest.mark.usefixtures("cart")
def test_a_target_out_of_reach_is_warned_of(owned: Loop):
    far = replace(QUERY, target_image=None, target_code=np.full(8, 1e3))
    reply = owned.task("cart/0", replace(TASK, query=far))
    assert isinstance(reply, LqrReply)
    assert "can hold within the bounds" in reply.warnings[0]


def changed(**query: object) -> bytes:
    """A task whose query was changed by hand."""
    plain = LqrTask("me", LqrQuery(5, target_code=np.zeros(8), force=True))
    task = msgpack.unpackb(encode(plain))
    return msgpack.packb({**task, "query": {**task["query"], **query}})


def array(values: object) -> dict[str, object]:
    values = np.asarray(values, np.float64)
    return {"dtype": "f8", "shape": values.shape, "data": values.tobytes()}


@pytest.mark.parametrize(
    ("code", "payload"),
    [
        ("bad_bounds", changed(u_min=array([1.0]), u_max=array([-1.0]))),
        ("bad_bounds", changed(du_min=array([0.5]))),
        ("bad_bounds", changed(u_min=array([9.0]), du_max=array([0.1]))),
        ("not_finite", changed(r=float("nan"))),
        ("not_finite", changed(q=array(np.full(8, np.nan)))),
        ("bad_weights", changed(r=0.0)),
        ("bad_target", changed(target_code=None)),
        ("bad_target", changed(target_code=array(np.zeros((3, 5))))),
        ("malformed", changed(returns=["codes"])),
        ("no_task", encode(LqrCancel("me"))),
        ("no_owner", encode(LqrTask("nobody", QUERY))),
    ],
)
@pytest.mark.usefixtures("cart")
def test_a_bad_order_gets_an_error_and_begins_nothing(owned: Loop, code: str, payload: bytes):
    reply = owned.ask_one(lqr_key("cart/0"), payload)
    assert isinstance(reply, ErrorReply), reply
    assert reply.code == code, reply.message
    assert owned.service.metrics.value("koop_tasks") == 0


@pytest.mark.usefixtures("cart")
def test_a_strange_token_is_passed_over(owned: Loop):
    with owned.session.liveliness().declare_token("koop/@client/not~a~name"):
        assert isinstance(owned.task("cart/0", TASK), LqrReply)
        wait_until(lambda: owned.service.metrics.value("koop_tasks") == 1)
