"""A client waits for what passes, not for ever, and says why it had no answer."""

from __future__ import annotations

import numpy as np
import pytest

from koop_clients.queries import NO_REPLY, KoopError
from koop_clients.sim_client import patience as module
from koop_clients.sim_client.forecasting import Asker
from koop_clients.sim_client.patience import PASSING, Patience, in_few_words
from koop_protocol import ErrorCode, PredictReply


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize("code", sorted(set(ErrorCode) - PASSING))
def test_what_lasts_is_raised_at_once(code: str) -> None:
    error = KoopError(code, "no")
    with pytest.raises(KoopError) as caught:
        Patience().try_with(error)
    assert caught.value is error


@pytest.mark.parametrize("code", sorted(PASSING - {ErrorCode.warming_up, ErrorCode.overloaded}))
def test_what_passes_is_raised_after_ten_seconds(code: str, clock: list[float]) -> None:
    patience, error = Patience(), KoopError(code, "not now")
    for clock[0] in (0.0, 5.0, 10.0):
        patience.try_with(error)
    clock[0] = 10.1
    with pytest.raises(KoopError):
        patience.try_with(error)


def test_an_answer_restores_patience(clock: list[float]) -> None:
    patience, error = Patience(), KoopError(NO_REPLY, "nobody")
    patience.try_with(error)
    clock[0] = 9.0
    patience.restore()
    for clock[0] in (9.5, 19.0):
        patience.try_with(error)


@pytest.mark.parametrize("code", [ErrorCode.warming_up, ErrorCode.overloaded])
def test_a_service_that_lives_may_take_its_time(code: str, clock: list[float]) -> None:
    patience = Patience()
    for clock[0] in range(0, 100, 5):
        patience.try_with(KoopError(code, "later"))


def test_a_refusal_fits_into_a_row() -> None:
    warming = KoopError("warming_up", "long", {"frames": 12, "warmup_frames": 36})
    assert in_few_words(warming) == "warming up, 12 of 36 frames"
    assert in_few_words(KoopError(NO_REPLY, "long")) == "the service does not answer"
    assert in_few_words(KoopError("overloaded", "too many queries")) == "too many queries"


class Answers:
    """A service that gives one answer, or error, after the other."""

    def __init__(self, *answers: PredictReply | KoopError) -> None:
        self._answers = iter(answers)

    def predict(self, *_: object) -> PredictReply:
        answer = next(self._answers)
        if isinstance(answer, KoopError):
            raise answer
        return answer


WARMING = KoopError(ErrorCode.warming_up, "12 of 36 frames")
UNKNOWN = KoopError(ErrorCode.unknown_trajectory, "no frame of 'a' has come")
ANSWER = PredictReply("a", "0" * 16, 0, codes=np.zeros((1, 8)))


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        ([], ""),
        ([UNKNOWN, WARMING], ""),
        ([UNKNOWN, WARMING, ANSWER, UNKNOWN], ""),
        ([WARMING, UNKNOWN], "no frame of 'a' has come. Frames were put all the time; where the"),
        ([KoopError(NO_REPLY, "nobody answers")], "nobody answers"),
    ],
)
def test_a_service_that_never_answered_is_told_of(
    answers: list[PredictReply | KoopError], told: str
) -> None:
    asker = Asker(Answers(*answers))  # type: ignore[arg-type]
    for _ in answers:
        asker.predict("a", None, 1)
    assert asker.silence[: len(told)] == told
    assert bool(asker.silence) == bool(told)
