"""How large a message and its parts may be."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

MAX_NAME_LENGTH = 200
"""Longest trajectory name any peer accepts [bytes]; Limits can only tighten it."""

MAX_SEQUENCE = 2**53 - 1
"""Largest sequence number: the integers up to here are exact in every language's double."""

MAX_TEXT_BYTES = 4096
"""Longest free text (an error's message, a solver's status) [bytes of UTF-8]."""

MAX_ENTRIES = 64
"""Most entries of a map (counters, details) or of a msgpack array."""

REPLAY_ROOM = 65_536
"""By how much a replay_reply may be longer than a message alone [bytes]."""


@dataclass(frozen=True)
class Limits:
    """What a receiver is willing to take; a message beyond them is refused before allocation.

    Attributes:
        max_message_bytes: size of one encoded message [bytes].
        max_image_values: values of one image, channels included.
        max_code_size: size n of a code.
        max_control_size: size p of a control.
        max_horizon: steps of a prediction or of a control sequence.
        max_name_length: length of a trajectory's, renderer's or model's name [bytes].
    """

    max_message_bytes: int = 4 * 1024 * 1024
    max_image_values: int = 1 << 20
    max_code_size: int = 256
    max_control_size: int = 64
    max_horizon: int = 1000
    max_name_length: int = MAX_NAME_LENGTH

    def for_replays(self) -> Limits:
        """The limits of a replay_reply: whatever may be sent alone fits into one."""
        return replace(self, max_message_bytes=self.max_message_bytes + REPLAY_ROOM)

    def __post_init__(self) -> None:
        for field in fields(self):
            value: object = getattr(self, field.name)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ValueError(f"{field.name} is {value!r}; expected an integer of at least 1")
        if self.max_name_length > MAX_NAME_LENGTH:
            raise ValueError(
                f"max_name_length is {self.max_name_length}; expected at most {MAX_NAME_LENGTH}, "
                "which every peer accepts"
            )


DEFAULT_LIMITS = Limits()
