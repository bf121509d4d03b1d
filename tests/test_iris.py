"""The rim of the iris in drawn eyes."""

import numpy as np
import pytest

from avatarbuild.geometry.iris import iris_circle


def eye(centre: tuple[float, float], radius: float, noise: float = 3.0) -> np.ndarray:
    """A dark disc with a pupil and a highlight on a bright ground, lids across its top and bottom."""
    y, x = np.mgrid[0:200, 0:260] + 0.5
    distance = np.hypot(x - centre[0], y - centre[1])
    soft = lambda edge: np.clip((distance - edge) / 1.5 + 0.5, 0, 1)  # noqa: E731
    picture = 70 + 110 * soft(radius)
    picture -= 40 * (1 - soft(0.35 * radius))
    picture[
        (np.abs(x - centre[0] + 0.8 * radius) < 0.25 * radius) & (np.abs(y - centre[1] + 0.3 * radius) < 0.2 * radius)
    ] = 255
    picture[np.abs(y - centre[1]) > 0.75 * radius] = 130
    return picture + np.random.default_rng(0).normal(size=picture.shape) * noise


@pytest.mark.parametrize("radius", [9.0, 14.0, 26.0, 40.0])
def test_finds_the_rim(radius: float) -> None:
    centre = (130.4, 97.8)
    picture = eye(centre, radius)
    found, r, step = iris_circle(picture, np.array(centre) + [0.12 * radius, -0.1 * radius], radius * 1.08)
    assert abs(r / radius - 1) < 0.03
    assert abs(found[0] - centre[0]) < 0.05 * radius
    assert step > 0.5


def test_no_rim_no_trust() -> None:
    flat = np.random.default_rng(0).normal(128, 10, (100, 100))
    assert iris_circle(flat, np.array([50.0, 50.0]), 12.0)[2] < 0.6
