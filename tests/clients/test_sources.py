"""A source on real Zenoh: what it puts, in which order, and what it refuses to put."""

from __future__ import annotations

import inspect
import textwrap
import threading
import time
from functools import partial

import numpy as np
import pytest
import zenoh

from koop_clients import connection, sources
from koop_clients.connection import NoServiceError, open_session
from koop_clients.sources import FrameSource
from koop_protocol import Control, Frame, Message, PredictReply, ProtocolError, decode, encode

IMAGE = np.arange(64 * 64, dtype=np.uint8).reshape(64, 64)


class Listener:
    """What arrives under koop/, in order."""

    def __init__(self, hub: zenoh.Session, delay: float = 0.0) -> None:
        self.keys: list[str] = []
        self.messages: list[Message] = []
        self._delay = delay
        self._changed = threading.Condition()
        self._declared = hub.declare_subscriber("koop/**", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        time.sleep(self._delay)
        with self._changed:
            self.keys.append(str(sample.key_expr))
            self.messages.append(decode(bytes(sample.payload)))
            self._changed.notify()

    def wait(self, count: int) -> list[Message]:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.messages) >= count, 10)
            return self.messages


@pytest.fixture
def session(endpoint: str):
    with open_session(endpoint) as opened:
        yield opened


def test_frames_and_controls_share_their_number(hub, session: zenoh.Session) -> None:
    listener = Listener(hub)
    source = FrameSource(session, "line3/robot7", control_size=2, renderer="r")
    assert [source.put_frame(IMAGE), source.put_frame(IMAGE[::-1])] == [0, 1]
    source.put_control([1.0, -2.0])
    first, second, control = listener.wait(3)
    assert isinstance(first, Frame)
    assert isinstance(second, Frame)
    assert isinstance(control, Control)
    assert (first.trajectory, first.seq, first.control_size, first.renderer) == (
        "line3/robot7",
        0,
        2,
        "r",
    )
    assert np.array_equal(second.image, IMAGE[::-1])
    assert (control.seq, control.u.tolist()) == (1, [1.0, -2.0])
    assert first.epoch == second.epoch == control.epoch == source.epoch
    assert listener.keys == [
        f"koop/{kind}/26/line3/robot7" for kind in ("frame", "frame", "control")
    ]


def test_every_source_is_an_epoch_of_its_own(session: zenoh.Session) -> None:
    assert len({FrameSource(session, "a").epoch for _ in range(20)}) == 20


def test_nothing_is_lost_towards_a_slow_reader_nor_at_the_end(hub, endpoint: str) -> None:
    listener = Listener(hub, delay=0.0005)
    with open_session(endpoint) as session, FrameSource(session, "a/b") as source:
        for _ in range(1500):
            source.put_frame(IMAGE)
    numbers = [m.seq for m in listener.wait(1500) if isinstance(m, Frame)]
    assert numbers == list(range(1500))


@pytest.mark.parametrize("image", [IMAGE[:32], IMAGE.astype(np.float32), IMAGE[None]])
def test_the_image_s_format_may_not_change(session: zenoh.Session, image: np.ndarray) -> None:
    source = FrameSource(session, "a")
    source.put_frame(IMAGE)
    with pytest.raises(ValueError, match=r"expected \(64, 64\) uint8, like the first one"):
        source.put_frame(image)
    assert source.put_frame(IMAGE) == 1


def test_a_refused_image_takes_no_number(session: zenoh.Session) -> None:
    source = FrameSource(session, "a")
    with pytest.raises(ProtocolError):
        source.put_frame(IMAGE.astype(np.int64))
    assert source.put_frame(IMAGE) == 0


def test_controls_follow_their_frame_once(session: zenoh.Session) -> None:
    source = FrameSource(session, "a", control_size=1)
    with pytest.raises(ValueError, match="there is no frame yet"):
        source.put_control([0.0])
    source.put_frame(IMAGE)
    with pytest.raises(ProtocolError):
        source.put_control([np.nan])
    source.put_control([0.0])
    with pytest.raises(ValueError, match="frame 0 has its control already"):
        source.put_control([0.0])


@pytest.mark.parametrize(("size", "u"), [(0, []), (0, [1.0]), (2, [1.0]), (1, 1.0)])
def test_a_control_has_the_announced_size(session: zenoh.Session, size: int, u: object) -> None:
    source = FrameSource(session, "a", control_size=size)
    source.put_frame(IMAGE)
    with pytest.raises(ValueError, match=rf"expected \({size},\)"):
        source.put_control(u)  # pyright: ignore[reportArgumentType]


def test_a_bad_name_is_refused(session: zenoh.Session) -> None:
    with pytest.raises(ProtocolError, match="does not name a trajectory"):
        FrameSource(session, "a b")


def test_a_closed_source_puts_nothing(session: zenoh.Session) -> None:
    with FrameSource(session, "a") as source:
        source.put_frame(IMAGE)
    with pytest.raises(zenoh.ZError):
        source.put_frame(IMAGE)


def test_the_docstring_s_example_works(
    hub, endpoint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    listener = Listener(hub)

    def answer(query: zenoh.Query) -> None:
        with query:
            frames = np.zeros((20, 64, 64), np.uint8)
            reply = PredictReply("line3/robot7", "0" * 16, 1, frames=frames)
            query.reply(query.key_expr, encode(reply))

    queryable = hub.declare_queryable("koop/predict/**", answer)
    monkeypatch.setattr(connection, "open_session", partial(open_session, endpoint))
    example = (inspect.getdoc(sources.FrameSource) or "").split("Example::")[1]
    exec(textwrap.dedent(example), {"recording": [(IMAGE, 1.5), (IMAGE, -1.5)]})
    assert "(20, 64, 64)" in capsys.readouterr().out
    assert [type(m) for m in listener.wait(4)] == [Frame, Control, Frame, Control]
    queryable.undeclare()


def test_nobody_there_is_said_clearly() -> None:
    with pytest.raises(NoServiceError) as caught:
        open_session("tcp/127.0.0.1:1")
    assert str(caught.value) == ("no koop service at tcp/127.0.0.1:1; start one with `koop-serve`")


def test_waiting_for_a_service_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    naps: list[float] = []
    monkeypatch.setattr(connection.time, "sleep", naps.append)
    monkeypatch.setattr(connection.time, "monotonic", lambda: sum(naps))
    with pytest.raises(NoServiceError):
        open_session("tcp/127.0.0.1:1", wait=1.0)
    assert 1.0 <= sum(naps) < 1.5


def test_an_endpoint_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="'nowhere' is not a Zenoh endpoint; expected one like"):
        open_session("nowhere")


def test_a_configuration_file_decides(hub, endpoint: str, tmp_path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(
        f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, '
        "scouting: {multicast: {enabled: false}}}"
    )
    with open_session(config_file=path) as session:
        assert str(hub.zid()) in [str(zid) for zid in session.info.routers_zid()]


@pytest.mark.parametrize(("text", "words"), [(None, "there is no Zenoh"), ("{", "is not a Zenoh")])
def test_a_bad_configuration_file_is_refused(tmp_path, text: str | None, words: str) -> None:
    path = tmp_path / "zenoh.json5"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=words):
        open_session(config_file=path)
