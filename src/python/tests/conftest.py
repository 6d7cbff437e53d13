"""A nominal surface and its measured points, which the tests share."""

import numpy as np
import pytest

import regrind

PROBE_RADIUS = 1.5


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 1e-3 * x**2 + 2e-3 * y**2 + 1e-5 * x**3 - 4e-6 * y**3


@pytest.fixture(scope="session")
def nominal() -> regrind.Nominal:
    return regrind.Nominal.from_function(height, np.linspace(-40, 40, 161), np.linspace(-30, 30, 121))


@pytest.fixture(scope="session")
def centres(nominal: regrind.Nominal) -> np.ndarray:
    """Every 17th centre of a probe on the surface, away from its edge."""
    points = nominal.offset(PROBE_RADIUS)[::17]
    return points[(abs(points[:, 0]) < 38) & (abs(points[:, 1]) < 28)]


def turned(points: np.ndarray, angle: float, shift: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Points after a turn about the axis (1, 2, 3) and a shift, and the pose that does it."""
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    pose = np.eye(4)
    pose[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    pose[:3, 3] = shift
    return points @ pose[:3, :3].T + pose[:3, 3], pose
