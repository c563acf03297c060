"""What the service tells about a trajectory, and how it refuses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field
from typing import cast

from koop_protocol import checks
from koop_protocol.errors import ErrorCode, ProtocolError
from koop_protocol.keys import check_trajectory
from koop_protocol.limits import (
    DEFAULT_LIMITS,
    MAX_ENTRIES,
    MAX_SEQUENCE,
    MAX_TEXT_BYTES,
    Limits,
)

_CODES = {code.value: code for code in ErrorCode}


@dataclass(frozen=True)
class StateReply:
    """Where a trajectory's estimator stands.

    Attributes:
        trajectory: its name.
        epoch: the source's run.
        next_seq: the next frame expected.
        model: name of the encoder's weights.
        code_size: size n of a code.
        history: codes h in a regressor.
        control_size: size p of a control.
        frames: frames folded in this epoch.
        updates: transitions learned from in this epoch.
        warmup_frames: frames needed before the first prediction.
        ready: whether predictions are answered.
        residual_rms: root mean square of the one-step innovation, in the codes' unit; 0 before
            the first.
        spectral_radius: largest modulus of the companion matrix's eigenvalues; 0 before ready.
        excitation: how much the data have taught in the least excited direction, relative to the
            regularisation; 0 before ready.
        counters: events by name, such as gaps, duplicates, late frames.
    """

    trajectory: str
    epoch: str
    next_seq: int
    model: str
    code_size: int
    history: int
    control_size: int
    frames: int
    updates: int
    warmup_frames: int
    ready: bool
    residual_rms: float
    spectral_radius: float
    excitation: float
    counters: dict[str, int]
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        put = object.__setattr__
        check_trajectory(self.trajectory, limits.max_name_length)
        checks.epoch("epoch", self.epoch)
        checks.text("model", self.model, limits.max_name_length)
        for name in ("next_seq", "frames", "updates", "warmup_frames"):
            put(self, name, checks.sequence(name, getattr(self, name)))
        put(self, "code_size", checks.integer("code_size", self.code_size, 1, limits.max_code_size))
        put(self, "history", checks.integer("history", self.history, 1, limits.max_horizon))
        size = checks.integer("control_size", self.control_size, 0, limits.max_control_size)
        put(self, "control_size", size)
        checks.flag("ready", self.ready)
        for name in ("residual_rms", "spectral_radius", "excitation"):
            put(self, name, checks.real(name, getattr(self, name), 0.0))
        put(self, "counters", _check_counters(self.counters, limits))


@dataclass(frozen=True)
class ErrorReply:
    """A refusal, sent as the payload of Zenoh's ``reply_err``.

    Attributes:
        code: an ErrorCode, or a plain string where a newer peer sent one unknown here.
        message: what was wrong, what was expected and what to do, for a person.
        details: values for a program, such as ``frames`` and ``warmup_frames`` of warming_up.
    """

    code: str
    message: str
    details: dict[str, str | int | float] = field(default_factory=dict[str, str | int | float])
    limits: InitVar[Limits] = field(default=DEFAULT_LIMITS, kw_only=True)

    def __post_init__(self, limits: Limits) -> None:
        code = checks.text("code", self.code, limits.max_name_length)
        object.__setattr__(self, "code", _CODES.get(code, code))
        checks.text("message", self.message, MAX_TEXT_BYTES)
        object.__setattr__(self, "details", _check_details(self.details, limits))

    @classmethod
    def from_error(cls, error: ProtocolError) -> ErrorReply:
        """The refusal that tells a caller about ``error``, its text cut to what a message holds."""
        sentence = str(error).encode("utf-8", "replace")[:MAX_TEXT_BYTES]
        return cls(error.code, sentence.decode("utf-8", "ignore"), error.details)

    def to_error(self) -> ProtocolError:
        """The error that the refusal stands for, to be raised at the caller's end."""
        return ProtocolError(self.code, self.message, details=self.details)


def _check_counters(value: object, limits: Limits) -> dict[str, int]:
    entries = _entries("counters", value, limits)
    return {
        name: checks.integer(f"counters.{name}", count, 0, MAX_SEQUENCE)
        for name, count in entries.items()
    }


def _check_details(value: object, limits: Limits) -> dict[str, str | int | float]:
    entries = _entries("details", value, limits)
    return {name: _check_detail(f"details.{name}", entry) for name, entry in entries.items()}


def _check_detail(field: str, value: object) -> str | int | float:
    if isinstance(value, str):
        return checks.text(field, value, MAX_TEXT_BYTES)
    if isinstance(value, int):
        return checks.integer(field, value, -MAX_SEQUENCE, MAX_SEQUENCE)
    return checks.real(field, value)


def _entries(field: str, value: object, limits: Limits) -> dict[str, object]:
    if not isinstance(value, Mapping):
        raise checks.fault(
            ErrorCode.wrong_type, field, f"is of type {type(value).__name__}", "a map"
        )
    entries = dict(cast("Mapping[object, object]", value))
    if len(entries) > MAX_ENTRIES:
        raise checks.fault(
            ErrorCode.too_large, field, f"has {len(entries)} entries", f"at most {MAX_ENTRIES}"
        )
    for name in entries:
        checks.text(f"a name in {field}", name, limits.max_name_length)
    return cast("dict[str, object]", entries)
