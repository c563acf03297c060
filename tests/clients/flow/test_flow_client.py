"""`koop-sim-client --system cylinder` over real Zenoh: what is streamed is what is simulated."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zenoh

from koop_clients.flow.cylinder import CylinderFlow
from koop_clients.flow.forcing import schedule
from koop_clients.flow.plant import starting
from koop_clients.sim_client.arguments import parse_arguments
from koop_clients.sim_client.options import FlowOptions
from koop_protocol import (
    Control,
    ErrorReply,
    Frame,
    PredictQuery,
    PredictReply,
    decode,
    decode_as,
    encode,
)


@pytest.fixture(autouse=True)
def coarse(
    small: CylinderFlow, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setattr(FlowOptions, "settings", small.settings)


@pytest.fixture
def seen(hub: zenoh.Session) -> Iterator[list[Frame | Control]]:
    """What came, in order, at a service that is there and knows nothing."""
    messages: list[Any] = []

    def refuse(query: zenoh.Query) -> None:
        with query:
            query.reply_err(encode(ErrorReply("unknown_trajectory", "no frame has come")))

    direct: Any = zenoh.handlers.Callback
    declared: list[Any] = [
        hub.declare_subscriber(
            f"koop/{kind}/**",
            direct(lambda sample: messages.append(decode(bytes(sample.payload))), indirect=False),
        )
        for kind in ("frame", "control")
    ]
    declared.append(hub.declare_queryable("koop/state/**", refuse))
    yield messages
    del declared


@pytest.fixture
def warming(hub: zenoh.Session) -> Iterator[None]:
    """The service is never ready."""

    def refuse(query: zenoh.Query) -> None:
        with query:
            query.reply_err(encode(ErrorReply("warming_up", "one more frame")))

    direct: Any = zenoh.handlers.Callback
    declared = hub.declare_queryable("koop/predict/**", direct(refuse, indirect=False))
    yield
    declared.undeclare()


def of_kind(seen: list[Any], kind: type) -> list[Any]:
    return [message for message in seen if isinstance(message, kind)]


@pytest.mark.usefixtures("warming")
def test_a_free_flow_streams(
    small: CylinderFlow, seen: list[Frame | Control], command: Callable
) -> None:
    out, err = command("--system", "cylinder", "--duration", "1.2")
    frames = of_kind(seen, Frame)
    assert [(f.trajectory, f.seq, f.control_size) for f in frames] == [
        ("cylinder/0", k, 0) for k in range(8)
    ]
    assert not of_kind(seen, Control)
    assert {f.renderer for f in frames} == {"koop-lbm-1"}
    state = starting(small, (0, 0))
    for frame in frames:
        assert frame.image.dtype == np.float16
        assert np.array_equal(frame.image, small.picture(state))
        state = small.frame(state)
    assert "streamed 8 frames in" in out
    assert "streaming cylinder/0 for 1.2 s, flowing freely" in err


@pytest.mark.usefixtures("warming")
def test_rotations_are_streamed_between_the_frames(
    small: CylinderFlow, seen: list[Frame | Control], command: Callable
) -> None:
    options = ("--actuated", "--duration", "1.2", "--trajectories", "2", "--seed", "3", "--json")
    out, err = command("--system", "cylinder", *options)
    result = json.loads(out)
    assert result["frames"] == 16
    assert result["completed"]
    assert result["simulated"] == pytest.approx(7 * 0.15)
    assert "turning at random" in err
    for index in range(2):
        name, turn = f"cylinder-actuated/{index}", schedule((3, index))
        mine = [message for message in seen if message.trajectory == name]
        assert [type(m) for m in mine] == [Frame, *(7 * [Control, Frame])]
        assert [m.seq for m in mine] == [0, *(n for k in range(7) for n in (k, k + 1))]
        state = starting(small, (3, index))
        for frame, control in zip(mine[::2], [*mine[1::2], None], strict=True):
            assert frame.control_size == 1
            assert np.array_equal(frame.image, small.picture(state))
            if control is not None:
                assert control.u.tolist() == [turn(control.seq, 0.0)]
                state = small.frame(state, control.u[0])


def test_predictions_are_asked_for_and_judged(
    small: CylinderFlow, hub: zenoh.Session, seen: list[Frame | Control], command: Callable
) -> None:
    """A service that simulates the flow itself is never wrong: but for half precision."""
    asked: list[PredictQuery] = []

    def foresee(query: zenoh.Query) -> None:
        with query:
            asked.append(decode_as(PredictQuery, bytes(query.payload or b"")))
            last = of_kind(seen, Frame)[-1]
            state = starting(small, (0, 0))
            turns = [message.u[0] for message in of_kind(seen, Control)]
            for turn in turns:
                state = small.frame(state, turn)
            frames = []
            for (turn,) in asked[-1].controls:
                state = small.frame(state, turn)
                frames.append(small.picture(state))
            reply = PredictReply(last.trajectory, last.epoch, last.seq, frames=np.stack(frames))
            query.reply(query.key_expr, encode(reply))

    declared = hub.declare_queryable("koop/predict/**", foresee)
    options = ("--system", "cylinder", "--actuated", "--duration", "6")
    result = json.loads(command(*options, "--json")[0])
    assert [query.horizon for query in asked] == [10] * 4
    assert result["early"]["count"] == 3
    assert result["early"]["horizons"] == [1, 2, 5, 10]
    assert result["early"]["error"] == [0.0] * 4
    assert min(result["early"]["repeat"]) > 0.01
    assert result["predict"]["count"] == 4
    assert "RMSE per value after" in command(*options)[0]
    declared.undeclare()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("cylinder", "--drive", "pd"), "none, excite, mpc, lqr or feedback for the cylinder"),
        (("cylinder", "--target", "hang"), "the cylinder's wake is brought to the steady flow"),
        (("cylinder", "--record", "a.npz"), "--record of the cylinder keeps a drive; add --drive"),
        (("cylinder", "--drive", "mpc", "--rotation-bound", "2"), "above 0, up to 1.27"),
        (("pendulum", "--rotation-bound", "1"), "only the cylinder stands in a flow"),
        (("pendulum", "--drive", "feedback"), "--drive is feedback; expected another one"),
        (("cylinder", "--mass", "2"), "--mass is 2.0; expected nothing"),
        (("cylinder", "--strip", "a.png"), "--strip is a.png; expected nothing"),
        (("pendulum", "--reynolds", "60"), "only the cylinder stands in a flow"),
    ],
)
def test_what_makes_no_sense_is_refused(
    options: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        parse_arguments(["--system", *options])
    assert caught.value.code == 2
    lines = (line.strip(" │") for line in capsys.readouterr().err.splitlines())
    assert words in " ".join(lines)


@pytest.mark.usefixtures("warming")
def test_the_first_run_tells_that_the_flow_develops(
    seen: list[Frame | Control],
    command: Callable,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    del seen
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("empty")))
    for expected in (True, False):
        _, err = command("--system", "cylinder", "--duration", "0.3")
        assert ("the flow develops" in err) == expected
