"""What each certificate may do behind the shipped access rules, and what never gets through.

A session's questions travel behind what it put. So once the answer to a flush is there, what was
put has been handed on, or has been dropped for good.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh
from integration.loopback import DEADLINE, picture, wait_until
from integration.secured import (
    EVERYTHING,
    NOW,
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
from koop_clients.control import Controller
from koop_clients.pki.certificates import make_client
from koop_clients.pki.storage import CONFIGURATION, load_identity, replace_identity
from koop_clients.sources import FrameSource
from koop_protocol import (
    LqrQuery,
    LqrTask,
    client_token,
    command_key,
    control_key,
    encode,
    frame_key,
    lqr_key,
    replay_key,
)

ROBOT, OTHER = "line3/robot7", "line3/robot8"
FRAMES = 40  # past the warm-up
QUERY = LqrQuery(10, picture(0, 100), u_min=-np.ones(1), u_max=np.ones(1), force=True)


@pytest.fixture(scope="module", autouse=True)
def streamed(guarded: Secured) -> None:
    """Both robots have streamed, each with its own certificate."""
    for certificate, name in (("robot7", ROBOT), ("robot8", OTHER)):
        with guarded.session(certificate) as session:
            stream(session, name, FRAMES)


def durable_key(name: str) -> str:
    """On which the service says what a source's log need not keep."""
    return replay_key(name).replace("replay", "durable")


# What works


def test_every_frame_of_a_source_arrives(guarded: Secured) -> None:
    """Also those after the first: Zenoh's publishers stop where they may not learn who listens."""
    with guarded.session("robot7") as session:
        with FrameSource(session, ROBOT, control_size=1, renderer="test-renderer") as source:
            for seq in range(FRAMES):
                source.put_frame(picture(0, seq))
                source.put_control([0.1])
        state = asking(session).state(ROBOT)
        assert (state.epoch, state.frames) == (source.epoch, FRAMES)
        ahead = asking(session).predict(ROBOT, 5, returns={"codes", "frames", "std"})
        assert ahead.frames.shape == (5, 64, 64)


def test_a_viewer_asks_about_all_and_by_a_declared_querier_too(guarded: Secured) -> None:
    with guarded.session("wall") as session:
        assert set(asking(session).predict_all(5)) >= {ROBOT, OTHER}
        assert asking(session).state(OTHER).trajectory == OTHER
        with session.declare_querier(f"koop/state/{ROBOT}") as querier:
            assert [str(reply.ok.key_expr) for reply in querier.get()] == [f"koop/state/{ROBOT}"]


def test_an_operator_drives(guarded: Secured) -> None:
    with guarded.session("operator") as session, guarded.session("robot8") as robot:
        source = stream(robot, OTHER, FRAMES)
        with Controller(session, OTHER, QUERY, timeout=DEADLINE) as controller:
            begun = controller.begin()
            assert begun.controls is not None
            source.put(source.control(begun.seq))
            source.put(source.frame(begun.seq + 1))
            assert controller.wait(begun.seq + 1, timeout=DEADLINE)
        assert controller.command is not None
        assert controller.command.seq == begun.seq + 1


def test_a_recorder_receives_frames_and_controls(guarded: Secured) -> None:
    with guarded.session("recorder") as session, guarded.session("robot8") as robot:
        keys = ("koop/frame/*/line3/*", "koop/control/*/line3/*")
        with overhearing(session, *keys) as witness:
            stream(robot, OTHER, 3)
            wait_until(lambda: len(witness.keys) == 5, "three frames and two controls")


def test_a_source_answers_for_its_own_past(guarded: Secured) -> None:
    """The replay of its own trajectory reaches it, and its token is seen."""
    key, token = replay_key(ROBOT), replay_key(ROBOT).replace("replay", "@source")
    with guarded.session("robot7") as session, overhearing(guarded.hub, "koop/@source/**") as seen:
        with (
            session.declare_queryable(key, lambda query: query.reply(key, b"the past")),
            session.liveliness().declare_token(token),
        ):
            flush(session)
            (reply,) = guarded.hub.get(key, timeout=DEADLINE)
            assert reply.ok.payload.to_bytes() == b"the past"
        wait_until(lambda: seen.keys == [token, token], "the token's coming and going")


def test_a_source_hears_what_it_need_not_keep(guarded: Secured) -> None:
    key = durable_key(ROBOT)
    with guarded.session("robot7") as session, overhearing(session, key) as witness:
        guarded.hub.put(key, b"")
        wait_until(lambda: witness.keys == [key], "the word of the service")


# What does not


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
            put_everywhere(robber, keys, encode(forged))
            assert witness.keys == []
            assert asking(session).state(OTHER) == before
            source.put(forged)
            assert asking(session).state(OTHER).next_seq == FRAMES + 1
            assert witness.keys == [frame_key(OTHER)]


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
        put_everywhere(session, [frame_key(OTHER), "koop/frame/**"], encode(source.frame(0)))
        assert witness.keys == []
        source.put(source.frame(0))
        flush(robot)
        assert witness.keys == [frame_key(OTHER)]


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
        assert set(witness.keys) == {client_token("somebody")}


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
    """Nor for another's past."""
    heard = Witness()
    keys = ["koop/**", f"koop/state/{OTHER}", "koop/predict/**", replay_key(OTHER)]
    with guarded.session("robot7") as liar, guarded.session("wall") as viewer:
        declared = [liar.declare_queryable(key, heard.see) for key in keys]
        flush(liar)
        asked = list(
            viewer.get(f"koop/state/{OTHER}", target=zenoh.QueryTarget.ALL, timeout=DEADLINE)
        )
        assert len(asked) == 1
        assert list(guarded.hub.get(replay_key(OTHER), timeout=DEADLINE)) == []
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
        silence(lambda: asking(session).state(ROBOT))
        silence(lambda: asking(session).predict_all(5))
        silence(lambda: asking(session).lqr(ROBOT, QUERY))
        assert witness.keys == []
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
            assert witness.keys == []
        heard.keys.clear()  # its own
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
    with guarded.session("robot8") as session, overhearing(guarded.hub) as witness:
        source = stream(session, OTHER, 1)
        source.put_raw(frame_key(OTHER), bytes(9 << 20))
        source.put(replace(source.frame(1), image=picture(0, 1)))
        flush(session)
        assert witness.keys == [frame_key(OTHER), frame_key(OTHER)]
        state = asking(session).state(OTHER)
        assert (state.epoch, state.next_seq) == (source.epoch, 2)
