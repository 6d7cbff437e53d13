"""The program: a part in simulation, its record, and refusals. Left out where the program is not installed."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import regrind
from conftest import PROBE_RADIUS, turned
from regrind import _program

RECIPE = Path(__file__).parent / "dome.toml"


@pytest.fixture(scope="module")
def program():
    try:
        return _program._program()
    except regrind.ProgramError as refused:
        pytest.skip(str(refused))


def test_simulated_part_has_a_sound_record(program, tmp_path):
    run = regrind.simulate(RECIPE, 3, runs=tmp_path / "runs")
    assert run.folder.parent == tmp_path / "runs" and run.folder.name.endswith("-SIMULATION")
    assert run.accepted == (run.ending == "accepted") and run.reason
    assert [cycle.cycle for cycle in run.cycles] == list(range(1, len(run.cycles) + 1))
    for cycle in run.cycles:
        measured = regrind.read(cycle.folder / "measured.csv")
        assert len(measured) == cycle.points and 0 < cycle.judged_rms < cycle.judged_pv
    told = regrind.verify(run.folder)
    assert told.sound and told.closed and told.records > 20 and told.reason == ""
    # The same seed is the same part.
    again = regrind.simulate(RECIPE, 3, runs=tmp_path / "again")
    assert [cycle.pv for cycle in again.cycles] == [cycle.pv for cycle in run.cycles]
    recipe = run.folder / "recipe.toml"
    recipe.write_text(recipe.read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    told = regrind.verify(run.folder)
    assert not told.sound and "recipe.toml" in told.reason


@pytest.mark.parametrize("method", ["offset", "contact", "subtract-radius"])
def test_command_line_gives_the_same_bits(program, tmp_path, nominal, centres, method):
    measured, _ = turned(centres, 0.3, (10.0, -20.0, 5.0))
    regrind.write(tmp_path / "nominal.csv", nominal.points)
    regrind.write(tmp_path / "measured.csv", measured)
    files = ["--nominal", "nominal.csv", "--measured", "measured.csv", "--out", "out", "--max-rms", "10"]
    command = [program, "register", *files, "--probe-radius", str(PROBE_RADIUS), "--method", method]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    told = json.loads((tmp_path / "out/registration.json").read_text(encoding="utf-8"))
    rows = np.loadtxt(tmp_path / "out/deviations.csv", delimiter=",", skiprows=1)
    again = regrind.Nominal.from_file(tmp_path / "nominal.csv")
    found = regrind.register(
        again, regrind.read(tmp_path / "measured.csv"), probe_radius=PROBE_RADIUS, method=method, max_rms=10.0
    )
    assert (found.pose == np.array(told["cmm_from_model"])).all()
    assert (found.covariance == np.array(told["covariance"])).all()
    assert (found.deviations == rows[:, 6]).all() and (found.points == rows[:, :3]).all()
    assert (found.used == (rows[:, 7] == 1)).all() and found.rms == told["rms_mm"]


@pytest.mark.parametrize("seed", [-1, 2**64, 1.5, "1", True])
def test_other_seeds_are_refused(seed):
    with pytest.raises(regrind.DataError, match="seed"):
        regrind.simulate(RECIPE, seed)


@pytest.mark.parametrize("content", ["", "[part]\n", "part = 3", "\x00"])
def test_recipes_with_problems_are_refused(program, tmp_path, content):
    recipe = tmp_path / "part.toml"
    recipe.write_text(content, encoding="utf-8")
    with pytest.raises(regrind.DataError, match="part.toml"):
        regrind.simulate(recipe, runs=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("path", ["nowhere", "", "nul\0"])
def test_runs_that_are_none_are_refused(program, tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(regrind.DataError):
        regrind.verify(path)


def test_program_of_another_version_is_not_used(monkeypatch, tmp_path):
    other = tmp_path / "regrind"
    other.write_text("#!/bin/sh\necho regrind 0.0.1\n", encoding="utf-8")
    other.chmod(0o755)
    monkeypatch.setattr(_program, "_found", None)
    monkeypatch.setattr(_program.sysconfig, "get_path", lambda _: str(tmp_path))
    monkeypatch.setattr(_program.sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(_program.shutil, "which", lambda _: None)
    with pytest.raises(regrind.ProgramError, match="0.0.1"):
        regrind.verify(tmp_path)
    other.unlink()
    with pytest.raises(regrind.ProgramError, match="is not there"):
        regrind.verify(tmp_path)
    monkeypatch.setattr(_program.shutil, "which", lambda _: "/nowhere/regrind")
    with pytest.raises(regrind.ProgramError, match="nowhere"):
        regrind.verify(tmp_path)


def test_command_is_installed_with_the_package(program):
    said = subprocess.run([program, "--version"], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["regrind", regrind.__version__]
