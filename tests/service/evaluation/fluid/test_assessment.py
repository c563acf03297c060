"""Every method is what it is called, on waves that come back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from koop_service.evaluation.fluid.assessment import SHOWN, Judged, assess
from koop_service.evaluation.fluid.cases import FIT_FRAMES, UPDATE_AT, WAKES, Case, cases
from koop_service.evaluation.fluid.sequences import Sequences, load_sequences
from koop_service.evaluation.forecasts import Array
from koop_service.evaluation.trained import Trained, load

from .waves import write_model, write_set

COUNT = 3
GUESSES = {"repeat-last", "mean-frame", "previous-frame"}


def prepared(folder: Path, name: str) -> tuple[Case, Trained, Sequences]:
    case = next(cases(WAKES[name], COUNT, ()))
    write_model(folder / f"{name}.safetensors")
    if case.wake.actuated:
        write_model(folder / f"baselines/{name}-learned-B.safetensors", "learned-B")
    trained, _ = load(folder, case.system)
    path = write_set(folder / "set.h5", case)
    return case, trained, load_sequences(path, case.starts, case.length)


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> tuple[Case, Trained, Sequences]:
    return prepared(tmp_path_factory.mktemp("turning"), "cylinder-actuated")


@pytest.fixture(scope="module")
def judged(turning: tuple[Case, Trained, Sequences]) -> Judged:
    return assess(*turning)


def l1(pictures: np.ndarray, truth: np.ndarray) -> Array:
    return np.abs(pictures - truth.astype(np.float64)).mean((2, 3))


def test_all_methods_are_judged(judged: Judged) -> None:
    regimes = {"offline", "once", "full"}
    theirs = {"learned-B", "learned-B-once", "learned-B-full"}
    assert set(judged.errors) == {"reconstruction"} | regimes | theirs | GUESSES
    for errors in judged.errors.values():
        assert errors.absolute.shape == (COUNT, 116, 3)
        assert errors.visible.shape == (COUNT, 116)
        assert np.isfinite(errors.absolute).all()
    assert judged.sequences == COUNT


def test_the_errors_are_those_of_the_decoded_codes(
    judged: Judged, turning: tuple[Case, Trained, Sequences]
) -> None:
    _, trained, sequences = turning
    frames, codec = sequences.of(1), trained.codec
    own = l1(codec.decode(codec.encode(frames)), frames)
    np.testing.assert_allclose(judged.errors["reconstruction"].absolute[1], own, rtol=1e-4)
    for name, errors in judged.errors.items():
        if not name.startswith("learned"):
            np.testing.assert_allclose(errors.absolute[1, :FIT_FRAMES], own[:FIT_FRAMES], rtol=1e-4)
    last = l1(frames[FIT_FRAMES - 1 : FIT_FRAMES], frames[FIT_FRAMES:])
    found = judged.errors["repeat-last"].absolute[1, FIT_FRAMES:]
    np.testing.assert_allclose(found, last, rtol=1e-4)


def test_how_much_the_cylinder_turns_after_the_fit(
    judged: Judged, turning: tuple[Case, Trained, Sequences]
) -> None:
    controls = turning[2].controls[:, FIT_FRAMES - 1 :, 0]
    np.testing.assert_allclose(judged.turned, np.sqrt((controls**2).mean(1)))
    assert controls.shape == (COUNT, 100)


def test_the_regimes_differ_from_their_first_update_on(judged: Judged) -> None:
    offline, once, full = (judged.l1(regime) for regime in ("offline", "once", "full"))
    np.testing.assert_array_equal(offline[:, :UPDATE_AT], once[:, :UPDATE_AT])
    assert (offline[:, UPDATE_AT + 1 :] != once[:, UPDATE_AT + 1 :]).any()
    assert (offline[:, FIT_FRAMES + 1 : UPDATE_AT] != full[:, FIT_FRAMES + 1 : UPDATE_AT]).any()


def test_the_strip_shows_the_median_sequence(
    judged: Judged, turning: tuple[Case, Trained, Sequences]
) -> None:
    _, _, sequences = turning
    after = judged.l1("offline")[:, FIT_FRAMES:].mean(1)
    median = int(np.argsort(after)[1])
    at = [FIT_FRAMES - 1 + k for k in SHOWN]
    truth = sequences.units.x_momentum(sequences.of(median)[at])
    np.testing.assert_array_equal(judged.strip[0], truth)
    assert judged.strip.shape == (2, len(SHOWN), 16, 32)


def test_a_wake_of_its_own_is_also_guessed_by_its_period(tmp_path: Path) -> None:
    judged = assess(*prepared(tmp_path, "cylinder"))
    assert set(judged.errors) == {"reconstruction", "offline", "once", "full"} | GUESSES | {
        "repeat-period",
        "period-ago",
    }
    assert judged.after_fit("repeat-period") < 1e-3 < judged.after_fit("repeat-last")


def test_only_sequences_that_share_no_frame(judged: Judged) -> None:
    apart = judged.apart()
    assert apart.case.starts == judged.case.starts[::5]
    np.testing.assert_array_equal(apart.l1("full"), judged.l1("full")[::5])


def test_another_renderer_is_refused(tmp_path: Path) -> None:
    case, _, sequences = prepared(tmp_path, "cylinder")
    write_model(tmp_path / "cylinder.safetensors", renderer="koop-sdf-1")
    with pytest.raises(ValueError, match="trained on frames by 'koop-sdf-1'"):
        assess(case, load(tmp_path, case.system)[0], sequences)
