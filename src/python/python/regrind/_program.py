"""The program ``regrind``: a cell in simulation, and the verifier of its record.

The package of a platform has the program beside the interpreter. It runs as another process, so a call holds no lock of
the interpreter, and Ctrl-C stops it.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ._errors import DataError, ProgramError
from ._regrind import __version__

StrPath = str | os.PathLike[str]


@dataclass(frozen=True)
class Cycle:
    """One cycle of a run: a pass, its measurement and its verdict."""

    #: Number of the cycle, from 1.
    cycle: int
    #: Peak to valley and root mean square of the deviations, in mm.
    pv: float
    rms: float
    #: The figures that are judged: of the form, without the noise of the probe, in mm.
    judged_pv: float
    judged_rms: float
    #: Number of measured points, and number of outliers among them.
    points: int
    outliers: int
    #: Folder with the files of this cycle.
    folder: Path


@dataclass(frozen=True)
class Run:
    """A run that has ended."""

    #: Folder of the run, with its record.
    folder: Path
    #: True if the part was accepted.
    accepted: bool
    #: How the run ended, such as "accepted", and why.
    ending: str
    reason: str
    cycles: tuple[Cycle, ...]


@dataclass(frozen=True)
class Verification:
    """Result of the verification of a record."""

    #: True if every record, every file and the end are as they were written.
    sound: bool
    #: True if the record is sound and the run has ended.
    closed: bool
    #: Number of records, and how many of them are under a signature. 0 if the record is broken.
    records: int
    signed: int
    #: What is broken, in words; empty if the record is sound.
    reason: str


def simulate(recipe: StrPath, seed: int | None = None, *, runs: StrPath = "runs") -> Run:
    """Runs a recipe in a simulated cell until the part is accepted or the loop must stop.

    Machines, part and wires are simulated, as by ``regrind run``. ``seed`` selects another part and other errors of the
    machines; without it, the seed of the recipe is used. The run gets a folder of its own in the folder ``runs``.

    Raises DataError for a recipe with problems, and ProgramError if the run ends with a fault.
    """
    given = [] if seed is None else ["--seed", str(_whole("seed", seed))]
    options = ["--runs", _path("runs", runs), *given, "--json"]
    status, lines, errors = _call(["run", *options, "--", _path("recipe", recipe)])
    if status == 2:
        raise DataError(errors)
    notices = [json.loads(line) for line in lines.splitlines()]
    folders = [Path(notice["folder"]) for notice in notices if notice["notice"] == "record"]
    if status not in (0, 1) or not folders:
        raise ProgramError(errors or f"regrind run ended with the exit code {status}")
    return _read_run(folders[0].resolve())


def _read_run(folder: Path) -> Run:
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    ending: dict[str, Any] = result["ending"]

    def cycle(row: dict[str, Any]) -> Cycle:
        names = ("pv_um", "rms_um", "judged_pv_um", "judged_rms_um")
        pv, rms, judged_pv, judged_rms = (1e-3 * float(row[name]) for name in names)
        within = folder / f"cycle-{row['cycle']}"
        return Cycle(row["cycle"], pv, rms, judged_pv, judged_rms, row["points"], row["outliers"], within)

    accepted = ending["ending"] == "accepted"
    cycles = tuple(cycle(row) for row in result["cycles"])
    return Run(folder, accepted, ending["ending"], ending.get("reason", ""), cycles)


def verify(run: StrPath | Run) -> Verification:
    """Verifies the record of a run, or of its folder: each record, their order, the end, and each file by its hash.

    Raises DataError if there is no record in this folder.
    """
    folder = _path("run", run.folder if isinstance(run, Run) else run)
    status, text, errors = _call(["audit", "verify", "--json", "--", folder])
    if status == 4:
        raise DataError(errors or f"{folder}: the run is still under way; verify it when it has ended")
    if status not in (0, 1) or not text.strip():
        raise DataError(errors or f"{folder}: regrind audit verify ended with the exit code {status}")
    told = json.loads(text)
    sound = bool(told["sound"]) and status == 0
    reason = "" if sound else str(told.get("what", errors))
    return Verification(sound, bool(told.get("closed", False)), int(told.get("records", 0)), int(told.get("signed", 0)), reason)


def _whole(name: str, value: int) -> int:
    if isinstance(value, bool) or not hasattr(value, "__index__") or not 0 <= value < 2**64:
        raise DataError(f"{name} is {value!r}; it must be a whole number, 0 to 2**64 - 1")
    return value.__index__()


def _path(name: str, path: StrPath) -> str:
    try:
        text = os.fsdecode(path)
    except TypeError:
        raise DataError(f"{name} is {path!r}; it must be a path") from None
    if not text or "\0" in text:
        raise DataError(f"{name} is {text!r}; it must be a path without NUL characters")
    return text


def _call(arguments: Sequence[str]) -> tuple[int, str, str]:
    """Calls the program; returns its exit code, its output and its error messages."""
    command = [str(_program()), *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8", errors="replace"
    ) as process:
        try:
            output, errors = process.communicate()
        except BaseException:
            # Ctrl-C has reached the program too, which brings its machines to their safe places.
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(60)
            raise
    return process.returncode, output, errors.strip()


_found: Path | None = None


def _program() -> Path:
    """Path of the program with the version of this package: beside the interpreter, or in the search path."""
    global _found
    if _found is not None:
        return _found
    name = "regrind" + (sysconfig.get_config_var("EXE") or "")
    beside = [Path(sysconfig.get_path("scripts")) / name, Path(sys.executable).parent / name]
    elsewhere = shutil.which("regrind")
    candidates = [path for path in beside if path.is_file()] + ([Path(elsewhere)] if elsewhere else [])
    others = []
    for path in candidates:
        try:
            said = subprocess.run([path, "--version"], capture_output=True, encoding="utf-8", check=True, timeout=60).stdout
        except (OSError, subprocess.SubprocessError, UnicodeDecodeError) as error:
            others.append(f"{path}: {error}")
            continue
        if said.split()[-1:] == [__version__]:
            _found = path
            return path
        others.append(f"{path}: {said.strip() or 'no version'}")
    found = "; found: " + "; ".join(others) if others else ""
    raise ProgramError(
        f"the program regrind {__version__} is not there{found}; install the wheel of this platform, or a package of Regrind"
    )
