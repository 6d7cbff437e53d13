"""Contenders of the benchmark: each registers a case with the best settings that its interface offers.

A contender prepares what it can before it sees the measured points (`ready`), then registers. All of them return the pose
cmm_from_model and one deviation for each measured point; NaN where they leave it out.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

import regrind

from .cases import Case
from .surfaces import Array, gauss_newton, moved

MAX_STEPS = 1000


@dataclass
class Result:
    """Result of one registration."""

    cmm_from_model: Array
    deviations: Array
    ready_s: float
    total_s: float


@dataclass(frozen=True)
class Contender:
    """Program that registers points."""

    label: str
    #: Python modules that it needs.
    modules: tuple[str, ...]
    run: Callable[[Case], Result]
    #: What else is missing here, such as "libpcl-dev is"; None if nothing is.
    lacks: Callable[[], str | None] = lambda: None

    def missing(self) -> str | None:
        """What it needs and is not installed, such as "igl is"."""
        absent = next((name for name in self.modules if importlib.util.find_spec(name) is None), None)
        return f"{absent} is" if absent else self.lacks()


def _regrind(case: Case, *, search: bool) -> Result:
    begun = time.perf_counter()
    nominal = regrind.Nominal.from_points(case.nominal)
    ready = time.perf_counter()
    found = regrind.register(
        nominal,
        case.measured,
        probe_radius=abs(case.radius),
        side="above" if case.radius > 0 else "below",
        initial=None if search else case.start,
        # Without outliers, plain least squares as those of the others.
        outlier_sigmas=6.0 if not case.inliers.all() else np.inf,
    )
    deviations = np.where(found.used, found.deviations, np.nan)
    done = time.perf_counter()
    return Result(found.pose, deviations, ready - begun, done - begun)


def _offset_cloud(case: Case) -> tuple[Array, Array]:
    """Offset points and their normals: from differences along the grid, or from the nearest 12 points."""
    if case.grid is not None:
        grid = case.nominal.reshape(*case.grid, 3)
        along_y, along_x = (np.gradient(grid, axis=axis, edge_order=2) for axis in (0, 1))
        n = np.cross(along_x, along_y).reshape(-1, 3)
        n /= np.linalg.norm(n, axis=1)[:, None]
    else:
        n = _normals_of_neighbours(case.nominal)
    return case.nominal + case.radius * n, n


def _normals_of_neighbours(points: Array) -> Array:
    """Normals of local quadrics through the nearest 20 points, which are exacter than those of local planes."""
    from scipy.spatial import KDTree

    _, index = KDTree(points).query(points, 20)
    around = points[index] - points[:, None, :]
    x, y, z = around[..., 0], around[..., 1], around[..., 2]
    columns = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    solved = np.linalg.solve(np.swapaxes(columns, 1, 2) @ columns, (np.swapaxes(columns, 1, 2) @ z[..., None]))
    p, q = solved[:, 1, 0], solved[:, 2, 0]
    normals: Array = np.stack([-p, -q, np.ones_like(p)], -1) / np.sqrt(1 + p * p + q * q)[:, None]
    return normals


def _open3d(case: Case) -> Result:
    import open3d as o3d

    begun = time.perf_counter()
    points, normals = _offset_cloud(case)
    target, source = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
    target.points, target.normals = o3d.utility.Vector3dVector(points), o3d.utility.Vector3dVector(normals)
    source.points = o3d.utility.Vector3dVector(case.measured)
    ready = time.perf_counter()
    reg = o3d.pipelines.registration
    pose = np.linalg.inv(case.start)
    found: Any = None
    kernels: list[Any] = [None] * len(case.reaches)
    if not case.inliers.all():
        # From coarse to fine, the last one at six times the form error.
        kernels += [reg.TukeyLoss(k=0.1), reg.TukeyLoss(k=0.01)]
    for reach, kernel in zip((*case.reaches, case.reaches[-1], case.reaches[-1]), kernels, strict=False):
        estimation = reg.TransformationEstimationPointToPlane(*([] if kernel is None else [kernel]))
        found = reg.registration_icp(
            source, target, reach, pose, estimation, reg.ICPConvergenceCriteria(1e-9, 1e-9, MAX_STEPS)
        )
        pose = found.transformation
    done = time.perf_counter()
    pair = np.asarray(found.correspondence_set)
    deviations = np.full(len(case.measured), np.nan)
    at = moved(pose, case.measured[pair[:, 0]]) - points[pair[:, 1]]
    deviations[pair[:, 0]] = np.sign(case.radius) * (at * normals[pair[:, 1]]).sum(1)
    return Result(np.linalg.inv(pose), deviations, ready - begun, done - begun)


def _faces(case: Case) -> Array:
    if case.grid is None:
        from scipy.spatial import Delaunay

        faces: Array = Delaunay(case.nominal[:, :2]).simplices
        return faces
    rows, columns = case.grid
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([first, first + 1, first + columns + 1], -1)
    upper = np.stack([first, first + columns + 1, first + columns], -1)
    return np.vstack([lower, upper])


def _libigl(case: Case) -> Result:
    import igl

    begun = time.perf_counter()
    points, _ = _offset_cloud(case)
    faces = _faces(case)
    n = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    n /= np.linalg.norm(n, axis=1)[:, None]
    n *= np.where(n[:, 2] < 0, -1.0, 1.0)[:, None]
    tree = igl.AABB()
    tree.init(points, faces)
    ready = time.perf_counter()

    def nearest(at: Array) -> tuple[Array, Array]:
        _, face, foot = tree.squared_distance(points, faces, np.ascontiguousarray(at))
        face = np.asarray(face).ravel()
        return ((at - foot) * n[face]).sum(1), n[face]

    pose, distance = gauss_newton(np.linalg.inv(case.start), case.measured, nearest, still=1e-9)
    if not case.inliers.all():
        pose, distance = gauss_newton(pose, case.measured, nearest, still=1e-9, sigmas=6.0)
    done = time.perf_counter()
    return Result(np.linalg.inv(pose), np.sign(case.radius) * distance, ready - begun, done - begun)


def _small_gicp(case: Case) -> Result:
    import small_gicp

    begun = time.perf_counter()
    points, normals = _offset_cloud(case)
    # The cloud is kept whole: a voxel grid as in its examples would move the points by far more than a micrometre.
    target, source = small_gicp.PointCloud(points), small_gicp.PointCloud(case.measured)
    tree = small_gicp.KdTree(target, num_threads=2)
    small_gicp.estimate_normals_covariances(target, tree, num_neighbors=10, num_threads=2)
    ready = time.perf_counter()
    small_gicp.estimate_normals_covariances(source, num_neighbors=10, num_threads=2)

    def align(pose: Array, of: Any, reaches: tuple[float, ...]) -> Array:
        for reach in reaches:
            found = small_gicp.align(
                target,
                of,
                tree,
                init_T_target_source=pose,
                registration_type="GICP",
                max_correspondence_distance=reach,
                num_threads=2,
                max_iterations=MAX_STEPS,
                translation_epsilon=1e-9,
                rotation_epsilon=1e-12,
            )
            pose = found.T_target_source
        return pose

    def distances(pose: Array) -> Array:
        at = moved(pose, case.measured)
        index, _ = tree.batch_nearest_neighbor_search(at, num_threads=2)
        along: Array = ((at - points[index]) * normals[index]).sum(1)
        return along

    pose = align(np.linalg.inv(case.start), source, (*case.reaches, _last_reach(case)))
    distance = distances(pose)
    if not case.inliers.all():
        kept = small_gicp.PointCloud(case.measured[_near(distance)])
        small_gicp.estimate_normals_covariances(kept, num_neighbors=10, num_threads=2)
        pose = align(pose, kept, (_last_reach(case),))
        distance = distances(pose)
    done = time.perf_counter()
    return Result(np.linalg.inv(pose), np.sign(case.radius) * distance, ready - begun, done - begun)


def _near(distance: Array) -> Array:
    """True for distances within six robust standard deviations, for programs without a loss against outliers."""
    middle = np.median(distance)
    near: Array = np.abs(distance - middle) <= 6 * 1.4826 * np.median(np.abs(distance - middle))
    return near


def _last_reach(case: Case) -> float:
    """Twice the largest distance of neighbours among the nominal points, in mm."""
    if case.grid is None:
        return 1.0
    grid = case.nominal.reshape(*case.grid, 3)
    return 2.0 * float(max(np.linalg.norm(grid[0, 1] - grid[0, 0]), np.linalg.norm(grid[1, 0] - grid[0, 0])))


def _pcl_program() -> Path:
    """Program around PCL, compiled once for this user from the source beside this file."""
    source = resources.files("regrind.benchmark").joinpath("pcl.cpp").read_bytes()
    folder = Path.home() / ".cache" / "regrind"
    program = folder / f"pcl-{hashlib.sha256(source).hexdigest()[:16]}"
    if not program.exists():
        folder.mkdir(parents=True, exist_ok=True)
        flags = subprocess.run(
            ["pkg-config", "--cflags", "--libs", "pcl_registration"], check=True, capture_output=True, text=True
        ).stdout.split()
        made = program.with_suffix(f".{os.getpid()}")
        command = ["g++", "-O3", "-march=native", "-x", "c++", "-", "-o", str(made), *flags]
        subprocess.run(command, check=True, input=source)
        made.rename(program)
    return program


def _pcl(case: Case) -> Result:
    from scipy.spatial import KDTree

    program = _pcl_program()
    begun = time.perf_counter()
    points, normals = _offset_cloud(case)
    ready_s = time.perf_counter() - begun
    tree = KDTree(points)

    def align(pose: Array, measured: Array, reaches: tuple[float, ...]) -> tuple[Array, float]:
        # PCL computes with 32 bits: about the middle of each cloud it loses least.
        of_target, of_source = points.mean(0), measured.mean(0)
        start = pose.copy()
        start[:3, 3] += start[:3, :3] @ of_source - of_target
        counts = np.array([len(points), len(measured), len(reaches)], dtype=np.int64)
        numbers = [np.array(reaches), start, points - of_target, normals, measured - of_source]
        given = counts.tobytes() + b"".join(np.ascontiguousarray(part).tobytes() for part in numbers)
        told = np.frombuffer(subprocess.run([program], input=given, check=True, stdout=subprocess.PIPE).stdout)
        found = told[:16].reshape(4, 4).copy()
        found[:3, 3] += of_target - found[:3, :3] @ of_source
        return found, float(told[16])

    def distances(pose: Array) -> Array:
        at = moved(pose, case.measured)
        _, index = tree.query(at)
        along: Array = ((at - points[index]) * normals[index]).sum(1)
        return along

    pose, seconds = align(np.linalg.inv(case.start), case.measured, (*case.reaches, _last_reach(case)))
    distance = distances(pose)
    if not case.inliers.all():
        pose, more = align(pose, case.measured[_near(distance)], (_last_reach(case),))
        seconds, distance = seconds + more, distances(pose)
    # The time of PCL itself, without that of the other process and of the distances.
    return Result(np.linalg.inv(pose), np.sign(case.radius) * distance, ready_s, ready_s + seconds)


def _without_pcl() -> str | None:
    if shutil.which("g++") is None or shutil.which("pkg-config") is None:
        return "g++ and pkg-config are"
    found = subprocess.run(["pkg-config", "--exists", "pcl_registration"])
    return None if found.returncode == 0 else "libpcl-dev is"


CONTENDERS = (
    Contender("Regrind, search", ("regrind",), lambda case: _regrind(case, search=True)),
    Contender("Regrind, from the start", ("regrind",), lambda case: _regrind(case, search=False)),
    Contender("Open3D, point to plane", ("open3d",), _open3d),
    Contender("libigl, point to mesh", ("igl", "scipy"), _libigl),
    Contender("small_gicp, GICP", ("small_gicp",), _small_gicp),
    Contender("PCL, point to plane", ("scipy",), _pcl, _without_pcl),
)
