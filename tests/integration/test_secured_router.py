"""The service as a leaf of a router that has the shipped rules: the same rights, from outside."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from integration.loopback import DEADLINE, wait_until
from integration.secured import HOST, OTHER, QUERY, ROBOT, Secured, begin, deploy, stream

from koop_clients.connection import flush
from koop_clients.control import Controller
from koop_clients.queries import KoopClient
from koop_protocol import (
    SOURCE_TOKENS,
    durable_key,
    encode,
    frame_key,
    replay_key,
    source_token,
)
from koop_service.assembly import running
from koop_service.serving.config import ModelRule, NetworkSettings, ServiceConfig
from koop_service.serving.session import locators, open_session


@pytest.fixture(scope="module")
def leaf(tmp_path_factory: pytest.TempPathFactory, model: Path) -> Iterator[Secured]:
    """Router and service with one session each; `hub` is the service's."""
    folder = tmp_path_factory.mktemp("router")
    deployment = deploy(folder / "pki")
    router = NetworkSettings(zenoh_config=deployment.configuration, listen=(f"tls/{HOST}:0",))
    with open_session(router) as session:
        endpoint = locators(session)[0]
        file = deployment.folder / "service" / "zenoh.json5"
        network = NetworkSettings(zenoh_config=file, connect=(endpoint,))
        models = (ModelRule(model, ("line3/*",)),)
        config = ServiceConfig(models=models, state_folder=folder / "state", network=network)
        with open_session(network) as own, running(config, own) as service:
            yield Secured(service, own, deployment, endpoint)


def tokens(leaf: Secured) -> list[str]:
    """Of the sources that the service sees."""
    replies = leaf.hub.liveliness().get(SOURCE_TOKENS, timeout=DEADLINE)
    return [str(reply.ok.key_expr) for reply in replies]


def test_it_hears_and_answers(leaf: Secured) -> None:
    with leaf.session("robot7") as robot, leaf.session("wall") as viewer:
        source = stream(robot, ROBOT, 40)
        assert KoopClient(robot, DEADLINE).state(ROBOT).frames == 40
        ahead = KoopClient(viewer, DEADLINE).predict_all(5)[ROBOT]
        assert (ahead.epoch, ahead.seq) == (source.epoch, 39)


def test_its_commands_reach_the_operator(leaf: Secured) -> None:
    with leaf.session("robot8") as robot, leaf.session("operator") as session:
        source = stream(robot, OTHER, 40)
        with Controller(session, OTHER, QUERY, timeout=DEADLINE) as controller:
            assert controller.begin().controls is not None
            source.put(source.control(39))
            source.put(source.frame(40))
            assert controller.wait(40, timeout=DEADLINE)


def test_it_asks_sources_for_their_past_and_knows_who_is_there(leaf: Secured) -> None:
    key, token = replay_key(ROBOT), source_token(ROBOT)
    with (
        leaf.session("robot7") as robot,
        robot.declare_queryable(key, lambda query: query.reply(key, b"the past")),
        robot.liveliness().declare_token(token),
    ):
        wait_until(lambda: tokens(leaf) == [token], "the source's token")
        (reply,) = leaf.hub.get(key, timeout=DEADLINE)
        assert reply.ok.payload.to_bytes() == b"the past"


def test_it_tells_sources_what_they_need_not_keep(leaf: Secured) -> None:
    key, heard = durable_key(ROBOT), []
    with (
        leaf.session("robot7") as robot,
        robot.declare_subscriber(key, lambda sample: heard.append(sample.payload.to_bytes())),
    ):
        flush(robot)
        leaf.hub.put(key, b"all", congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: heard == [b"all"], "the word of the service")


def test_a_source_cannot_write_for_another(leaf: Secured) -> None:
    with leaf.session("robot7") as robber, leaf.session("robot8") as robot:
        source = begin(robot, OTHER)
        taken = leaf.frames()
        robber.put(frame_key(OTHER), encode(source.frame(0)))
        flush(robber)
        source.put(source.frame(0))
        state = KoopClient(robot, DEADLINE).state(OTHER)
        assert (state.epoch, state.frames) == (source.epoch, 1)
        assert leaf.frames() == taken + 1
