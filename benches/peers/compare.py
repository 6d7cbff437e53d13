"""Regrind beside its peers, on the same files in one run.

    python3 -m venv target/peers-venv
    target/peers-venv/bin/pip install -r benches/peers/requirements.txt
    cargo build --release --bin regrind --bench in_process
    target/peers-venv/bin/python benches/peers/compare.py

What is compared. A free form of 451,401 nominal points on a grid, and probe centres on its ground surface (6.657 um PV form
error, 0.2 um noise), made here in closed form with numpy and written to target/peers/. The measure of every error is the
exact least-squares pose: Gauss-Newton with the Newton foot on the closed form, which no one but this script knows. It is not
the placement, because the form error alone moves the best fit.

What is timed. "time" is without reading files for everybody: making the nominal or offset surface ready, which "ready" tells
alone, and registering. Regrind must find the grid itself; the peers are told it, and take their normals from differences along
it, which is faster than to estimate them. "process" is the whole `regrind register`, with the files read and the results
written to the disk. "pose" is the farthest corner of the part from where the exact pose puts it; "map" is the rms of the
deviations less the exact ones; "x" is a peer's figure over that of regrind from the identity.

A peer that is not installed is left out, and said to be. `--quick` leaves the largest cloud out.
"""

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
RADIUS = 1.5
COLUMNS, ROWS = 901, 501
RIPPLES = ((0.042, 0.016, 0.4, 7.0), (-0.018, 0.062, 1.1, 3.5), (0.070, -0.035, 2.3, 0.5))
NEAR = ((0.05, 0.02, -0.03), (0.01, 0.02, 0.03))
FAR = ((20.0, 10.0, 20.0), (20.0, 20.0, 10.0))
MOST_TURNS = 1000


# The part, in closed form.


def height(x, y):
    z = x * x / 420 - y * y / 310 + 6e-6 * x**3 - 1.1e-5 * x * x * y
    return z + sum(a * np.sin(kx * x + ky * y + c) for kx, ky, c, a in RIPPLES)


def gradient(x, y):
    p = x / 210 + 1.8e-5 * x * x - 2.2e-5 * x * y
    q = -y / 155 - 1.1e-5 * x * x
    for kx, ky, c, a in RIPPLES:
        w = a * np.cos(kx * x + ky * y + c)
        p, q = p + kx * w, q + ky * w
    return p, q


def hessian(x, y):
    xx = 1 / 210 + 3.6e-5 * x - 2.2e-5 * y
    xy = -2.2e-5 * x
    yy = np.full_like(x, -1 / 155)
    for kx, ky, c, a in RIPPLES:
        w = -a * np.sin(kx * x + ky * y + c)
        xx, xy, yy = xx + kx * kx * w, xy + kx * ky * w, yy + ky * ky * w
    return xx, xy, yy


def normal(x, y):
    p, q = gradient(x, y)
    return np.stack([-p, -q, np.ones_like(p)], -1) / np.sqrt(1 + p * p + q * q)[:, None]


def lattice(columns, rows, width, depth):
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, columns), np.linspace(-depth / 2, depth / 2, rows))
    return x.ravel(), y.ravel()


def form_error(rng):
    """A smooth random surface error of 6.657 um PV, as a function of (x, y)."""
    k = rng.normal(0, np.sqrt(2) / 30, (96, 2))
    c = rng.uniform(0, 2 * np.pi, 96)

    def raw(x, y):
        return sum(np.cos(k[i, 0] * x + k[i, 1] * y + c[i]) for i in range(96))

    values = raw(*lattice(101, 101, 102, 62))
    scale = 6.657e-3 / (values.max() - values.min())
    return lambda x, y: scale * raw(x, y)


