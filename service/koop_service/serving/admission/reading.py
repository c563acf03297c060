"""From what came on a key to the measurement that it is."""

from __future__ import annotations

from koop_protocol import (
    Control,
    ErrorCode,
    Frame,
    KeyKind,
    Limits,
    ProtocolError,
    control_key,
    decode,
    frame_key,
    parse_key,
    replay_key,
)
from koop_service.serving.admission.arrivals import Arrival


def read(arrival: Arrival, limits: Limits) -> Frame | Control:
    """The frame or the control in it. Raises ProtocolError where it is neither, or on its key."""
    if arrival.fault is not None:
        raise arrival.fault
    message = decode(arrival.data, limits)
    if not isinstance(message, Frame | Control):
        raise ProtocolError(
            ErrorCode.malformed,
            f"a {type(message).__name__} came as a measurement",
            "a frame or a control",
        )
    _check_key(arrival, message)
    return message


def _check_key(arrival: Arrival, message: Frame | Control) -> None:
    """ProtocolError unless the message came on the key that belongs to it."""
    expected = (frame_key if isinstance(message, Frame) else control_key)(message.trajectory)
    if arrival.replayed:
        expected = replay_key(message.trajectory)
    key = arrival.key
    if key == expected:
        return
    kind = KeyKind.frame if isinstance(message, Frame) else KeyKind.control
    named = parse_key(key)
    raise ProtocolError(
        ErrorCode.bad_key,
        f"a {kind} of {message.trajectory!r} came on the key of a {named.kind} of "
        f"{named.trajectory!r}",
        f"the key {expected}",
        "build keys with the functions of koop_protocol.keys",
    )
