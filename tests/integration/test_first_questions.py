"""When a service that starts may ask sources' logs: not before it hears what they put meanwhile."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path

import zenoh
from integration.loopback import client, config_for, wait_until

from koop_protocol import SOURCE_TOKENS, control_key, frame_key, replay_key, source_token
from koop_service.assembly import running
from koop_service.serving.session import locators, open_session

SOURCES = 100


class Source:
    """A source with a log; it notes for each question whether somebody hears its puts."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        keys = (frame_key(name), control_key(name))
        self.heard: list[bool] = []
        self._publishers = [session.declare_publisher(key) for key in keys]
        callback = zenoh.handlers.Callback(self._asked, indirect=False)
        self._log = session.declare_queryable(replay_key(name), callback)
        self._token = session.liveliness().declare_token(source_token(name))

    def _asked(self, query: zenoh.Query) -> None:
        self.heard.append(all(p.matching_status.matching for p in self._publishers))
        query.drop()


def test_a_log_is_asked_when_what_its_source_puts_is_heard(tmp_path: Path, model: Path) -> None:
    """What is put after the answer would come neither with it nor live."""
    config = config_for(tmp_path, model)
    with ExitStack() as stack:
        hub = stack.enter_context(open_session(config.network))
        session = stack.enter_context(client(locators(hub)[0]))
        sources = [Source(session, f"cart/{number}") for number in range(SOURCES)]
        wait_until(partial(_knows, hub, SOURCES))
        stack.enter_context(running(config, hub))
        wait_until(lambda: all(source.heard for source in sources))
        assert all(source.heard[0] for source in sources)


def _knows(hub: zenoh.Session, count: int) -> bool:
    return len(list(hub.liveliness().get(SOURCE_TOKENS, timeout=10.0))) == count
