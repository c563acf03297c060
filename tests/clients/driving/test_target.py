"""Targets by name, by angle and by picture."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from koop_clients.mechanics.rendering import Renderer
from koop_clients.mechanics.simulation import with_pole
from koop_clients.mechanics.systems import build_system
from koop_clients.sim_client.driving.phase import lqr_query
from koop_clients.sim_client.driving.target import read_target
from koop_clients.sim_client.options import DriveOptions

SYSTEM = build_system("cartpole")


def picture(angle: float) -> np.ndarray:
    return Renderer(SYSTEM)(with_pole(SYSTEM, angle).q)


@pytest.mark.parametrize(("text", "angle"), [("upright", 0.0), ("hang", math.pi), ("-0.3", -0.3)])
def test_an_angle_is_drawn(text: str, angle: float) -> None:
    target = read_target(DriveOptions(target=text), SYSTEM)
    assert target.angle == angle
    assert np.array_equal(target.picture, picture(angle))


@pytest.mark.parametrize("angle", [0.0, 0.3, -2.0, 3.1])
def test_a_picture_tells_its_angle(tmp_path: Path, angle: float) -> None:
    path = tmp_path / "target.npy"
    np.save(path, picture(angle))
    target = read_target(DriveOptions(target=str(path)), SYSTEM)
    assert np.array_equal(target.picture, picture(angle))
    assert target.angle == pytest.approx(angle, abs=0.005)
    assert target.mismatch < 0.005


@pytest.mark.parametrize("colours", [1, 3, 4])
def test_a_png_is_read_to_the_last_grey_level(tmp_path: Path, colours: int) -> None:
    path, shown = tmp_path / "target.png", picture(0.3)
    if colours == 1:
        from PIL import Image

        Image.fromarray(shown).save(path)
    else:
        opaque = [np.full_like(shown, 255)] * (colours - 3)
        matplotlib.image.imsave(path, np.stack([shown] * 3 + opaque, axis=-1))
    assert np.array_equal(read_target(DriveOptions(target=str(path)), SYSTEM).picture, shown)


def test_a_picture_of_something_else_is_far_from_every_angle(tmp_path: Path) -> None:
    path = tmp_path / "target.npy"
    np.save(path, np.full((64, 64), 128, np.uint8))
    assert read_target(DriveOptions(target=str(path)), SYSTEM).mismatch > 0.4


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        (None, "no such file"),
        (np.zeros((32, 64), np.uint8), r"holds \(32, 64\) uint8; expected a grey picture"),
        (np.zeros((64, 64)), r"holds \(64, 64\) float64"),
        (np.array([object()]), "cannot be read"),
    ],
)
def test_any_other_file_is_refused(tmp_path: Path, contents: np.ndarray | None, words: str) -> None:
    path = tmp_path / "target.npy"
    if contents is not None:
        np.save(path, contents)
    with pytest.raises(ValueError, match=words):
        read_target(DriveOptions(target=str(path)), SYSTEM)


def test_a_broken_or_coloured_png_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "target.png"
    path.write_bytes(b"\x89PNG nonsense")
    with pytest.raises(ValueError, match="cannot be read"):
        read_target(DriveOptions(target=str(path)), SYSTEM)
    coloured = np.zeros((64, 64, 3), np.uint8)
    coloured[..., 0] = 200
    matplotlib.image.imsave(path, coloured)
    with pytest.raises(ValueError, match=r"holds \(64, 64, 4\) uint8"):
        read_target(DriveOptions(target=str(path)), SYSTEM)


def test_the_question_shows_the_target() -> None:
    options = DriveOptions(target="0.3", horizon=7, q=2.0, r=0.1, qf="3", force=True)
    shown = read_target(options, SYSTEM).picture
    query = lqr_query(options, "gain", shown, 5.0)
    assert query.target_image is not None
    assert np.array_equal(query.target_image, picture(0.3))
    assert (query.horizon, query.q, query.r, query.qf) == (7, 2.0, 0.1, 3.0)
    assert (query.method, query.force) == ("gain", True)
    assert query.u_min is not None
    assert query.u_max is not None
    assert (query.u_min.tolist(), query.u_max.tolist()) == ([-5.0], [5.0])
    assert lqr_query(DriveOptions(), "qp", shown, 5.0).qf is None
    terminal = DriveOptions(qf="riccati")
    assert lqr_query(terminal, "qp", shown, 5.0).qf == "riccati"
