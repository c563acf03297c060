"""Command line of `koop-sim-client`: the one place that wires its parts together."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial

import zenoh

from koop_clients.connection import NoServiceError, flush, open_session
from koop_clients.flow.cylinder import DivergedError
from koop_clients.flow.settings import FlowSettings
from koop_clients.mechanics.systems import System, build_system
from koop_clients.queries import NO_REPLY, KoopClient, KoopError
from koop_clients.replay.log import SourceLog
from koop_clients.sim_client.arguments import Arguments, parse_arguments
from koop_clients.sim_client.display import Display
from koop_clients.sim_client.driving.target import Target, read_target
from koop_clients.sim_client.flowing.result import FlowResult
from koop_clients.sim_client.flowing.run import FlowRun
from koop_clients.sim_client.live import LiveRun
from koop_clients.sim_client.pacing import Stop
from koop_clients.sim_client.report import Result

_POLL = 0.1  # s


def main() -> None:
    """Entry point.

    Exits with 2 for arguments that make no sense, and with 1 where the service cannot be reached,
    cannot serve the system, answers nothing, or finds its model not fit to drive any of the plants.
    """
    try:
        begin = _prepared(parse_arguments())
    except ValueError as error:
        print(f"koop-sim-client: {error}", file=sys.stderr)
        sys.exit(2)
    try:
        begin()
    except (KoopError, OSError, ValueError, DivergedError) as error:
        sys.exit(f"koop-sim-client: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


def _prepared(arguments: Arguments) -> Callable[[], None]:
    """The run that the arguments ask for; ValueError where they make no sense."""
    if arguments.is_flow:
        return partial(run_flow, arguments, arguments.flow.settings)
    system = build_system(arguments.system, arguments.physical.given)
    return partial(run, arguments, system, read_target(arguments.driving, system))


def run_flow(arguments: Arguments, settings: FlowSettings) -> None:
    """Stream flows and drive their wakes; then say what was found, and save what was asked for."""
    display = Display()
    with _connect(arguments, display) as session, _log(arguments) as log:
        stop = Stop()
        stop.catch_signals()
        live = FlowRun(arguments, settings, session, display, log)
        live.run(stop)
        flush(session)
    if arguments.output.record is not None:
        arguments.output.record.parent.mkdir(parents=True, exist_ok=True)
        live.record().save(arguments.output.record)
        display.say(f"saved {arguments.output.record}")
    _report(live.result(), live.silence, arguments)


def run(arguments: Arguments, system: System, target: Target) -> None:
    """Stream, ask, drive; then say what was found, and save what was asked for."""
    display = Display()
    with _connect(arguments, display) as session, _log(arguments) as log:
        stop = Stop()
        stop.catch_signals()
        live = LiveRun(arguments, system, target, session, display, log)
        _tell_target(arguments, target, display)
        live.run(stop)
        flush(session)
    _save(live, arguments, display)
    _report(live.result(), live.silence, arguments)


def _report(result: Result | FlowResult, silence: str, arguments: Arguments) -> None:
    """Print what was found; SystemExit where the service did not do what it was asked for."""
    print(result.to_json() if arguments.output.json else "\n" + result.to_text())
    if result.refusal:
        sys.exit(f"koop-sim-client: the service did not drive: {result.refusal}")
    if silence and not arguments.drives:
        sys.exit(f"koop-sim-client: no prediction was answered: {silence}")


def _connect(arguments: Arguments, display: Display) -> zenoh.Session:
    """A session, once the service is there: frames put earlier would be lost."""
    connect, config_file = arguments.service.connect, arguments.service.zenoh_config
    wait = arguments.service.wait
    try:
        session = open_session(connect, config_file=config_file)
    except NoServiceError as error:
        if wait == 0:
            raise
        display.say(f"{error}; waiting {wait:g} s for it")
        session = open_session(connect, config_file=config_file, wait=wait)
    try:
        _await_answer(KoopClient(session), arguments.trajectory(0), wait)
    except BaseException:
        session.close()
        raise
    display.say(f"connected to {arguments.service.endpoint}; {_plan(arguments)}")
    return session


def _log(arguments: Arguments) -> AbstractContextManager[SourceLog | None]:
    path = arguments.service.log
    return nullcontext() if path is None else SourceLog(path)


def _await_answer(client: KoopClient, trajectory: str, wait: float) -> None:
    """Until the service answers anything at all about the trajectory, for at most `wait` [s]."""
    deadline = time.monotonic() + wait
    while True:
        try:
            client.state(trajectory)
        except KoopError as error:
            if error.code != NO_REPLY:
                return
            if time.monotonic() >= deadline:
                raise
            time.sleep(_POLL)
        else:
            return


def _tell_target(arguments: Arguments, target: Target, display: Display) -> None:
    if arguments.drives and arguments.driving.is_picture:
        display.say(
            f"the target's picture is most like a pole at {target.angle:+.2f} rad "
            f"(RMSE per pixel {target.mismatch:.3f})"
        )


def _plan(arguments: Arguments) -> str:
    """What is going to happen, in words."""
    count = arguments.trajectories
    last = f" to {arguments.first + count - 1}" if count > 1 else ""
    names = arguments.trajectory(0) + last
    until = f"for {arguments.duration:g} s" if arguments.duration else "until Ctrl-C"
    what = "flowing freely" if arguments.is_flow else "swinging freely"
    if arguments.is_actuated:
        what = "turning at random" if arguments.is_flow else "tracking random references"
    if arguments.drives:
        driver = "the service" if arguments.method else f"{arguments.drive} from the true state"
        what += f", and driven by {driver} after {arguments.driving.learn:g} s"
    return f"streaming {names} {until}, {what}"


def _save(live: LiveRun, arguments: Arguments, display: Display) -> None:
    for path in filter(None, (arguments.output.record, arguments.output.strip)):
        path.parent.mkdir(parents=True, exist_ok=True)
    if arguments.output.record is not None:
        live.record().save(arguments.output.record)
        display.say(f"saved {arguments.output.record}")
    if arguments.output.strip is not None:
        from koop_clients.pictures.strip import draw_strip  # matplotlib takes its time to load

        draw_strip(live.record(), arguments.output.strip)
        display.say(f"saved {arguments.output.strip}")


if __name__ == "__main__":
    main()