def centres(form, columns, rows):
    """Probe centres on S + e n, with the ground surface's own normal from central differences; model frame."""
    # A millimetre inside the edge, where the ball touches the part wherever it leans.
    x, y = lattice(columns, rows, 100, 60)
    h = 1e-3

    def ground(x, y):
        return np.stack([x, y, height(x, y)], -1) + form(x, y)[:, None] * normal(x, y)

    along = [(ground(x + dx, y + dy) - ground(x - dx, y - dy)) / (2 * h) for dx, dy in ((h, 0), (0, h))]
    m = np.cross(*along)
    return ground(x, y) + RADIUS * m / np.linalg.norm(m, axis=1)[:, None]


def placement(translation, degrees):
    """Turns about x, then y, then z, then shifts."""
    (sx, cx), (sy, cy), (sz, cz) = ((np.sin(a), np.cos(a)) for a in np.radians(degrees))
    turn = np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )
    return pose_of(turn, translation)


# Poses, as 4 x 4 matrices.


def pose_of(turn, shift):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    return pose


def moved(pose, points):
    return points @ pose[:3, :3].T + pose[:3, 3]


def step_pose(v, w, about):
    """The small motion that turns by the vector w about a point and shifts by v."""
    angle = np.linalg.norm(w)
    k = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    a, b = (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2) if angle > 1e-12 else (1.0, 0.5)
    turn = np.eye(3) + a * k + b * k @ k
    return pose_of(turn, about - turn @ about + v)


def gauss_newton(model_from_cmm, measured, nearest, still=1e-12):
    """Moves the points onto a surface, given distances and normals at a pose, until the step is still.

    Returns the pose, the distances at it, and the number of turns.
    """
    best = np.inf
    for turn in range(1, MOST_TURNS + 1):
        points = moved(model_from_cmm, measured)
        distance, n = nearest(points)
        about = points.mean(0)
        size = np.sqrt(((points - about) ** 2).sum(1).mean())
        rows = np.hstack([n, np.cross((points - about) / size, n)])
        m = np.linalg.solve(rows.T @ rows, -rows.T @ distance)
        objective = distance @ distance
        # Flat triangles can make the steps cycle for ever; nothing is gained from there on.
        if np.linalg.norm(m) < still * size or (np.linalg.norm(m) < 1e-4 and objective >= best * (1 - still)):
            return model_from_cmm, distance, turn
        best = min(best, objective)
        model_from_cmm = step_pose(m[:3], m[3:] / size, about) @ model_from_cmm
    return model_from_cmm, distance, MOST_TURNS


def exact(measured, cmm_from_model):
    """The least-squares pose on the closed form, and the deviation of every point there."""
    place = {}

    def nearest(points):
        x, y = place.get("xy", (points[:, 0].copy(), points[:, 1].copy()))
        for _ in range(30):
            (p, q), (xx, xy, yy) = gradient(x, y), hessian(x, y)
            dx, dy, dz = points[:, 0] - x, points[:, 1] - y, points[:, 2] - height(x, y)
            fx, fy = dx + dz * p, dy + dz * q
            a, b, c = 1 + p * p - dz * xx, p * q - dz * xy, 1 + q * q - dz * yy
            det = a * c - b * b
            sx, sy = (c * fx - b * fy) / det, (a * fy - b * fx) / det
            x, y = x + sx, y + sy
            if max(abs(sx).max(), abs(sy).max()) < 1e-11:
                break
        place["xy"] = x, y
        n = normal(x, y)
        return ((points - np.stack([x, y, height(x, y)], -1)) * n).sum(1) - RADIUS, n

    pose, deviation, _ = gauss_newton(np.linalg.inv(cmm_from_model), measured, nearest)
    return np.linalg.inv(pose), deviation


# The contenders. Each returns cmm_from_model, the deviations, seconds to prepare, seconds in all, and turns.


def offset_cloud(nominal):
    """Offset points and normals from differences along the grid that the peers are told."""
    grid = nominal.reshape(ROWS, COLUMNS, 3)
    along_y, along_x = np.gradient(grid, axis=(0, 1), edge_order=2)
    n = np.cross(along_x, along_y).reshape(-1, 3)
    n /= np.linalg.norm(n, axis=1)[:, None]
    return nominal + RADIUS * n, n


