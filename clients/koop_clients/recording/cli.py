"""Command line of `koop-record`: the one place that wires its parts together."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
import zenoh

from koop_clients.connection import DEFAULT_ENDPOINT, NoServiceError, flush, open_session
from koop_clients.recording.inbox import Inbox, control_expression, open_hub, subscribed
from koop_clients.recording.progress import Progress
from koop_clients.sim_client.pacing import Stop
from koop_protocol import Control, Frame, ProtocolError, decode, parse_key

try:
    from koop_clients.recording.recorder import Recorder
    from koop_clients.recording.spool import Joined, Spool
except ModuleNotFoundError as error:
    sys.exit(f"koop-record needs {error.name}: pip install 'koop[record]'")

_POLL = 0.2  # s
_IRREGULAR = 0.1  # share of dt


def _unset(metavar: str, otherwise: str) -> object:
    """An option that stays None unless given."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {otherwise})")


@dataclass(frozen=True)
class Arguments:
    """Record live streams into the HDF5 file that koop-train reads.

    Frames and controls come from any Zenoh source. Each trajectory's stream is cut into segments of
    equal length without a gap; Ctrl-C ends the recording and writes the file. What a killed
    recording had is joined by --recover.
    """

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The HDF5 file to write; it must not exist."""
    key: tyro.conf.Positional[str] = "koop/frame/**"
    """Whose frames: a Zenoh key expression, such as 'koop/frame/*/cartpole/**'."""
    frames: int = 200
    """Frames of a segment."""
    trajectories: int = 0
    """Segments after which it stops; 0 goes on."""
    duration: float = 0.0
    """Time after which it stops [s]; 0 goes on."""
    system: Annotated[str | None, _unset("NAME", "first part of the first trajectory's name")] = (
        None
    )
    """Name of what is recorded."""
    dt: Annotated[float | None, _unset("SECONDS", "median time between arrivals")] = None
    """Time between two frames [s]."""
    connect: Annotated[str | None, _unset("ENDPOINT", DEFAULT_ENDPOINT)] = None
    """The service or Zenoh router that the sources are connected to."""
    listen: Annotated[str | None, _unset("ENDPOINT", "none")] = None
    """Be the hub that the sources connect to, where neither runs."""
    zenoh_config: Annotated[Path | None, _unset("FILE", "none")] = None
    """A raw Zenoh configuration (JSON5), for instance with certificates."""
    wait: float = 10.0
    """How long to wait for a service that is still starting [s]."""
    recover: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Join what a killed recording left beside --out, and record nothing."""

    def check(self) -> None:
        """Raise ValueError for values that make no sense.

        Not on construction: tyro would break the message into a box.
        """
        _require(self.frames >= 2, "frames", self.frames, "2 or more")
        _require(self.trajectories >= 0, "trajectories", self.trajectories, "0 or more")
        _require(_not_negative(self.duration), "duration", self.duration, "0 or more")
        _require(_not_negative(self.wait), "wait", self.wait, "0 or more")
        _require(self.dt is None or _positive(self.dt), "dt", self.dt, "above 0")
        control_expression(self.key)
        if self.listen and (self.connect or self.zenoh_config):
            raise ValueError("--listen makes a hub of its own; leave --connect, --zenoh-config out")


