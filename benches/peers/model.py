"""The model of the error beside scikit-learn and numpy, on the same points in one run.

    python3 -m venv target/peers-venv
    target/peers-venv/bin/pip install numpy scipy scikit-learn
    cargo build --release --example field
    target/peers-venv/bin/python benches/peers/model.py

Without effects: mean and sigma at 1,000 places from 800 points, parameters fixed, against GaussianProcessRegressor with a Matern
kernel of smoothness 2 (its length scale is half of our range) and a white one. With six effects of which nothing is known, the motions of a part: against
universal kriging written out in numpy with scipy's Bessel function. Ends with 1 where any differs by more than 1e-6 of itself.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy.special import kv
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

ROOT = Path(__file__).resolve().parents[2]
SIGMA, RANGE, SCATTER = 5e-3, 30.0, 3e-4


def ours(points, deviations, effects, asked):
    path = ROOT / "target" / "peers" / "field.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    told = dict(places=points.tolist(), deviations_mm=deviations.tolist(), effects=effects.tolist(), asked=asked.tolist())
    path.write_text(json.dumps(told | dict(sigma_mm=SIGMA, range_mm=RANGE, scatter_mm=SCATTER)))
    said = subprocess.run([ROOT / "target/release/examples/field", path], check=True, capture_output=True).stdout
    return json.loads(said)


def covariance(a, b):
    x = 4.0 / RANGE * np.linalg.norm(a[:, None] - b[None], axis=2)
    with np.errstate(invalid="ignore"):
        return SIGMA**2 * np.where(x > 0, 0.5 * x * x * kv(2, x), 1.0)


def kriging(points, deviations, effects, asked):
    k = covariance(points, points) + SCATTER**2 * np.eye(len(points))
    across = covariance(points, asked)
    solved = np.linalg.solve(k, np.column_stack([effects, deviations, across]))
    p = effects.shape[1]
    gram = effects.T @ solved[:, :p]
    found = np.linalg.solve(gram, effects.T @ solved[:, p])
    mean = across.T @ (solved[:, p] - solved[:, :p] @ found)
    # Of the field alone: what it has in common with the effects is in its uncertainty.
    moved = across.T @ solved[:, :p]
    variance = SIGMA**2 - np.sum(across * solved[:, p + 1 :], axis=0) + np.sum(moved * np.linalg.solve(gram, moved.T).T, axis=1)
    return mean, np.sqrt(variance), found


def main():
    rng = np.random.default_rng(7)
    points = rng.uniform([-51, -31], [51, 31], (800, 2))
    asked = rng.uniform([-51, -31], [51, 31], (1000, 2))
    x, y = points.T
    deviations = 5e-3 * np.sin(0.08 * x) * np.cos(0.11 * y) + SCATTER * rng.standard_normal(len(points))
    worst = 0.0

    def compare(what, a, b, seconds, ms):
        nonlocal worst
        off = [np.max(np.abs(np.asarray(p) - q)) / np.max(np.abs(q)) for p, q in zip(a, b)]
        worst = max(worst, *off)
        print(f"{what}: mean off by {off[0]:.1e}, sigma by {off[1]:.1e} of the largest; {1e3 * seconds:.0f} ms, ours {ms:.0f} ms")

    kernel = ConstantKernel(SIGMA**2, "fixed") * Matern(RANGE / 2, "fixed", nu=2.0)
    began = time.perf_counter()
    process = GaussianProcessRegressor(kernel, alpha=SCATTER**2, optimizer=None).fit(points, deviations)
    mean, sigma = process.predict(asked, return_std=True)
    seconds = time.perf_counter() - began
    said = ours(points, deviations, np.zeros((0, 0)), asked)
    compare("scikit-learn, no effects", (said["mean_mm"], said["sigma_mm"]), (mean, sigma), seconds, said["ms"])

    arm = np.column_stack([x, y, 0.004 * x * x]) / 50
    normal = np.column_stack([-0.008 * x, 0.006 * y, np.ones(len(x))])
    effects = np.column_stack([normal, np.cross(arm, normal)])
    moved = deviations + effects @ np.array([0.1, -0.2, 0.5, 1e-3, -2e-3, 3e-3])
    began = time.perf_counter()
    mean, sigma, found = kriging(points, moved, effects, asked)
    seconds = time.perf_counter() - began
    said = ours(points, moved, effects, asked)
    compare("numpy, with the motions", (said["mean_mm"], said["sigma_mm"]), (mean, sigma), seconds, said["ms"])
    off = np.max(np.abs(np.array(said["effects"]) - found)) / np.max(np.abs(found))
    print(f"the motions: off by {off:.1e} of the largest")
    return 0 if max(worst, off) < 1e-6 else 1


if __name__ == "__main__":
    sys.exit(main())