def by_open3d(nominal, measured, reach_mm, tolerance):
    import open3d as o3d

    begun = time.perf_counter()
    points, normals = offset_cloud(nominal)
    target, source = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
    target.points, target.normals = o3d.utility.Vector3dVector(points), o3d.utility.Vector3dVector(normals)
    source.points = o3d.utility.Vector3dVector(measured)
    prepared = time.perf_counter()
    reg = o3d.pipelines.registration
    found = reg.registration_icp(
        source,
        target,
        reach_mm,
        np.eye(4),
        reg.TransformationEstimationPointToPlane(),
        reg.ICPConvergenceCriteria(tolerance, tolerance, MOST_TURNS),
    )
    done = time.perf_counter()
    pair = np.asarray(found.correspondence_set)
    deviation = np.full(len(measured), np.nan)
    at = moved(found.transformation, measured[pair[:, 0]]) - points[pair[:, 1]]
    deviation[pair[:, 0]] = (at * normals[pair[:, 1]]).sum(1)
    return np.linalg.inv(found.transformation), deviation, prepared - begun, done - begun, None


def by_igl(nominal, measured):
    import igl

    begun = time.perf_counter()
    points, _ = offset_cloud(nominal)
    first = (np.arange(ROWS - 1)[:, None] * COLUMNS + np.arange(COLUMNS - 1)).ravel()
    lower = np.stack([first, first + 1, first + COLUMNS + 1], -1)
    upper = np.stack([first, first + COLUMNS + 1, first + COLUMNS], -1)
    faces = np.vstack([lower, upper])
    n = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    n /= np.linalg.norm(n, axis=1)[:, None]
    tree = igl.AABB()
    tree.init(points, faces)
    prepared = time.perf_counter()

    def nearest(at):
        _, face, foot = tree.squared_distance(points, faces, np.ascontiguousarray(at))
        face = np.asarray(face).ravel()
        return ((at - foot) * n[face]).sum(1), n[face]

    pose, deviation, turns = gauss_newton(np.eye(4), measured, nearest, 1e-9)
    done = time.perf_counter()
    return np.linalg.inv(pose), deviation, prepared - begun, done - begun, turns


def by_regrind(tools, nominal_file, measured_file, start, repeats):
    register, clock = tools
    whole = []
    with tempfile.TemporaryDirectory() as folder:
        out, identity = Path(folder, "out"), Path(folder, "identity.txt")
        np.savetxt(identity, np.eye(4))
        command = [register, "register", "--nominal", nominal_file, "--measured", measured_file]
        command += ["--probe-radius", str(RADIUS), "--out", out]
        command += ["--initial", identity] if start == "identity" else []
        for _ in range(repeats):
            begun = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            whole.append(time.perf_counter() - begun)
        pose = np.array(json.loads(Path(out, "registration.json").read_text())["cmm_from_model"])
        rows = np.loadtxt(Path(out, "deviations.csv"), delimiter=",", skiprows=1)
    deviation = np.where(rows[:, 7] > 0, rows[:, 6], np.nan)
    arguments = [clock, nominal_file, measured_file, str(RADIUS), start, str(repeats)]
    times = json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)
    result = pose, deviation, times["prepare_s"], times["total_s"], times["iterations"]
    return result, float(np.median(whole))


# The table.


def executables():
    """The release program and the clock, built if they are not."""
    names = ["regrind", "in_process"]
    command = ["cargo", "build", "--release", "--bin", names[0], "--bench", names[1], "--message-format=json"]
    lines = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    built = {m["target"]["name"]: m["executable"] for m in map(json.loads, lines) if m.get("executable")}
    return [built[name] for name in names]


