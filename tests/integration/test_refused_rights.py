"""What never gets through the shipped access rules, with a good certificate.

A session's questions travel behind what it put. So once the answer to a flush is there, what was
put has been handed on, or has been dropped for good.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh
from integration.loopback import DEADLINE, wait_until
from integration.secured import (
    EVERYTHING,
    FRAMES,
    NOW,
    OTHER,
    QUERY,
    ROBOT,
    Secured,
    Witness,
    asking,
    begin,
    overhearing,
    put_everywhere,
    silence,
    stream,
)

from koop_clients.connection import flush, open_session
from koop_clients.pki.certificates import make_client
from koop_clients.pki.storage import CONFIGURATION, load_identity, replace_identity
from koop_protocol import (
    SOURCE_TOKENS,
    LqrTask,
    client_token,
    command_key,
    control_key,
    durable_key,
    encode,
    frame_key,
    lqr_key,
    replay_key,
    source_token,
    state_key,
)

pytestmark = pytest.mark.usefixtures("streamed")


def test_a_source_cannot_write_for_another(guarded: Secured) -> None:
    """Nothing of it reaches the service, though the same bytes from the right source do."""
    with guarded.session("robot8") as session, guarded.session("robot7") as robber:
        source = stream(session, OTHER, FRAMES)
        before = asking(session).state(OTHER)
        assert before.next_seq == FRAMES
        forged = source.frame(FRAMES)
        keys = [frame_key(OTHER), control_key(OTHER), "koop/frame/**", "koop/frame/*/line3/*"]
        with overhearing(guarded.hub) as witness:
            keys += [command_key(OTHER), command_key(ROBOT), durable_key(OTHER), durable_key(ROBOT)]
            keys += [state_key(OTHER), state_key(ROBOT)]
            put_everywhere(robber, keys, encode(forged))
            assert witness.keys_of(encode(forged)) == []
            assert asking(session).state(OTHER) == before
            source.put(forged)
            assert asking(session).state(OTHER).next_seq == FRAMES + 1
            assert witness.keys_of(encode(forged)) == [frame_key(OTHER)]


def test_a_source_cannot_write_for_another_under_its_own_key(guarded: Secured) -> None:
    """The hub lets it pass, and the service refuses a payload that names somebody else."""
    rejected = guarded.service.metrics.value
    before = rejected("koop_rejected_total", reason="bad_key")
    with guarded.session("robot7") as session, guarded.session("wall") as viewer:
        known = asking(viewer).state(OTHER)
        frame = replace(begin(session, OTHER), epoch=known.epoch).frame(known.next_seq)
        session.put(frame_key(ROBOT), encode(frame))
        asking(session).state(ROBOT)
        assert rejected("koop_rejected_total", reason="bad_key") == before + 1
        assert asking(viewer).state(OTHER) == known


@pytest.mark.parametrize("certificate", ["wall", "operator", "recorder", "robot7", "service"])
def test_nobody_but_the_source_puts_frames(guarded: Secured, certificate: str) -> None:
    with (
        guarded.session(certificate) as session,
        guarded.session("robot8") as robot,
        overhearing(guarded.hub) as witness,
    ):
        source = begin(robot, OTHER)
        payload = encode(source.frame(0))
        put_everywhere(session, [frame_key(OTHER), "koop/frame/**"], payload)
        assert witness.keys_of(payload) == []
        source.put(source.frame(0))
        wait_until(lambda: bool(witness.keys_of(payload)))
        flush(robot)
        assert witness.keys_of(payload) == [frame_key(OTHER)]


@pytest.mark.parametrize("certificate", ["wall", "robot7", "recorder"])
def test_only_an_operator_plans_and_drives(guarded: Secured, certificate: str) -> None:
    """The very task that an operator then begins; its owner's token is there all the time."""
    task, tasks = LqrTask("somebody", QUERY), lambda: guarded.service.metrics.value("koop_tasks")
    with (
        guarded.session("operator") as operator,
        guarded.session(certificate) as session,
        operator.liveliness().declare_token(client_token("somebody")),
    ):
        silence(lambda: asking(session).lqr(ROBOT, QUERY))
        silence(lambda: asking(session).begin(ROBOT, task))
        assert tasks() == 0
        assert asking(operator).begin(ROBOT, task).controls is not None
        silence(lambda: asking(session).cancel(ROBOT, "somebody"))
        assert tasks() == 1
        asking(operator).cancel(ROBOT, "somebody")


