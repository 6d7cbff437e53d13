"""Edges of the package: budgets over several passes, masked arrays, locks, other coordinates, interrupts, odd arguments."""

import copy
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import regrind
from conftest import PROBE_RADIUS
from test_path import LIMITS, PLACES, map_of


def test_removal_counts_from_the_first_pass_though_allowance_is_not_repeated():
    zero = map_of(np.zeros(len(PLACES)))
    limits = {"depth_of_cut": 0.02, "max_correction": 0.05, "removal_budget": 0.07}
    first = regrind.compensate(zero, allowance=0.1, **limits)
    second = regrind.compensate(zero, previous=first, **limits)
    third = regrind.compensate(zero, previous=second, allowance=0.1, **limits)
    assert [first.removed, second.removed, third.removed] == pytest.approx([0.02, 0.04, 0.06])
    with pytest.raises(regrind.DataError, match="budget"):
        regrind.compensate(zero, previous=third, **limits)
    with pytest.raises(regrind.DataError, match="allowance"):
        regrind.compensate(zero, previous=third, allowance=0.0, **limits)


@pytest.mark.parametrize("shift", [[1000.0, 0.0], [0.0, 100.0], [9.0, 0.0]])
def test_maps_in_other_coordinates_are_refused(shift):
    other = regrind.error_map(PLACES + shift, np.full(len(PLACES), -1e-3), cutoff=5.0, spacing=1.0)
    here = regrind.compensate(map_of(np.zeros(len(PLACES))), **LIMITS)
    with pytest.raises(regrind.DataError, match="coordinates of the model"):
        regrind.compensate(other, previous=here, **LIMITS)
    plane = regrind.Nominal.from_function(lambda x, y: 0.0 * x, np.arange(-20.0, 21.0), np.arange(-10.0, 11.0))
    away = regrind.compensate(other, **LIMITS)
    with pytest.raises(regrind.DataError, match="coordinates of the model"):
        regrind.toolpath(plane, away, wheel_radius=5.0, track=1.0, feed=600.0)


def test_masked_values_are_no_values(nominal, centres):
    heights = np.ma.masked_array(np.zeros((20, 20)), mask=False)
    heights[10, 10] = -9999.0
    heights[10, 10] = np.ma.masked
    assert regrind.gaussian(heights, spacing=1.0, cutoff=5.0)[10, 10] == pytest.approx(0.0, abs=1e-12)
    masked = np.ma.masked_array(centres, mask=False)
    masked[7] = np.ma.masked
    with pytest.raises(regrind.DataError, match="row 7"):
        regrind.register(nominal, masked, probe_radius=PROBE_RADIUS)


@pytest.mark.parametrize("lock", ["x", ["x", "y"], "z", "x, y, z", "rx", "rz"])
def test_locked_coordinates_have_no_variance(nominal, centres, lock):
    rng = np.random.default_rng(1)
    measured = centres + rng.normal(0.0, 2e-4, centres.shape)
    found = regrind.register(nominal, measured, probe_radius=PROBE_RADIUS, lock=lock, initial=np.eye(4), side="above")
    names = lock if isinstance(lock, list) else [name.strip() for name in lock.split(",")]
    for k, name in enumerate(["x", "y", "z", "rx", "ry", "rz"]):
        is_zero = not found.covariance[k].any() and not found.covariance[:, k].any()
        assert is_zero == (name in names), name
    assert (np.diag(found.covariance) >= 0).all()


def test_unknown_nodes_have_no_uncertainty():
    far = (np.abs(PLACES[:, 0]) > 8) | (np.abs(PLACES[:, 1]) > 5)
    error = regrind.error_map(PLACES[far], 1e-4 * PLACES[far, 0], cutoff=3.0, spacing=1.0)
    assert np.isnan(error.values).any()
    assert (np.isnan(error.values) == np.isnan(error.uncertainty)).all()


def test_results_can_be_copied(nominal, centres):
    found = regrind.register(nominal, centres, probe_radius=PROBE_RADIUS)
    assert copy.copy(found) is found and copy.deepcopy([found])[0] is found
    assert copy.deepcopy(nominal) is nominal


