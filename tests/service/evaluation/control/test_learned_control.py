"""The baseline of [6] on the wire: its estimate, its commands, its answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from koop_protocol import (
    Command,
    Control,
    ErrorReply,
    Frame,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    encode,
)
from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.control.learned_control import LearnedControl

A = np.array([[1.1, 0.2], [0.0, 0.9]])
B = np.array([[0.3], [0.5]])
EPOCH = "00" * 8
SETTINGS = EstimatorSettings(code_size=2, history=1, control_size=1, affine=True, rho=1e-6)


@dataclass
class Codec:
    """A picture's first two pixels are its code."""

    def encode(self, images: np.ndarray) -> np.ndarray:
        return images[:, 0, :2].astype(np.float64)


def picture(code: np.ndarray) -> np.ndarray:
    image = np.zeros((2, 2), np.float32)
    image[0] = code
    return image


def service_after(frames: int, learned: np.ndarray = B) -> tuple[LearnedControl, np.ndarray]:
    """A baseline that saw `frames` frames of z' = A z + B u, and the last code."""
    service, rng = LearnedControl(Codec(), learned, SETTINGS), np.random.default_rng(0)  # type: ignore[arg-type]
    z = np.array([0.1, -0.2])
    for seq in range(frames):
        assert service.measure(encode(Frame("p/0", EPOCH, seq, 1, picture(z)))) is None
        u = rng.normal(size=1) - 0.5 * z[:1]
        service.measure(encode(Control("p/0", EPOCH, seq, u)))
        z = A @ z + B @ u
    return service, z


def task() -> LqrTask:
    query = LqrQuery(
        10, target_code=np.zeros(2), r=1e-3, u_min=np.array([-5.0]), u_max=np.array([5.0])
    )
    return LqrTask("me", query)


def test_a_is_learned_and_b_stays_as_it_was_given() -> None:
    service, _ = service_after(40)
    model = service._find("p/0").estimate.model()
    np.testing.assert_allclose(model.A, A, atol=1e-3)
    np.testing.assert_array_equal(model.B, B)
    wrong, _ = service_after(40, learned=2 * B)
    found = wrong._find("p/0").estimate.model()
    np.testing.assert_array_equal(found.B, 2 * B)
    assert np.abs(found.A - A).max() > 0.01


def test_a_task_gets_a_command_at_each_frame_until_it_is_cancelled() -> None:
    service, z = service_after(40)
    reply = service.ask("p/0", encode(task()))
    assert isinstance(reply, LqrReply)
    assert (reply.seq, reply.fit) == (39, True)
    for seq in range(40, 60):
        command = service.measure(encode(Frame("p/0", EPOCH, seq, 1, picture(z))))
        assert isinstance(command, Command)
        assert (command.seq, command.start, command.owner) == (seq, seq, "me")
        u = command.controls[0]
        service.measure(encode(Control("p/0", EPOCH, seq, u)))
        z = A @ z + B @ u
    assert np.abs(z).max() < 0.02
    end = service.ask("p/0", encode(LqrCancel("me")))
    assert isinstance(end, LqrEnd)
    assert service.measure(encode(Frame("p/0", EPOCH, 60, 1, picture(z)))) is None


def test_what_it_cannot_answer_it_refuses() -> None:
    service, _ = service_after(0)
    assert isinstance(service.ask("p/0", encode(task())), ErrorReply)


def test_after_a_gap_there_is_no_command_until_the_history_is_whole_again() -> None:
    settings = EstimatorSettings(code_size=2, history=2, control_size=1, affine=True, rho=1e-6)
    service, z = LearnedControl(Codec(), B, settings), np.array([0.1, 0.2])  # type: ignore[arg-type]
    for seq in (0, 1):
        service.measure(encode(Frame("p/0", EPOCH, seq, 1, picture(z))))
    assert isinstance(service.ask("p/0", encode(task())), LqrReply)
    late = [encode(Frame("p/0", EPOCH, seq, 1, picture(z))) for seq in range(20, 31)]
    commands = [service.measure(frame) for frame in late]
    assert commands[0] is None
    assert isinstance(commands[-1], Command)