@pytest.mark.parametrize("certificate", ["wall", "robot7", "recorder"])
def test_who_owns_no_task_declares_no_token(guarded: Secured, certificate: str) -> None:
    with (
        guarded.session(certificate) as session,
        guarded.session("operator") as operator,
        overhearing(guarded.hub) as witness,
    ):
        for name, declaring in (("nobody", session), ("somebody", operator)):
            with declaring.liveliness().declare_token(client_token(name)):
                flush(declaring)
        flush(operator)
        assert {k for k in witness.keys if "@" in k} == {client_token("somebody")}


def test_an_operator_keeps_to_its_trajectories(guarded: Secured) -> None:
    with guarded.session("cartpole") as session:
        silence(lambda: asking(session).lqr(ROBOT, QUERY))
        silence(lambda: asking(session).state(ROBOT))
        answered = session.get(
            lqr_key("cartpole-actuated/0"), payload=encode(QUERY), timeout=DEADLINE
        )
        assert [reply.err is not None for reply in answered] == [True], "asked, and no such frames"


def test_a_source_asks_only_about_itself(guarded: Secured) -> None:
    with guarded.session("robot7") as session:
        silence(lambda: asking(session).state(OTHER))
        silence(lambda: asking(session).predict_all(5))
        assert asking(session).state(ROBOT).trajectory == ROBOT


@pytest.mark.parametrize("certificate", ["wall", "robot7", "operator"])
def test_who_may_not_record_overhears_nothing(guarded: Secured, certificate: str) -> None:
    """Frames of others reach none of them, though a recorder gets them."""
    keys = (*EVERYTHING, frame_key(OTHER), "koop/frame/**", durable_key(OTHER))
    with (
        guarded.session(certificate) as session,
        guarded.session("recorder") as recorder,
        guarded.session("robot8") as robot,
        overhearing(session, *keys) as witness,
        overhearing(recorder, frame_key(OTHER)) as received,
    ):
        stream(robot, OTHER, 3)
        wait_until(lambda: len(received.keys) == 3, "the frames, at the recorder")
        asking(session).state(ROBOT)  # the answer comes behind whatever was on its way
        assert witness.keys == []


def test_nobody_answers_in_the_services_place(guarded: Secured) -> None:
    heard = Witness()
    keys = ["koop/**", f"koop/state/{OTHER}", "koop/predict/**"]
    with guarded.session("robot7") as liar, guarded.session("wall") as viewer:
        declared = [liar.declare_queryable(key, heard.see) for key in keys]
        flush(liar)
        asked = list(
            viewer.get(f"koop/state/{OTHER}", target=zenoh.QueryTarget.ALL, timeout=DEADLINE)
        )
        assert len(asked) == 1
        assert heard.keys == []
        for declaration in declared:
            declaration.undeclare()