@pytest.mark.parametrize(
    "call",
    [
        lambda n, c: regrind.register(n, c, probe_radius=0, method="rubbish"),
        lambda n, c: regrind.register(n, c, probe_radius=1.5, lock=[1, 2]),
        lambda n, c: regrind.register(n, c, probe_radius=1.5, lock=3),
        lambda n, c: regrind.zernike_fit(c, c[:, 2], radius=50.0, terms=-1),
        lambda n, c: regrind.zernike_fit(c, c[:, 2], radius=50.0, centre=(1, 2, 3)),
        lambda n, c: regrind.iso10110(c, c[:, 2], centre=(np.nan, 2)),
        lambda n, c: regrind.iso10110(c, c[:, 2], centre=(1, 2)),
        lambda n, c: regrind.iso10110(c, c[:, 2], wavelength=632.8),
        lambda n, c: regrind.gaussian(c, spacing=(1, 2, 3), cutoff=5.0),
        lambda n, c: regrind.gaussian(c, spacing=1.0, cutoff=5.0, order=-1),
        lambda n, c: regrind.gaussian(c, spacing=1.0, cutoff=1e300),
        lambda n, c: regrind.error_map(c, c[:, 2], cutoff=1e300),
        lambda n, c: regrind.error_map(c, c[:, 2] > 0, cutoff=5.0),
        lambda n, c: regrind.Nominal.from_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 1]]),
        lambda n, c: regrind.Nominal.from_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], [[0, 1, 2]]),
        lambda n, c: regrind.Nominal.from_function(lambda x, y: 0 * x, np.arange(5.0) * 1e-300, np.arange(5.0) * 1e-300),
        lambda n, c: regrind.simulate("--help"),
        lambda n, c: regrind.simulate(""),
        lambda n, c: regrind.simulate(3),
        lambda n, c: regrind.verify(3),
    ],
)
def test_refusals_are_typed(nominal, centres, call):
    with pytest.raises((regrind.DataError, regrind.ProgramError)) as refused:
        call(nominal, centres)
    assert len(str(refused.value)) > 20


def test_wavelength_is_written_as_it_is_stated():
    deviations = 1e-5 * (PLACES**2).sum(axis=1)
    assert regrind.iso10110(PLACES, deviations, wavelength=546.07e-6).notation.endswith("546.07")


def test_form_has_its_places(nominal, centres):
    rng = np.random.default_rng(1)
    found = regrind.register(nominal, centres + rng.normal(0.0, 2e-4, centres.shape), probe_radius=PROBE_RADIUS)
    form = regrind.model(found)
    assert form.places.shape == (len(form.values), 2)
    np.testing.assert_allclose(form.places, found.points[found.used, :2])


def test_interrupted_simulation_leaves_no_program(tmp_path):
    """The exception arrives when the program has ended, and its record is closed."""
    try:
        regrind._program._program()
    except regrind.ProgramError as refused:
        pytest.skip(str(refused))
    recipe = tmp_path / "slow.toml"
    text = (Path(__file__).parent / "dome.toml").read_text(encoding="utf-8")
    recipe.write_text(text.replace("speed = 10000.0", "speed = 20.0"), encoding="utf-8")
    # A shell gives SIGINT ignored to what it runs in the background.
    code = "import regrind, signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)\ntry:\n    regrind.simulate(sys.argv[1], runs=sys.argv[2])\nexcept KeyboardInterrupt:\n    print('stopped')"
    runs = tmp_path / "runs"
    child = subprocess.Popen([sys.executable, "-c", code, str(recipe), str(runs)], stdout=subprocess.PIPE, text=True)
    while not list(runs.glob("*/journal.anchor")):
        assert child.poll() is None
        time.sleep(0.05)
    child.send_signal(signal.SIGINT)
    said, _ = child.communicate(timeout=90)
    assert said.strip() == "stopped"
    (run,) = runs.iterdir()
    told = regrind.verify(run)
    assert told.sound and told.closed
