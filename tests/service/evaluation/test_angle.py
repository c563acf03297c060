"""The angle read from rendered pictures is the simulator's."""

import numpy as np

from koop_service.evaluation.angle import angle_error, pole_angle


def test_read_from_rendered_frames(small_set):
    pictures = small_set.recording.frames / 255
    errors = np.rad2deg(angle_error(pole_angle(pictures), small_set.states[:, :, 0]))
    assert np.median(errors) < 0.3
    assert errors.max() < 1.5


def test_upright_is_zero_and_right_is_positive():
    pictures = np.zeros((4, 65, 65))
    for picture, (i, j) in zip(pictures, [(10, 32), (32, 50), (60, 32), (32, 5)], strict=True):
        picture[i, j] = 1.0
    np.testing.assert_allclose(pole_angle(pictures), [0, np.pi / 2, np.pi, -np.pi / 2], atol=1e-12)


def test_the_rod_does_not_pull():
    picture = np.zeros((65, 65))
    picture[32, 32:60] = 0.75
    picture[10, 32] = 1.0
    assert pole_angle(picture) == 0


def test_a_dimmer_picture_reads_the_same(small_set):
    picture = small_set.recording.frames[0, 5] / 255
    assert np.isclose(pole_angle(0.6 * picture), pole_angle(picture))


def test_errors_wrap_and_a_black_picture_is_as_wrong_as_can_be():
    found = angle_error(np.array([3.1, 0.1, np.nan]), np.array([-3.1, 12.7, 1.0]))
    np.testing.assert_allclose(
        found, [2 * np.pi - 6.2, abs(0.1 - (12.7 - 4 * np.pi)), np.pi], atol=1e-9
    )