def make_files(folder, quick):
    """Writes the clouds; returns the nominal points and, by case, the measured ones and their placement."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(1)
    form = form_error(rng)
    x, y = lattice(COLUMNS, ROWS, 102, 62)
    nominal = np.stack([x, y, height(x, y)], -1)
    save(folder / "nominal.csv", nominal)
    cases = {}
    for name, size, place in (("near", (226, 126), NEAR), ("far", (226, 126), FAR), ("dense", (COLUMNS, ROWS), FAR)):
        if name == "dense" and quick:
            continue
        place = placement(*place)
        points = moved(place, centres(form, *size))
        points += rng.normal(0, 2e-4, points.shape)
        save(folder / f"{name}.csv", points)
        cases[name] = points, place
    return nominal, cases


def save(path, points):
    np.savetxt(path, points, fmt="%.17g", delimiter=",", header="x_mm,y_mm,z_mm", comments="")


def score(result, truth):
    """Error of the pose in nm, the farthest of the part's corners; of the map in nm rms."""
    (pose, deviation, *_), (best, exact_deviation) = result, truth
    x, y = np.array([-50.0, 50, -50, 50]), np.array([-30.0, -30, 30, 30])
    corners = np.stack([x, y, height(x, y)], -1)
    off = np.linalg.norm(moved(pose, corners) - moved(best, corners), axis=1).max()
    return off * 1e6, np.sqrt(np.nanmean((deviation - exact_deviation) ** 2)) * 1e6, int(np.isfinite(deviation).sum())


def contenders(case, nominal, measured, missing):
    reach = 2.0 if case == "near" else 100.0
    if "open3d" not in missing:
        # A dense cloud at the fine tolerance is minutes of waiting and tells nothing new.
        for tolerance in (1e-6, 1e-12)[: 1 if case == "dense" else 2]:
            yield f"Open3D point-to-plane, {tolerance:g}", lambda: by_open3d(nominal, measured, reach, tolerance)
    if "igl" not in missing:
        yield "libigl point-to-mesh", lambda: by_igl(nominal, measured)


def print_row(label, result, errors, whole, against):
    pose_nm, map_nm, used = errors
    ready, total, turns = result[2], result[3], result[4] or "-"
    process = f"{whole:9.3f}" if whole else " " * 9
    ratios = ""
    if against:
        ratios = f"{total / against[0]:8.1f}{pose_nm / against[1]:10.0f}{map_nm / against[2]:9.0f}"
    print(f"  {label:32}{ready:9.3f}{total:9.3f}{process}{pose_nm:11.4f}{map_nm:10.4f}{used:9d}{turns:>6}{ratios}", flush=True)


def compare(case, folder, nominal, measured, truth, tools, missing):
    repeats = 3 if case == "dense" else 7
    print(f"\n{case}: {len(measured):,} measured points")
    head = (
        f"{'':32}{'ready s':>9}{'time s':>9}{'process':>9}{'pose nm':>11}{'map nm':>10}{'points':>9}{'turns':>6}"
        "  x time    x pose    x map"
    )
    print(f"  {head}")
    files = folder / "nominal.csv", folder / f"{case}.csv"
    result, whole = by_regrind(tools, *files, "identity", repeats)
    errors = score(result, truth)
    against = result[3], errors[0], errors[1]
    print_row("regrind, from the identity", result, errors, whole, None)
    result, whole = by_regrind(tools, *files, "search", repeats)
    print_row("regrind, search", result, score(result, truth), whole, against)
    for label, run in contenders(case, nominal, measured, missing):
        # One run of some seconds is long enough for the noise; of shorter ones the median of three is taken.
        results = [run()]
        while results[0][3] < 3.0 and len(results) < 3:
            results.append(run())
        result = sorted(results, key=lambda r: r[3])[len(results) // 2]
        print_row(label, result, score(result, truth), None, against)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="leave the largest cloud out")
    quick = parser.parse_args().quick
    missing = set()
    for module, package in (("open3d", "open3d"), ("igl", "libigl")):
        try:
            __import__(module)
        except ImportError as error:
            missing.add(module)
            print(f"{package} is left out: it cannot be imported ({error})")
    tools = executables()
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    folder = target / "peers"
    nominal, cases = make_files(folder, quick)
    print(f"nominal: {len(nominal):,} points; times without reading files, errors against the exact least squares")
    for case, (measured, place) in cases.items():
        compare(case, folder, nominal, measured, exact(measured, place), tools, missing)


if __name__ == "__main__":
    main()
