"""Surfaces in closed form, poses, and the exact least squares on such a surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Surface(Protocol):
    """A height z over x and y in mm, with its first and second derivatives."""

    def height(self, x: Array, y: Array) -> Array: ...
    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]: ...
    def hessian(self, x: Array, y: Array) -> tuple[Array, Array, Array]: ...


class FreeForm:
    """A free form of 102 x 62 mm with slopes up to 30 degrees."""

    RIPPLES = ((0.042, 0.016, 0.4, 7.0), (-0.018, 0.062, 1.1, 3.5), (0.070, -0.035, 2.3, 0.5))

    def height(self, x: Array, y: Array) -> Array:
        z = x * x / 420 - y * y / 310 + 6e-6 * x**3 - 1.1e-5 * x * x * y
        for kx, ky, c, a in self.RIPPLES:
            z = z + a * np.sin(kx * x + ky * y + c)
        return z

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        p = x / 210 + 1.8e-5 * x * x - 2.2e-5 * x * y
        q = -y / 155 - 1.1e-5 * x * x
        for kx, ky, c, a in self.RIPPLES:
            w = a * np.cos(kx * x + ky * y + c)
            p, q = p + kx * w, q + ky * w
        return p, q

    def hessian(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        xx = 1 / 210 + 3.6e-5 * x - 2.2e-5 * y
        xy = -2.2e-5 * x
        yy = np.full_like(x, -1 / 155)
        for kx, ky, c, a in self.RIPPLES:
            w = -a * np.sin(kx * x + ky * y + c)
            xx, xy, yy = xx + kx * kx * w, xy + kx * ky * w, yy + ky * ky * w
        return xx, xy, yy


@dataclass(frozen=True)
class Polynomial:
    """z = sum of a (x/r)^i (y/r)^j over the terms (i, j, a)."""

    radius: float
    terms: tuple[tuple[int, int, float], ...]

    def _sum(self, x: Array, y: Array, dx: int, dy: int) -> Array:
        u, v = x / self.radius, y / self.radius
        total = np.zeros_like(u)
        for i, j, a in self.terms:
            if i < dx or j < dy:
                continue
            of_x = np.prod(np.arange(i - dx + 1, i + 1))
            of_y = np.prod(np.arange(j - dy + 1, j + 1))
            total += a * of_x * of_y * u ** (i - dx) * v ** (j - dy)
        scaled: Array = total / self.radius ** (dx + dy)
        return scaled

    def height(self, x: Array, y: Array) -> Array:
        return self._sum(x, y, 0, 0)

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        return self._sum(x, y, 1, 0), self._sum(x, y, 0, 1)

    def hessian(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        return self._sum(x, y, 2, 0), self._sum(x, y, 1, 1), self._sum(x, y, 0, 2)


def points_of(surface: Surface, x: Array, y: Array) -> Array:
    return np.stack([x, y, surface.height(x, y)], -1)


def normals_of(surface: Surface, x: Array, y: Array) -> Array:
    p, q = surface.gradient(x, y)
    normals: Array = np.stack([-p, -q, np.ones_like(p)], -1) / np.sqrt(1 + p * p + q * q)[:, None]
    return normals


def moved(pose: Array, points: Array) -> Array:
    at: Array = points @ pose[:3, :3].T + pose[:3, 3]
    return at


def pose_of(turn: Array, shift: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    return pose


def placement(shift: tuple[float, float, float], degrees: tuple[float, float, float]) -> Array:
    """Pose that turns about x, then y, then z, then shifts."""
    (sx, cx), (sy, cy), (sz, cz) = ((np.sin(a), np.cos(a)) for a in np.radians(degrees))
    turn = np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )
    return pose_of(turn, np.array(shift))


def step_pose(v: Array, w: Array, about: Array) -> Array:
    """Small motion that turns by the vector w about a point and shifts by v."""
    angle = np.linalg.norm(w)
    k = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    a, b = (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2) if angle > 1e-12 else (1.0, 0.5)
    turn = np.eye(3) + a * k + b * k @ k
    return pose_of(turn, about - turn @ about + v)


#: Signed distances of points from a surface, and its normals there.
Nearest = Callable[[Array], tuple[Array, Array]]

MAX_STEPS = 1000


def gauss_newton(
    model_from_cmm: Array, measured: Array, nearest: Nearest, *, still: float = 1e-12, sigmas: float | None = None
) -> tuple[Array, Array]:
    """Moves points onto a surface by least squares, until a step is smaller than `still` of the size of the part.

    With `sigmas`, points beyond so many robust standard deviations do not count. Returns the pose model_from_cmm and the
    distances at it.
    """
    best = np.inf
    distance = np.zeros(len(measured))
    for _ in range(MAX_STEPS):
        points = moved(model_from_cmm, measured)
        distance, n = nearest(points)
        counts = np.isfinite(distance)
        if sigmas is not None:
            middle = np.median(distance[counts])
            spread = 1.4826 * np.median(np.abs(distance[counts] - middle))
            counts &= np.abs(distance - middle) <= sigmas * max(spread, 1e-9)
        points, n, d = points[counts], n[counts], distance[counts]
        about = points.mean(0)
        size = float(np.sqrt(((points - about) ** 2).sum(1).mean()))
        rows = np.hstack([n, np.cross((points - about) / size, n)])
        m = np.linalg.solve(rows.T @ rows, -rows.T @ d)
        objective = float(d @ d)
        length = float(np.linalg.norm(m))
        # Flat triangles can make the steps cycle for ever; nothing is gained from there on.
        if length < still * size or (sigmas is None and length < 1e-4 and objective >= best * (1 - still)):
            break
        best = min(best, objective)
        model_from_cmm = step_pose(m[:3], m[3:] / size, about) @ model_from_cmm
    return model_from_cmm, distance


def exact(surface: Surface, measured: Array, cmm_from_model: Array, radius: float) -> tuple[Array, Array]:
    """Least-squares pose on the closed form with the Newton foot of each point, and the deviations at it.

    The radius is negative if the probe is on the side of -z.
    """
    place: dict[str, tuple[Array, Array]] = {}

    def nearest(points: Array) -> tuple[Array, Array]:
        x, y = place.get("xy", (points[:, 0].copy(), points[:, 1].copy()))
        for _ in range(50):
            (p, q), (xx, xy, yy) = surface.gradient(x, y), surface.hessian(x, y)
            dx, dy, dz = points[:, 0] - x, points[:, 1] - y, points[:, 2] - surface.height(x, y)
            fx, fy = dx + dz * p, dy + dz * q
            a, b, c = 1 + p * p - dz * xx, p * q - dz * xy, 1 + q * q - dz * yy
            det = a * c - b * b
            sx, sy = (c * fx - b * fy) / det, (a * fy - b * fx) / det
            x, y = x + sx, y + sy
            if max(np.abs(sx).max(), np.abs(sy).max()) < 1e-11:
                break
        place["xy"] = x, y
        n = normals_of(surface, x, y)
        return ((points - points_of(surface, x, y)) * n).sum(1) - radius, n

    pose, distance = gauss_newton(np.linalg.inv(cmm_from_model), measured, nearest)
    return np.linalg.inv(pose), np.sign(radius) * distance
