"""What a machine with a camera uses: it puts frames, and the controls that acted between them.

Needs numpy, msgpack and eclipse-zenoh, nothing else.
"""

from __future__ import annotations

import secrets
from dataclasses import replace
from types import TracebackType

import numpy as np
import zenoh
from numpy.typing import ArrayLike

from koop_clients.connection import flush
from koop_clients.replay.file import Tail
from koop_clients.replay.log import SourceLog
from koop_protocol import Control, Frame, control_key, decode_as, encode, frame_key


class FrameSource:
    """One trajectory's stream of frames and controls to the koop service.

    A source starts a new *epoch*, so that a restarted robot is never taken for the old one, and
    numbers its frames from 0. Frame k and control k share the number: control k is what acted
    between frame k and frame k+1 (the mean, where the actuators change faster than the frames).

    Putting blocks while the service is slower than the camera; nothing is dropped on the way. It
    does *not* tell whether anybody listens: ask with :class:`koop_clients.queries.KoopClient`.
    With a log, what nobody heard is not lost: the service asks for it later.

    Attributes:
        trajectory: its name.
        epoch: of this run.

    Example::

        from koop_clients.connection import open_session
        from koop_clients.queries import KoopClient
        from koop_clients.sources import FrameSource

        with open_session() as session:
            koop = KoopClient(session)
            with FrameSource(session, "line3/robot7", control_size=1) as source:
                for image, torque in recording:  # (64, 64) uint8, and the torque until the next
                    source.put_frame(image)
                    source.put_control([torque])
            ahead = koop.predict("line3/robot7", horizon=20, returns={"frames"})
            print(ahead.frames.shape)  # (20, 64, 64): the next second, with no torque
    """

    def __init__(
        self,
        session: zenoh.Session,
        trajectory: str,
        control_size: int = 0,
        renderer: str = "",
        log: SourceLog | None = None,
        resume: bool = False,
    ) -> None:
        """Declare the two publishers, and serve the log.

        Args:
            session: an open Zenoh session, see :func:`koop_clients.connection.open_session`.
            trajectory: its name, chunks of letters, digits, "_", "." or "-" separated by "/".
            control_size: components p of a control; 0 where nothing is actuated.
            renderer: name of the simulator's renderer; "" is a real camera.
            log: keeps everything that is put until the service has it on disk.
            resume: go on in the epoch of the log's newest frame, with the next number; only for a
                system that has not moved since, such as a simulation or a file. Where the log has
                no frame of this trajectory, a new epoch begins.

        Raises:
            ProtocolError: the name is not valid.
            ValueError: `resume` without a log, or with another control size or renderer.
        """
        self._session = session
        self._log = log
        self.trajectory = trajectory
        self.epoch = secrets.token_hex(8)
        self.control_size = control_size
        self.renderer = renderer
        self._next_seq = 0
        self._last_control = -1
        self._format: tuple[tuple[int, ...], np.dtype] | None = None
        if resume:
            self._resume()
        block = zenoh.CongestionControl.BLOCK
        self._frames = session.declare_publisher(frame_key(trajectory), congestion_control=block)
        self._controls = session.declare_publisher(
            control_key(trajectory), congestion_control=block
        )
        if log is not None:
            log.attach(session, trajectory)

    @property
    def next_seq(self) -> int:
        """Number of the next frame; 0 unless an epoch goes on."""
        return self._next_seq

    @property
    def awaits_control(self) -> bool:
        """Whether the last frame's control was not put yet."""
        return self.control_size > 0 and self._last_control < self._next_seq - 1

    def put_frame(self, image: np.ndarray) -> int:
        """Put the next frame, (H, W) or (C, H, W) in uint8, float16 or float32; its number.

        Raises:
            ValueError: the image's shape or dtype is not that of the first one.
            ProtocolError: the image is of a kind that koop does not take.
        """
        found = (image.shape, image.dtype)
        if self._format is not None and found != self._format:
            raise ValueError(
                f"the image is {_describe(found)}; expected {_describe(self._format)}, like the "
                "first one; start a new FrameSource for another camera"
            )
        seq = self._next_seq
        frame = Frame(
            self.trajectory,
            self.epoch,
            seq,
            self.control_size,
            image,
            self.renderer,
            self._log is not None,
        )
        data = self._logged(frame)
        self._format, self._next_seq = found, seq + 1
        self._frames.put(data)
        return seq

    def put_control(self, u: ArrayLike) -> None:
        """Put the control (p,) that acted, or will act, between the last frame put and the next.

        Raises:
            ValueError: there is no frame yet, it has its control already, or `u` is not (p,).
            ProtocolError: `u` is not finite.
        """
        seq = self._next_seq - 1
        values = np.asarray(u, np.float64)
        if values.shape != (self.control_size,) or not self.control_size:
            raise ValueError(
                f"the control has shape {values.shape}; expected ({self.control_size},), since "
                f"this source was made with control_size={self.control_size}"
            )
        if seq <= self._last_control:
            missing = "there is no frame yet" if seq < 0 else f"frame {seq} has its control already"
            raise ValueError(f"{missing}; put a frame, then the control that follows it")
        data = self._logged(Control(self.trajectory, self.epoch, seq, values))
        self._last_control = seq
        self._controls.put(data)

    def _logged(self, message: Frame | Control) -> bytes:
        """The message's bytes, which the log has; a frame that it has not does not say so."""
        data = encode(message)
        if self._log is None or self._log.append(message, data):
            return data
        return encode(replace(message, logged=False)) if isinstance(message, Frame) else data

    def _resume(self) -> None:
        """Take up the epoch of the log's newest frame."""
        if self._log is None:
            raise ValueError("there is nothing to resume without a log; give log=SourceLog(path)")
        tail = self._log.tail(self.trajectory)
        if tail is not None:
            self._continue(tail, decode_as(Frame, tail.data))

    def _continue(self, tail: Tail, last: Frame) -> None:
        found = (last.control_size, last.renderer)
        if found != (self.control_size, self.renderer):
            raise ValueError(
                f"the log's last frame of {self.trajectory!r} has control_size {found[0]} and "
                f"renderer {found[1]!r}; expected {self.control_size} and {self.renderer!r}; "
                "start a new epoch with resume=False"
            )
        self.epoch, self._next_seq = tail.epoch, tail.seq + 1
        self._last_control = tail.seq if tail.controlled else tail.seq - 1
        self._format = (last.image.shape, last.image.dtype)

    def close(self) -> None:
        """Wait until everything put has left, and undeclare the publishers. A log goes on serving.

        Closing the session without it drops what is still on its way.
        """
        flush(self._session)
        self._frames.undeclare()
        self._controls.undeclare()

    def __enter__(self) -> FrameSource:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _describe(image_format: tuple[tuple[int, ...], np.dtype]) -> str:
    return f"{image_format[0]} {image_format[1]}"
