"""The one error of the protocol.

    ValueError
    └── ProtocolError      everything wrong with a key, a message or its bytes

A caller distinguishes cases by :class:`ErrorCode`, never by the text.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum


class ErrorCode(StrEnum):
    """What was wrong, as it travels in an ``error`` message. The meanings stand in docs/wire.md."""

    malformed = "malformed"
    unsupported_version = "unsupported_version"
    too_large = "too_large"
    wrong_type = "wrong_type"
    wrong_shape = "wrong_shape"
    wrong_dtype = "wrong_dtype"
    not_finite = "not_finite"
    bad_key = "bad_key"
    unknown_trajectory = "unknown_trajectory"
    warming_up = "warming_up"
    no_model = "no_model"
    bad_horizon = "bad_horizon"
    bad_weights = "bad_weights"
    bad_bounds = "bad_bounds"
    bad_target = "bad_target"
    bad_controls = "bad_controls"
    task_taken = "task_taken"
    no_task = "no_task"
    no_owner = "no_owner"
    stale_epoch = "stale_epoch"
    stale_sequence = "stale_sequence"
    overloaded = "overloaded"
    internal = "internal"


class ProtocolError(ValueError):
    """A key, message or query that breaks the contract, with its reason in parts.

    Attributes:
        code: an :class:`ErrorCode` (or, from a newer peer, a code unknown to this version).
        problem: what was wrong.
        expected: what would have been right ("" where there is nothing to add).
        remedy: what the caller can do about it ("" where there is nothing to add).
        details: machine-readable values, such as the field's name or the limit broken.
    """

    def __init__(
        self,
        code: str,
        problem: str,
        expected: str = "",
        remedy: str = "",
        details: Mapping[str, str | int | float] | None = None,
    ) -> None:
        # All arguments go to the base class, so that the error survives pickling.
        super().__init__(code, problem, expected, remedy, details)
        self.code = code
        self.problem = problem
        self.expected = expected
        self.remedy = remedy
        self.details: dict[str, str | int | float] = dict(details or {})

    def __str__(self) -> str:
        expected = f"expected {self.expected}" if self.expected else ""
        return "; ".join(part for part in (self.problem, expected, self.remedy) if part)