def test_a_certificate_without_rights_gets_in_and_gets_nothing(
    guarded: Secured, tmp_path: Path
) -> None:
    """As of somebody who was removed."""
    folder = guarded.deployment.folder
    for file in (folder / "wall").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    stranger = make_client(load_identity(folder / "ca"), "stranger", NOW)
    replace_identity(tmp_path, stranger)
    with (
        open_session(guarded.endpoint, config_file=tmp_path / CONFIGURATION) as session,
        overhearing(guarded.hub) as witness,
        overhearing(session, "**", "koop/@client/*") as heard,
    ):
        put_everywhere(session, [frame_key(ROBOT), frame_key("line3/mine")], b"anything")
        assert witness.keys_of(b"anything") == []
        silence(lambda: asking(session).state(ROBOT))
        silence(lambda: asking(session).predict_all(5))
        silence(lambda: asking(session).lqr(ROBOT, QUERY))
        # Its own puts come back to it inside its own session; nothing else does.
        assert set(heard.keys) <= {frame_key(ROBOT), frame_key("line3/mine")}


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_a_certificate_gains_nothing_by_posing_as_a_router(
    guarded: Secured, tmp_path: Path, mode: str
) -> None:
    folder = guarded.deployment.folder / "robot7"
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    text = (tmp_path / CONFIGURATION).read_text().replace('mode: "client"', f'mode: "{mode}"')
    text = text.replace("  connect: {", "  listen: { endpoints: [] },\n  connect: {")
    (tmp_path / CONFIGURATION).write_text(text)
    forged = encode(begin(guarded.hub, OTHER).frame(0))
    with (
        open_session(guarded.endpoint, config_file=tmp_path / CONFIGURATION) as session,
        guarded.session("robot8") as robot,
        overhearing(session, frame_key(OTHER), "koop/command/**") as heard,
    ):
        assert session.info.routers_zid()
        with overhearing(guarded.hub) as witness:
            put_everywhere(session, [frame_key(OTHER), command_key(OTHER)], forged)
            assert witness.keys_of(forged) == []
        heard.forget()  # its own
        stream(robot, OTHER, 3)
        silence(lambda: asking(session).state(OTHER))
        assert heard.keys == []


@pytest.mark.parametrize("certificate", ["wall", "service", "robot7"])
def test_nobody_reads_the_hubs_admin_space(guarded: Secured, certificate: str) -> None:
    space = f"@/{guarded.hub.zid()}/router"
    (own,) = guarded.hub.get(space, timeout=DEADLINE)
    assert json.loads(own.ok.payload.to_string())["locators"]
    with guarded.session(certificate) as session:
        assert list(session.get(space, timeout=DEADLINE)) == []


def test_a_message_too_large_for_the_hub_is_dropped_and_the_link_lives(guarded: Secured) -> None:
    with (
        guarded.session("robot8") as session,
        overhearing(guarded.hub, frame_key(OTHER)) as witness,
    ):
        source = stream(session, OTHER, 1)
        source.put_raw(frame_key(OTHER), bytes(65 << 20))
        source.put(source.frame(1))
        flush(session)
        wait_until(lambda: len(witness.keys) == 2, "the frames before and after it")
        state = asking(session).state(OTHER)
        assert (state.epoch, state.next_seq) == (source.epoch, 2)
        assert len(witness.keys) == 2


def test_a_source_answers_for_nobody_else(guarded: Secured) -> None:
    """Neither its queryable on another's past nor its token in another's name gets through."""
    with (
        guarded.session("robot7") as liar,
        guarded.session("robot8") as session,
        overhearing(guarded.hub, SOURCE_TOKENS) as seen,
        liar.declare_queryable(replay_key(OTHER), lambda query: query.reply(query.key_expr, b"")),
        liar.liveliness().declare_token(source_token(OTHER)),
        liar.declare_subscriber(durable_key(OTHER)) as overheard,
    ):
        flush(liar)
        assert list(guarded.hub.get(replay_key(OTHER), timeout=DEADLINE)) == []
        assert seen.keys == []
        with session.declare_subscriber(durable_key(OTHER)) as heard:
            flush(session)
            guarded.hub.put(durable_key(OTHER), b"")
            assert heard.recv().payload.to_bytes() == b""
        asking(liar).state(ROBOT)  # the answer comes behind whatever was on its way
        assert overheard.try_recv() is None
