"""What each certificate may do behind the shipped access rules: everything that it needs."""

from __future__ import annotations

from pathlib import Path

import pytest
from integration.loopback import DEADLINE, RENDERER, picture, wait_until
from integration.secured import (
    FRAMES,
    OTHER,
    QUERY,
    ROBOT,
    Secured,
    asking,
    overhearing,
    stream,
)

from koop_clients.connection import open_session
from koop_clients.control import Controller
from koop_clients.replay.log import SourceLog
from koop_clients.sources import FrameSource
from koop_protocol import (
    state_key,
)
from koop_service.serving.config import NetworkSettings
from koop_service.serving.session import locators
from koop_service.serving.session import open_session as open_hub

pytestmark = pytest.mark.usefixtures("streamed")


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


def test_a_viewer_hears_what_becomes_of_a_trajectory_and_of_the_service(guarded: Secured) -> None:
    key = state_key(ROBOT)
    with guarded.session("wall") as session, overhearing(session, key) as witness:
        guarded.hub.put(key, b"over")
        wait_until(lambda: witness.keys == [key], "the word of the service")
        (health,) = asking(session).health()
        assert health.trajectories >= 2


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


def test_the_log_of_a_source_is_read_and_need_not_be_kept(guarded: Secured, tmp_path: Path) -> None:
    """Frames that no service heard come out of the log; what is safe on disk is let go."""
    plain = NetworkSettings(listen=("tcp/127.0.0.1:0",))
    with open_hub(plain) as alone, SourceLog(tmp_path / "robot7.log") as log:
        session = open_session(locators(alone)[0])
        with session, FrameSource(session, ROBOT, renderer=RENDERER, log=log) as source:
            for seq in range(FRAMES):
                source.put_frame(picture(0, seq))
    with SourceLog(tmp_path / "robot7.log") as log, guarded.session("robot7") as session:
        held = log.bytes
        log.serve(session)
        wait_until(lambda: asking(session).state(ROBOT).epoch == source.epoch, "a replay")
        wait_until(lambda: asking(session).state(ROBOT).frames == FRAMES, "all of it")
        # The newest frames stay: the service would need them for its history.
        wait_until(lambda: log.bytes < held / 2, "the word that it is on disk")
