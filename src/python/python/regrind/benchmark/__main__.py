"""Prints the benchmark: ``python -m regrind.benchmark [--case NAME ...] [--mirror FOLDER] [--markdown] [--json FILE]``.

Each registration runs in a process of its own, so that its memory is measured alone and a fault of one program ends no
other. The columns:

pose   error of the pose in nm: how far the farthest of four corners of the part is from where the exact pose puts it
map    error of the deviations in nm rms, against those of the exact pose, at the points that are no outliers
ready  time in s to make the nominal or the offset surface ready, before the first measured point is seen
time   time in s of everything, median of up to 7 runs
memory peak memory in MB beyond what the process had with its points and programs loaded
used   measured points that have a deviation
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from .cases import Case, free_form_cases, mirror
from .contenders import CONTENDERS, Result
from .surfaces import Array, moved

#: Seconds after which no further run is made for the median, and their greatest number.
ENOUGH_S, MAX_RUNS = 6.0, 7
PACKAGES = {"open3d": "open3d", "igl": "libigl", "small_gicp": "small_gicp", "scipy": "scipy", "numpy": "numpy"}
COLUMNS = (("pose nm", 12), ("map nm", 11), ("ready s", 9), ("time s", 9), ("memory MB", 11), ("used", 9))


def score(case: Case, pose: Array, deviations: Array, truth: tuple[Array, Array]) -> dict[str, float]:
    """Errors of a result in nm against the exact one, and the number of points that it uses."""
    best, exact = truth
    off = np.linalg.norm(moved(pose, case.corners) - moved(best, case.corners), axis=1).max()
    difference = (deviations - exact)[case.inliers]
    known = np.isfinite(difference)
    rms = float(np.sqrt(np.mean(difference[known] ** 2))) if known.any() else float("nan")
    return {"pose_nm": 1e6 * float(off), "map_nm": 1e6 * rms, "used": int(np.isfinite(deviations).sum())}


def peak_mb() -> float:
    """Highest memory of this process since the last call of `forget_peak`, or ever where the system cannot forget."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        pass
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def forget_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        pass


def in_this_process(case_file: Path, label: str) -> None:
    """Registers one case by one contender, and prints the result as JSON."""
    import pickle

    with open(case_file, "rb") as file:
        case, truth = pickle.load(file)
    contender = next(one for one in CONTENDERS if one.label == label)
    for module in contender.modules:
        __import__(module)
    forget_peak()
    before = peak_mb()
    results: list[Result] = []
    while len(results) < MAX_RUNS and sum(one.total_s for one in results) < ENOUGH_S:
        results.append(contender.run(case))
        if len(results) == 1:
            memory = peak_mb() - before
    first = results[0]
    told = score(case, first.cmm_from_model, first.deviations, truth)
    told["ready_s"] = statistics.median(one.ready_s for one in results)
    told["total_s"] = statistics.median(one.total_s for one in results)
    told["memory_mb"] = memory
    told["runs"] = len(results)
    print(json.dumps(told))


def compare(case: Case, chosen: list[str]) -> dict[str, dict[str, Any]]:
    """Registers one case by every contender that is installed; returns the figures by label."""
    import pickle

    rows: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "case.pickle")
        file.write_bytes(pickle.dumps((case, case.exact())))
        for contender in CONTENDERS:
            if contender.missing() is not None or (chosen and not any(word in contender.label for word in chosen)):
                continue
            command = [sys.executable, "-m", "regrind.benchmark", "--child", str(file), "--contender", contender.label]
            done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace")
            lines = done.stdout.strip().splitlines()
            if done.returncode == 0 and lines:
                rows[contender.label] = json.loads(lines[-1])
            else:
                rows[contender.label] = {"failed": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    return rows


def cells(row: dict[str, Any]) -> list[str]:
    def figure(value: float) -> str:
        return f"{value:.4f}" if value < 1 else f"{value:.1f}" if value < 1e4 else f"{value:.3g}"

    return [
        figure(row["pose_nm"]),
        figure(row["map_nm"]),
        f"{row['ready_s']:.3f}",
        f"{row['total_s']:.3f}",
        f"{row['memory_mb']:.0f}",
        str(row["used"]),
    ]


def print_case(name: str, case: Case, rows: dict[str, dict[str, Any]], markdown: bool) -> None:
    nominal = f"{len(case.nominal):,} nominal points" + ("" if case.grid else " without order")
    head = f"{name}: {nominal}, {len(case.measured):,} measured"
    if markdown:
        print(f"| **{head}** | | | | | | |", flush=True)
    else:
        print(f"\n{head}\n{'':30}" + "".join(f"{title:>{width}}" for title, width in COLUMNS), flush=True)
    for label, row in rows.items():
        told = [row["failed"]] if "failed" in row else cells(row)
        if markdown:
            told += [""] * (len(COLUMNS) - len(told))
            print("| " + " | ".join([label, *told]) + " |", flush=True)
        elif "failed" in row:
            print(f"{label:30}failed: {row['failed']}", flush=True)
        else:
            print(f"{label:30}" + "".join(f"{cell:>{width}}" for cell, (_, width) in zip(told, COLUMNS, strict=True)), flush=True)


def machine() -> str:
    versions = []
    for module, package in PACKAGES.items():
        try:
            versions.append(f"{module} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            versions.append(f"{module} is not installed")
    cpu = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), cpu)
    except OSError:
        pass
    return f"{os.cpu_count()} processors, {cpu}; Python {platform.python_version()}; " + ", ".join(versions)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m regrind.benchmark", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    cases = free_form_cases()
    parser.add_argument("--case", action="append", choices=[*cases, "mirror"], help="only this case; may be repeated")
    parser.add_argument("--contender", action="append", default=[], help="only contenders with this word in their label")
    parser.add_argument("--mirror", type=Path, metavar="FOLDER", help="session of a real mirror: docs/benchmark.md")
    parser.add_argument("--markdown", action="store_true", help="print a table for a document")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all figures to this file")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.json and not given.json.absolute().parent.is_dir():
        parser.error(f"--json {given.json}: there is no such folder")
    if given.mirror and not list(given.mirror.glob("*_surface.txt")):
        parser.error(f"--mirror {given.mirror}: there is no file *_surface.txt")
    for word in given.contender:
        if not any(word in contender.label for contender in CONTENDERS):
            parser.error(f"--contender {word}: none of {', '.join(contender.label for contender in CONTENDERS)}")
    if given.child:
        in_this_process(given.child, given.contender[0])
        return
    print(machine())
    for contender in CONTENDERS:
        if (module := contender.missing()) is not None:
            print(f"left out: {contender.label} ({module} not installed)")
    if given.markdown:
        titles = [title for title, _ in COLUMNS]
        print("\n| | " + " | ".join(titles) + " |\n|" + "---|" * (len(titles) + 1))
    told: dict[str, Any] = {"machine": machine(), "cases": {}}
    for name in given.case or [*cases, *(["mirror"] if given.mirror else [])]:
        if name == "mirror":
            if not given.mirror:
                parser.error("--case mirror needs --mirror FOLDER")
            case = mirror(given.mirror)
        else:
            case = cases[name]()
        rows = compare(case, given.contender)
        print_case(name, case, rows, given.markdown)
        told["cases"][name] = rows
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
