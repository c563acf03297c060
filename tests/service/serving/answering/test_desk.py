"""Who is answered first, what is shed, and what never is: the desk without a network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from koop_protocol import (
    CATCHING_UP,
    HEALTH,
    OVERLOADED,
    ErrorReply,
    Frame,
    Health,
    KeyKind,
    Limits,
    LqrCancel,
    LqrQuery,
    LqrTask,
    PredictQuery,
    PredictReply,
    StateReply,
    decode,
    encode,
)
from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.catalogue import Catalogue, ModelEntry
from koop_service.encoding.weights import ModelCard, save_weights
from koop_service.serving.admission.intake import Intake
from koop_service.serving.admission.strain import MEMORY, QUEUE, Strain
from koop_service.serving.answering.desk import Desk
from koop_service.serving.answering.outbox import Outbox
from koop_service.serving.answering.replies import Replies
from koop_service.serving.answering.shedding import Shedding
from koop_service.serving.config import EstimatorChoices
from koop_service.serving.instruments.metrics import Metrics
from koop_service.serving.monitoring.memory import Memory
from koop_service.serving.monitoring.vitals import Vitals
from koop_service.serving.replay.recovery import Recovery
from koop_service.serving.steering.commander import Commander
from koop_service.serving.steering.tasks import Tasks
from koop_service.serving.trajectories.refusals import Refusals
from koop_service.serving.trajectories.registry import Registry

FOREVER = 60.0


class Caller:
    """A question that keeps its answers."""

    def __init__(self, kind: KeyKind, name: str, message: object = None) -> None:
        self.kind, self.parameters, self.got = kind, {}, []
        self.key = HEALTH if kind is KeyKind.health else f"koop/{kind}/{name}"
        self.payload = None if message is None else encode(message)
        self.size = len(self.payload or b"")

    def age(self) -> float:
        return 0.0

    def matches(self, key: str) -> bool:
        return self.key.replace("**", "") in key

    def reply(self, key: str, payload: bytes) -> None:
        assert self.matches(key)
        self.got.append(decode(payload))

    def refuse(self, payload: bytes) -> None:
        self.got.append(decode(payload))

    def close(self) -> None:
        self.got.append(None)


class Office:
    """A desk with two trajectories past their warm-up."""

    def __init__(self, folder: Path) -> None:
        path = folder / "model.safetensors"
        save_weights(path, initialised(8, 0), ModelCard("test", "test", 0.05))
        catalogue = Catalogue([ModelEntry("test", path, ("*",))])
        self.metrics, self.order = Metrics(), []
        registry = Registry(catalogue, EstimatorChoices(), Refusals(self.metrics), 2)
        stream(registry, "a", "b")
        self.intake: Intake = Intake(100, 1 << 20, 50)
        commander = Commander(Tasks(), registry, lambda *_: None, self.metrics)
        self.queue = Strain(QUEUE, self.metrics)
        memory = Memory(0, Strain(MEMORY, self.metrics))
        self.vitals = Vitals("here:1", self.intake, registry, self.queue, memory)
        self.outbox = Outbox(self.order.append, lambda: None, 1 << 20)
        replies = Replies(commander, Limits(), Limits())
        self.desk = Desk(
            self.intake,
            registry,
            replies,
            Recovery(registry, lambda _: None, self.metrics, Limits(), 2),
            self.outbox,
            self.metrics,
            self.vitals,
            Shedding(replies, [self.queue]),
        )

    def ask(self, *callers: Caller) -> list[list]:
        """What each gets in one turn."""
        for caller in callers:
            assert self.intake.ask(caller, caller.size, caller.kind)
        self.desk.collect()
        self.desk.answer(FOREVER)
        return [caller.got for caller in callers]

    def deliver(self) -> None:
        self.outbox.start()
        self.outbox.stop(FOREVER)


def stream(registry: Registry, *names: str) -> None:
    codes = np.random.default_rng(0).normal(size=(60, 8))
    for name in names:
        for seq, code in enumerate(codes):
            frame = Frame(name, "0" * 16, seq, 0, np.zeros((64, 64), np.uint8), "test")
            trajectory = registry.admit(frame)
            trajectory.fold_frame(frame, code)
        registry.update_estimators([trajectory])


@pytest.fixture
def office(tmp_path: Path) -> Office:
    return Office(tmp_path)


def predict(name: str, *returns: str) -> Caller:
    return Caller(KeyKind.predict, name, PredictQuery(3, returns=frozenset(returns)))


def test_an_overload_sheds_what_costs_much_and_nothing_else(office: Office) -> None:
    office.queue.observe(1.0)
    costly = [predict("a", "frames"), predict("a", "codes", "std"), predict("**", "codes")]
    pictures = LqrQuery(3, target_code=np.zeros(8), returns=frozenset({"frames"}))
    costly.append(Caller(KeyKind.lqr, "a", pictures))
    cheap = [predict("a", "codes"), Caller(KeyKind.state, "**"), Caller(KeyKind.health, "")]
    steering = [
        Caller(KeyKind.lqr, "a", LqrQuery(3, target_code=np.zeros(8))),
        Caller(KeyKind.lqr, "a", LqrTask("me", LqrQuery(3, target_code=np.zeros(8)))),
        Caller(KeyKind.lqr, "a", LqrCancel("me")),
    ]
    office.ask(*costly, *cheap, *steering)
    office.deliver()
    for caller in costly:
        refusal, end = caller.got
        assert end is None
        assert isinstance(refusal, ErrorReply)
        assert refusal.code == "overloaded"
        assert refusal.details == {"reason": OVERLOADED, "retry_after": 1.0}
    forecast, states, health = (caller.got for caller in cheap)
    assert isinstance(forecast[0], PredictReply)
    assert [type(answer) for answer in states] == [StateReply, StateReply, type(None)]
    assert health[0].degraded == (OVERLOADED,)
    for caller in steering:  # not actuated and nobody's: refused on their merits
        assert caller.got[0].code != "overloaded"
    assert office.metrics.value("koop_shed_total", reason=OVERLOADED) == len(costly)


def test_without_an_overload_nothing_is_shed(office: Office) -> None:
    callers = [predict("a", "frames"), predict("b", "codes", "std"), predict("**", "codes")]
    office.ask(*callers)
    office.deliver()
    assert [len(caller.got) for caller in callers] == [2, 2, 3]
    assert all(isinstance(caller.got[0], PredictReply) for caller in callers)


def test_what_is_shed_does_not_wait_for_its_measurements(office: Office) -> None:
    office.intake.put("koop/frame/00/a", b"waits")
    cheap, costly = predict("a", "codes"), predict("a", "frames")
    office.queue.observe(1.0)
    office.ask(cheap, costly)
    office.deliver()
    assert cheap.got == []
    assert costly.got[0].code == "overloaded"


def test_control_goes_before_states_and_those_before_predictions(office: Office) -> None:
    callers = [
        predict("a", "codes"),
        Caller(KeyKind.state, "a"),
        Caller(KeyKind.lqr, "a", LqrCancel("me")),
        Caller(KeyKind.health, ""),
    ]
    office.ask(*callers)
    office.deliver()
    assert office.order == callers[::-1]


def test_health_says_how_it_stands(office: Office) -> None:
    office.vitals.watch(CATCHING_UP, lambda: True)
    office.vitals.folded()
    office.intake.put("koop/frame/00/a", b"waits")
    caller = Caller(KeyKind.health, "")
    office.ask(caller)
    office.deliver()
    health, _ = caller.got
    assert isinstance(health, Health)
    assert (health.worker, health.trajectories, health.queue, health.queries) == ("here:1", 2, 1, 1)
    assert health.degraded == (CATCHING_UP,)
    assert health.last_fold is not None


def test_a_flood_of_predictions_leaves_room_for_the_others(office: Office) -> None:
    flood = [predict("a", "codes") for _ in range(60)]
    taken = [office.intake.ask(caller, caller.size, caller.kind) for caller in flood]
    assert taken == [True] * 50 + [False] * 10
    for kind in (KeyKind.state, KeyKind.lqr, KeyKind.health):
        assert office.intake.ask(Caller(kind, "a"), 0, kind)
