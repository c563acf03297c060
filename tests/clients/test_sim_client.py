"""`koop-sim-client` end to end over real Zenoh, against a service that cannot be wrong."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import zenoh

from koop_clients.connection import open_session
from koop_clients.mechanics.systems import build_system
from koop_clients.sim_client import cli
from koop_clients.sim_client.arguments import Arguments, parse_arguments
from koop_clients.sim_client.options import DriveOptions
from koop_clients.sim_client.record import Record
from koop_clients.sim_client.streaming import open_streams
from koop_clients.sources import FrameSource
from koop_protocol import ErrorReply, PredictReply, encode


@pytest.mark.parametrize(
    "options",
    [
        ("--system", "cartpole"),
        ("--system", "cartpole", "--actuated"),
        ("--system", "double-pendulum", "--drive", "excite", "--seed", "3", "--length-2", "0.3"),
    ],
)
def test_right_predictions_have_no_error(
    options: tuple[str, ...], knowing: Callable, command: Callable
) -> None:
    service = knowing(*options)
    out, _ = command(*options, "--duration", "4", "--json", "--ask-every", "0.2")
    result = json.loads(out)
    assert result["frames"] == 80
    assert result["completed"]
    assert result["early"]["horizons"] == [1, 2, 5, 10, 20]
    # The state is folded from mean torques, which may round a grey level the other way.
    assert max(result["early"]["error"]) < 1e-4
    assert min(result["early"]["repeat"]) > 0.001
    assert [frame.seq for frame in service.frames] == list(range(80))
    actuated = len(options) > 2
    assert [control.seq for control in service.controls] == list(range(80) if actuated else [])
    assert {frame.control_size for frame in service.frames} == {int(actuated)}
    assert {frame.renderer for frame in service.frames} == {"koop-sdf-1"}


def test_a_good_plan_reaches_the_target(
    knowing: Callable, command: Callable, tmp_path: Path
) -> None:
    options = ("--system", "cartpole", "--drive", "lqr", "--learn", "5", "--duration", "10")
    service = knowing(*options)
    strip, record = tmp_path / "new" / "strip.png", tmp_path / "run.npz"
    out, err = command(*options, "--strip", str(strip), "--record", str(record))
    assert "drive: reached and held the target" in out
    assert "to target" in err
    frames = service.frames
    assert [frame.seq for frame in frames] == list(range(200))
    assert [control.seq for control in service.controls] == list(range(200))
    saved = Record.load(record)
    assert len(saved.drive_frames) == 100
    assert np.array_equal(saved.drive_frames[0], frames[100].image)
    assert abs(saved.drive_angles[0]) > 0.5
    assert np.abs(saved.drive_torques).max() <= 20.0
    assert saved.drive_torques[3] == service.controls[103].u[0]
    assert max(j.error.max() for j in saved.early) < 1e-4
    assert all(j.forecast.seq + 20 <= 50 for j in [*saved.early, *saved.late])
    assert matplotlib.image.imread(strip).shape[1] == 2000


def test_several_plants_stream_at_once(hub: zenoh.Session, command: Callable) -> None:
    asked: list[str] = []

    def refuse(query: zenoh.Query) -> None:
        with query:
            asked.append(str(query.key_expr))
            query.reply_err(encode(ErrorReply("warming_up", "warming up")))

    declared = [hub.declare_queryable(f"koop/{kind}/**", refuse) for kind in ("predict", "state")]
    out, err = command(
        "--system", "pendulum", "--trajectories", "3", "--first", "7", "--duration", "1"
    )
    assert "streamed 60 frames of 3 plants" in out
    assert "no prediction could be compared" in out
    assert "streaming pendulum/7 to 9 for 1 s, swinging freely" in err
    assert {key.rsplit("/")[-1] for key in asked if "predict" in key} == {"7", "8", "9"}
    del declared


@pytest.mark.parametrize("code", ["no_model", "wrong_shape"])
def test_a_lasting_refusal_ends_the_run(hub: zenoh.Session, command: Callable, code: str) -> None:
    def refuse(query: zenoh.Query) -> None:
        with query:
            query.reply_err(encode(ErrorReply(code, "no model for pendulum/0; train one with X")))

    declared = [hub.declare_queryable(f"koop/{kind}/**", refuse) for kind in ("predict", "state")]
    with pytest.raises(SystemExit) as caught:
        command("--system", "pendulum")
    assert caught.value.code == "koop-sim-client: no model for pendulum/0; train one with X"
    del declared


def test_another_source_of_the_same_name_ends_the_run(
    hub: zenoh.Session, command: Callable
) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            reply = PredictReply("pendulum/0", "f" * 16, 3, frames=np.zeros((20, 64, 64), np.uint8))
            query.reply("koop/predict/pendulum/0", encode(reply))

    def refuse(query: zenoh.Query) -> None:
        with query:
            query.reply_err(encode(ErrorReply("unknown_trajectory", "no frame has come")))

    declared = [
        hub.declare_queryable("koop/predict/**", answer),
        hub.declare_queryable("koop/state/**", refuse),
    ]
    with pytest.raises(SystemExit, match="another source streams as pendulum/0"):
        command("--system", "pendulum", "--wait", "0.5")
    del declared


def test_without_a_service_it_says_how_to_start_one(
    monkeypatch: pytest.MonkeyPatch, signals: None
) -> None:
    del signals
    options = ["--system", "cartpole", "--connect", "tcp/127.0.0.1:1", "--wait", "0"]
    monkeypatch.setattr(sys, "argv", ["koop-sim-client", *options])
    with pytest.raises(SystemExit, match="start one with `koop-serve`"):
        cli.main()


def test_a_router_without_a_service_is_told_apart(command: Callable) -> None:
    with pytest.raises(SystemExit, match="nobody answered on koop/state/cartpole/0"):
        command("--system", "cartpole", "--wait", "0.3")


def test_ctrl_c_ends_with_a_summary(knowing: Callable, endpoint: str) -> None:
    knowing("--system", "cartpole")
    code = "from koop_clients.sim_client.cli import main; main()"
    options = ["--system", "cartpole", "--connect", endpoint, "--duration", "0", "--json"]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stderr is not None
    for line in process.stderr:
        if "warming up" in line:
            break
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=10)
    result = json.loads(out)
    assert process.returncode == 0
    assert result["frames"] > 0
    assert not result["completed"]
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--system", "triple"], "--system"),
        ([], "--system"),
        (["--system", "cartpole", "--rate", "fast"], "--rate is fast; expected realtime, max"),
        (["--system", "cartpole", "--rate", "-2"], "--rate is -2; expected realtime, max"),
        (["--system", "cartpole", "--trajectories", "0"], "--trajectories is 0; expected at least"),
        (["--system", "cartpole", "--target", "up"], "--target is up; expected upright, hang"),
        (["--system", "cartpole", "--r", "0"], "--r is 0.0; expected above 0"),
        (
            ["--system", "cartpole", "--torque-bound", "nan"],
            "--torque-bound is nan; expected above",
        ),
        (["--system", "cartpole", "--duration", "-1"], "--duration is -1.0; expected 0 or more"),
        (["--system", "cartpole", "--ahead", "0"], "--ahead is 0; expected at least 1"),
        (["--system", "cartpole", "--mass", "-1"], "mass is -1.0; expected a positive"),
        (["--system", "pendulum", "--cart-mass", "1"], "pendulum has no parameter 'cart_mass'"),
        (["--system", "cartpole", "--drive", "lqr", "--learn", "40"], "nothing is left for lqr"),
        (
            ["--system", "cartpole", "--target", "no.png"],
            "--target is no.png, and there is",
        ),
        (["--system", "cartpole", "--start", "nan"], "--start is nan; expected an angle"),
        (["--system", "cartpole", "--starts", "1", "-1"], "--starts is 1.0 -1.0; expected two"),
        (["--system", "cartpole", "--start", "1", "--starts", "0", "1"], "exclude each other"),
        (["--system", "cartpole", "--qf", "big"], "--qf is big; expected none, riccati, or a"),
        (["--system", "cartpole", "--kick", "inf"], "--kick is inf; expected a number of N m s"),
        (["--system", "cartpole", "--noise", "-1"], "--noise is -1.0; expected 0 or more"),
        (["--system", "cartpole", "--delay", "2"], "--delay is 2.0; expected 0 to 1 s"),
        (["--system", "cartpole", "--change-mass", "0"], "--change-mass is 0.0; expected above 0"),
    ],
)
def test_nonsense_is_refused_before_anything_starts(
    options: list[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["koop-sim-client", *options])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    assert caught.value.code == 2
    captured = capsys.readouterr()
    # Boxes and line breaks are the terminal's business.
    text = " ".join((captured.out + captured.err).replace("│", " ").split())
    assert words in text


def test_the_options_mean_what_they_say() -> None:
    drive = ["--drive", "lqr", "--target", "hang"]
    rest = ["--rate", "2.5", "--mass", "0.7", "--ahead", "7"]
    arguments = parse_arguments(["--system", "cartpole", *drive, *rest])
    assert arguments.is_actuated
    assert arguments.driving.angle == pytest.approx(np.pi)
    assert arguments.driving.start_angle(np.pi, 0.5) == pytest.approx(np.pi + 1)
    assert (arguments.drives, arguments.method, arguments.takeover) == (True, "gain", 200)
    assert arguments.speed == 2.5
    assert arguments.physical.given == {"mass": 0.7}
    assert arguments.horizons == (1, 2, 5)
    assert not Arguments("cartpole").is_actuated
    assert parse_arguments(["--system", "cartpole", "--drive", "mpc"]).method == "qp"
    known = parse_arguments(["--system", "cartpole", "--drive", "state-lqr"])
    assert (known.drives, known.is_actuated, known.method) == (True, True, None)
    spread = DriveOptions(starts=(-1.0, 3.0))
    assert [spread.start_angle(0.0, share) for share in (0.0, 0.5)] == [-1.0, 1.0]
    assert DriveOptions(start=0.2).start_angle(0.0, 0.9) == 0.2


def test_seed_and_number_decide_about_a_plant(endpoint: str) -> None:
    with open_session(endpoint) as session:

        def plants(seed: int, first: int) -> list[tuple[float, float]]:
            options = f"--system cartpole --drive pd --trajectories 3 --seed {seed} --first {first}"
            arguments = parse_arguments([*options.split(), "--starts", "-1", "1"])
            streams = open_streams(arguments, build_system("cartpole"), 0.0, session)
            assert all(-1 <= stream.start <= 1 for stream in streams)
            return [(stream.plant.angle, stream.start) for stream in streams]

        assert plants(1, 0) == plants(1, 0)
        assert plants(1, 0)[2] == plants(1, 2)[0]
        angles, starts = zip(*plants(1, 0), *plants(2, 0), strict=True)
        assert len(set(angles)) == len(set(starts)) == 6


def test_sources_are_numbered_from_the_first(endpoint: str) -> None:
    with open_session(endpoint) as session:
        arguments = parse_arguments(["--system", "cartpole", "--trajectories", "2", "--first", "5"])
        streams = open_streams(arguments, build_system("cartpole"), 0.0, session)
        assert [s.source.trajectory for s in streams] == ["cartpole/5", "cartpole/6"]
        assert all(isinstance(s.source, FrameSource) for s in streams)
