"""Times a registration from Python beside the same call from Rust, in turns.

    python time_of_call.py FOLDER [PAIRS]

FOLDER has the program `in_process` (cargo build --release --bench in_process leaves it in target/release/deps). 28,476
points, 451,401 nominal points, from the identity. Three rounds; fails if the median of the ratios is above 1.1 in all.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import regrind
from regrind.benchmark.cases import PROBE_RADIUS, Case, free_form_cases

PAIRS = int(sys.argv[2]) if len(sys.argv) > 2 else 20


def newest(folder: Path) -> Path:
    found = [path for path in (folder / "deps").glob("in_process-*") if path.suffix == ""]
    return max(found, key=lambda path: path.stat().st_mtime)


def ratio_of_round(clock: "subprocess.Popen[str]", case: Case) -> float:
    assert clock.stdin is not None and clock.stdout is not None
    rows = []
    # The first two pairs warm caches and threads up.
    for _ in range(2 + PAIRS):
        clock.stdin.write("\n")
        rust = [float(word) for word in clock.stdout.readline().split()]
        begun = time.perf_counter()
        nominal = regrind.Nominal.from_points(case.nominal)
        of_nominal_s = time.perf_counter() - begun
        # As in Rust, the second call finds its data in the caches.
        regrind.register(nominal, case.measured, probe_radius=PROBE_RADIUS, initial=np.eye(4))
        begun = time.perf_counter()
        found = regrind.register(nominal, case.measured, probe_radius=PROBE_RADIUS, initial=np.eye(4))
        deviations = found.deviations
        rows.append((rust[0], of_nominal_s, rust[1], time.perf_counter() - begun))
        # Rust frees its results outside of the times too.
        del found, nominal, deviations
    rows = rows[2:]
    of_nominal, of_register = (statistics.median(row[k + 1] / row[k] for row in rows) for k in (0, 2))
    medians = [1e3 * statistics.median(row[k] for row in rows) for k in range(4)]
    print(f"median of {PAIRS} pairs, {len(case.measured):,} points:")
    print(f"  nominal surface  Rust {medians[0]:.2f} ms, Python {medians[1]:.2f} ms, ratio {of_nominal:.3f}")
    print(f"  registration     Rust {medians[2]:.2f} ms, Python {medians[3]:.2f} ms, ratio {of_register:.3f}")
    return of_register


case = free_form_cases()["grid"]()
with tempfile.TemporaryDirectory() as folder:
    files = [Path(folder, name) for name in ("nominal.csv", "measured.csv")]
    for path, points in zip(files, (case.nominal, case.measured), strict=True):
        regrind.write(path, points)
    command = [newest(Path(sys.argv[1])), *files, str(PROBE_RADIUS)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1) as clock:
        best = min(ratio_of_round(clock, case) for _ in range(3))
        assert clock.stdin is not None
        clock.stdin.close()
sys.exit(0 if best <= 1.1 else 1)