def main() -> None:
    """Entry point; exits with 2 for arguments that make no sense, with 1 for any other failure."""
    arguments = tyro.cli(Arguments, prog="koop-record")
    try:
        arguments.check()
    except ValueError as error:
        print(f"koop-record: {error}", file=sys.stderr)
        sys.exit(2)
    try:
        (recover if arguments.recover else record)(arguments)
    except (OSError, ValueError) as error:
        sys.exit(f"koop-record: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


def recover(arguments: Arguments) -> None:
    """Join what a killed recording left."""
    spool = Spool(arguments.out)
    spool.resume()
    _tell_joined(arguments, spool.join(arguments.system, arguments.dt))


def record(arguments: Arguments) -> None:
    """Record until there is enough, then join the segments into the file."""
    spool, progress = Spool(arguments.out), Progress()
    recorder = Recorder(arguments.frames, progress.say)
    stop = Stop()
    with _open(arguments) as session:
        spool.begin()
        stop.catch_signals()
        _listen(arguments, session, recorder, spool, progress, stop)
    recorder.finish()
    print(progress.summary(recorder, spool.count))
    if not spool.count:
        spool.remove()
        raise ValueError(_nothing(arguments, recorder))
    _tell_joined(arguments, spool.join(arguments.system, arguments.dt))


def _listen(
    arguments: Arguments,
    session: zenoh.Session,
    recorder: Recorder,
    spool: Spool,
    progress: Progress,
    stop: Stop,
) -> None:
    inbox, end = Inbox(), time.monotonic() + (arguments.duration or math.inf)
    with subscribed(session, arguments.key, inbox):
        flush(session)  # from here on nothing is missed
        progress.say(f"recording {arguments.key} from {_place(arguments)}; Ctrl-C ends it")
        while not stop and time.monotonic() < end:
            arrival = inbox.take(_POLL)
            progress.overflowed = inbox.overflowed
            progress.show(recorder, spool.count)
            message = None if arrival is None else _read(arrival.key, arrival.data, progress)
            if arrival is None or message is None:
                continue
            for segment in recorder.take(message, arrival.time):
                spool.add(segment, recorder.renderer)
                if spool.count == arguments.trajectories:
                    return


def _read(key: str, data: bytes, progress: Progress) -> Frame | Control | None:
    """The measurement; None, counted and explained, where it cannot be read."""
    try:
        message = decode(data)
        name = parse_key(key).trajectory
    except ProtocolError as error:
        progress.unreadable(key, str(error))
        return None
    if not isinstance(message, Frame | Control) or message.trajectory != name:
        progress.unreadable(key, "its payload is not a measurement of that trajectory")
        return None
    return message


def _open(arguments: Arguments) -> zenoh.Session:
    if arguments.listen:
        return open_hub(arguments.listen)
    connect, config_file = arguments.connect, arguments.zenoh_config
    try:
        return open_session(connect, config_file=config_file, wait=arguments.wait)
    except NoServiceError as error:
        where = " or ".join(error.endpoints) or "there"
        raise ValueError(
            f"nobody listens on {where}; start `koop-serve`, or let the sources connect to this "
            f"recording: --listen {DEFAULT_ENDPOINT}"
        ) from error


def _place(arguments: Arguments) -> str:
    return arguments.listen or arguments.connect or str(arguments.zenoh_config or DEFAULT_ENDPOINT)


def _nothing(arguments: Arguments, recorder: Recorder) -> str:
    if not recorder.frames:
        return f"no frame came on {arguments.key}; is a source connected to {_place(arguments)}?"
    return (
        f"no stream gave {arguments.frames} frames without a gap; record for longer, or give a "
        "smaller --frames"
    )


def _tell_joined(arguments: Arguments, joined: Joined) -> None:
    header = joined.header
    print(
        f"wrote {arguments.out}: {joined.count} segments of {joined.length} frames, "
        f"{header.dt:g} s apart, of {header.system!r}"
    )
    if joined.spread > _IRREGULAR:
        print(
            f"note: the time between frames differs between segments by up to "
            f"{100 * joined.spread:.0f}%; give --dt if you know it, and record sources of one rate",
            file=sys.stderr,
        )


def _require(condition: bool, option: str, value: object, expected: str) -> None:
    if not condition:
        raise ValueError(f"--{option} is {value}; expected {expected}")


def _positive(value: float) -> bool:
    return math.isfinite(value) and value > 0


def _not_negative(value: float) -> bool:
    return math.isfinite(value) and value >= 0


if __name__ == "__main__":
    main()
