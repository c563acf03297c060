"""Several workers on one hub: each trajectory is learned once, and answered for once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import zenoh
from integration.loopback import DEADLINE, Source, ask_all, client, config_for
from integration.secured import HOST, OTHER, ROBOT, Secured, deploy
from integration.secured import stream as stream_of

from koop_clients.queries import KoopClient, KoopError
from koop_protocol import ErrorReply, PredictReply, StateReply, shard_of
from koop_service.assembly import Service, running
from koop_service.serving.config import ComputeSettings, ModelRule, NetworkSettings, ServiceConfig
from koop_service.serving.placement.hub import hub
from koop_service.serving.session import open_session
from koop_service.serving.sharding.settings import PlacementSettings

COUNT = 3
NAMES = [f"cart/{i}" for i in range(9)]


@dataclass
class Team:
    """The workers, by number, and a client of the hub."""

    workers: list[Service]
    session: zenoh.Session
    stacks: list[ExitStack]

    def ask(self, key: str) -> list:
        return ask_all(self.session, key)

    def stop(self, number: int) -> None:
        self.stacks[number].close()

    def owner(self, name: str) -> int:
        return int(shard_of(name), 16) * COUNT // 64


@contextmanager
def started(folder: Path, model: Path) -> Iterator[Team]:
    config = replace(config_for(folder, model), compute=ComputeSettings(batch=4))
    with ExitStack() as everything:
        shared = everything.enter_context(hub(config.network))
        stacks = [everything.enter_context(ExitStack()) for _ in range(COUNT)]
        workers = []
        for number, stack in enumerate(stacks):
            mine = replace(
                config,
                network=shared.network,
                placement=PlacementSettings(worker=f"{number}/{COUNT}"),
                state_folder=folder / f"state{number}",  # one process opens a file only once
            )
            session = stack.enter_context(open_session(mine.network))
            workers.append(stack.enter_context(running(mine, session)))
        session = everything.enter_context(client(shared.endpoints[0]))
        yield Team(workers, session, stacks)


@pytest.fixture(scope="module")
def streamed(tmp_path_factory: pytest.TempPathFactory, model: Path) -> Iterator[Team]:
    with started(tmp_path_factory.mktemp("team"), model) as team:
        stream(team)
        yield team


@pytest.fixture(scope="module")
def guarded_team(tmp_path_factory: pytest.TempPathFactory, model: Path) -> Iterator[Secured]:
    """Two workers behind the shipped access rules; `service` is the first, `hub` its session."""
    folder = tmp_path_factory.mktemp("guarded")
    deployment = deploy(folder / "pki")
    public = NetworkSettings(zenoh_config=deployment.configuration, listen=(f"tls/{HOST}:0",))
    with ExitStack() as everything:
        shared = everything.enter_context(hub(public))
        started = []
        for number in range(2):
            config = ServiceConfig(
                models=(ModelRule(model, ("line3/*",)),),
                network=shared.network,
                placement=PlacementSettings(worker=f"{number}/2"),
                state_folder=folder / f"state{number}",
            )
            session = everything.enter_context(open_session(config.network))
            started.append((everything.enter_context(running(config, session)), session))
        yield Secured(*started[0], deployment, shared.endpoints[0])


def stream(team: Team) -> None:
    for seed, name in enumerate(NAMES):
        Source(team.session, name, seed).stream(40)
    assert len({team.owner(name) for name in NAMES}) == COUNT


def test_every_trajectory_is_learned_by_its_owner_alone(streamed: Team) -> None:
    for name in NAMES:
        (state,) = streamed.ask(f"koop/state/{name}")
        assert isinstance(state, StateReply)
        assert (state.trajectory, state.frames) == (name, 40)
    for number, worker in enumerate(streamed.workers):
        owned = [name for name in NAMES if streamed.owner(name) == number]
        assert worker.metrics.value("koop_trajectories") == len(owned)
        assert worker.metrics.value("koop_frames_total") == 40 * len(owned)
        assert worker.metrics.value("koop_rejected_total", reason="bad_key") == 0


def test_a_wildcard_gives_one_answer_a_trajectory(streamed: Team) -> None:
    answers = streamed.ask("koop/predict/**?horizon=3")
    assert sorted(a.trajectory for a in answers if isinstance(a, PredictReply)) == NAMES
    assert len(answers) == len(NAMES)


@pytest.mark.parametrize(
    ("key", "code"),
    [
        ("koop/state/cart/unknown", "unknown_trajectory"),
        ("koop/predict/other/0", "no_model"),
        ("koop/predict/no name", "bad_key"),
        ("koop/predict/cart/0?horizon=0", "bad_horizon"),
        ("koop/predict/**?horizon=0", "bad_horizon"),
        ("koop/lqr/**", "malformed"),
    ],
)
def test_exactly_one_worker_complains(streamed: Team, key: str, code: str) -> None:
    (error,) = streamed.ask(key)
    assert isinstance(error, ErrorReply)
    assert error.code == code


def test_of_an_owner_that_is_down_nobody_speaks_and_the_client_says_what_to_do(
    tmp_path: Path, model: Path
) -> None:
    with started(tmp_path, model) as team:
        assert team.ask("koop/predict/**") == [], "no worker can know that there is none at all"
        with pytest.raises(KoopError, match="no trajectory matches"):
            KoopClient(team.session).predict_all(3)
        stream(team)
        gone = team.owner(NAMES[0])
        team.stop(gone)
        left = [name for name in NAMES if team.owner(name) != gone]
        koop = KoopClient(team.session)
        for _ in range(2):  # a question that meets the owner as it leaves gets its time-out
            with pytest.raises(KoopError, match="the worker that has this trajectory"):
                koop.predict(NAMES[0], 3)
        assert sorted(koop.predict_all(3, timeout=DEADLINE)) == left


def test_workers_behind_access_rules_serve_who_has_the_right(guarded_team: Secured) -> None:
    with guarded_team.session("robot7") as robot, guarded_team.session("wall") as viewer:
        stream_of(robot, ROBOT, 40)
        assert KoopClient(robot, DEADLINE).state(ROBOT).frames == 40
        assert KoopClient(viewer, DEADLINE).predict(ROBOT, 5).seq == 39
        stream_of(robot, OTHER, 40)  # another robot's
        with pytest.raises(KoopError):
            KoopClient(viewer, DEADLINE).state(OTHER)
    with guarded_team.session("robot8") as robot:
        stream_of(robot, OTHER, 40)
        assert KoopClient(robot, DEADLINE).state(OTHER).frames == 40
