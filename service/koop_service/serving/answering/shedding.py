"""Which questions are refused while there is too much of something; see `admission/strain.py`."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from koop_protocol import KeyKind, ProtocolError
from koop_service.serving.admission.strain import Strain
from koop_service.serving.answering.questions import Question
from koop_service.serving.answering.replies import Replies


class Shedding:
    """Asked at the door, by any thread, and again at the desk: a question may have waited there."""

    def __init__(self, replies: Replies, strains: Sequence[Strain]) -> None:
        self._replies = replies
        self._strains = strains
        self._counting = threading.Lock()

    def forbids(self, question: Question) -> bool:
        """Whether the question is not to be answered at present."""
        return self._strain_against(question) is not None

    def refusal(self, question: Question) -> ProtocolError | None:
        """What to tell whoever asks, counted; None where it may be answered."""
        strain = self._strain_against(question)
        if strain is None:
            return None
        with self._counting:
            return strain.refuse()

    def _strain_against(self, question: Question) -> Strain | None:
        if question.kind not in (KeyKind.predict, KeyKind.lqr):
            return None
        for strain in self._strains:
            if strain.active and self._replies.is_costly(question):
                return strain
        return None
