"""Samples of the form: their shape, their mean, and their spread against the stated uncertainty."""

import numpy as np
import pytest
import regrind
from conftest import PROBE_RADIUS


@pytest.fixture(scope="module")
def form(nominal, centres):
    rng = np.random.default_rng(1)
    normals = regrind.register(nominal, centres, probe_radius=PROBE_RADIUS).normals
    planted = 1e-3 * np.cos(centres[:, 0] / 9.0) * np.cos(centres[:, 1] / 7.0)
    measured = centres + (planted + rng.normal(0.0, 2e-4, len(centres)))[:, None] * normals
    return regrind.model(regrind.register(nominal, measured, probe_radius=PROBE_RADIUS))


def test_samples_spread_as_the_uncertainty_says(form):
    samples = form.sample(1000)
    assert samples.shape == (1000, len(form.values)) and samples.flags["C_CONTIGUOUS"]
    # 1000 samples are those from which values and uncertainty come.
    np.testing.assert_allclose(samples.mean(axis=0), form.values, atol=1e-15)
    np.testing.assert_allclose(samples.std(axis=0, ddof=1), form.uncertainty, rtol=1e-9)
    rms = np.sqrt((samples**2).mean(axis=1))
    assert form.rms.low <= np.median(rms) <= form.rms.high
    assert (form.sample(1000) == samples).all()


def test_few_samples_are_samples_of_the_same_form(form):
    samples = form.sample(7)
    assert samples.shape == (7, len(form.values))
    assert np.abs(samples - form.values).max() < 8 * form.uncertainty.max()


@pytest.mark.parametrize("count", [0, 10**9])
def test_other_numbers_of_samples_are_refused(form, count):
    with pytest.raises(regrind.DataError, match="count"):
        form.sample(count)


@pytest.mark.parametrize("key", ["radius_uncertainty", "length_uncertainty"])
@pytest.mark.parametrize("number", [-1.0, float("nan"), float("inf")])
def test_impossible_uncertainties_are_refused(nominal, centres, key, number):
    found = regrind.register(nominal, centres, probe_radius=PROBE_RADIUS)
    with pytest.raises(regrind.DataError, match=key):
        regrind.model(found, **{key: number})
