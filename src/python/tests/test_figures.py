"""Figures and maps: planted polynomials, planted waves, shapes and refusals."""

import numpy as np
import pytest
import regrind


@pytest.fixture(scope="module")
def disc() -> np.ndarray:
    rng = np.random.default_rng(1)
    points = rng.uniform(-20.0, 20.0, (4000, 2))
    return points[np.hypot(points[:, 0], points[:, 1]) < 20.0]


def test_planted_zernike_terms_are_found(disc):
    rho2 = (disc**2).sum(axis=1) / 400.0
    # Z4, defocus, has the mean square 1 over the disc with the factor sqrt(3).
    deviations = 2e-3 + 5e-4 * np.sqrt(3) * (2 * rho2 - 1)
    fit = regrind.zernike_fit(disc, deviations, radius=20.0, terms=9)
    np.testing.assert_allclose(fit.coefficients, [2e-3, 0, 0, 5e-4, 0, 0, 0, 0, 0], atol=1e-12)
    assert fit.terms[3] == "Z4 (2, 0)" and fit.residual_rms < 1e-12 and fit.orthogonal.shape == (9,)


def test_power_of_a_planted_sphere(disc):
    radius2 = (disc**2).sum(axis=1)
    found = regrind.iso10110(disc, 1e-3 * radius2 / 400.0, radius=20.0)
    assert found.power_nm == pytest.approx(1000.0, rel=0.02)
    assert found.irregularity_nm < 1e-6 and found.symmetric_nm < 1e-6
    assert found.notation.startswith("3/") and "632.8" in found.notation


def test_map_passes_half_of_a_wave_at_the_cutoff():
    x, y = np.meshgrid(np.arange(0.0, 60.0, 0.5), np.arange(0.0, 40.0, 0.5))
    places = np.column_stack([x.ravel(), y.ravel()])
    wave = 1e-3 * np.sin(2 * np.pi * x / 10.0)
    made = regrind.error_map(places, wave.ravel(), cutoff=10.0, spacing=0.5)
    inner = made.values[30:50, 30:90]
    assert made.values.shape == (len(made.y), len(made.x)) == made.uncertainty.shape
    assert np.ptp(inner) == pytest.approx(1e-3, rel=0.02)
    filtered = regrind.gaussian(wave, spacing=(0.5, 0.5), cutoff=10.0)
    assert np.ptp(filtered[30:50, 30:90]) == pytest.approx(1e-3, rel=0.02)
    # A plane passes unchanged, also at the edge.
    plane = 1e-4 * x - 2e-4 * y
    np.testing.assert_allclose(regrind.gaussian(plane, spacing=(0.5, 0.5), cutoff=10.0), plane, atol=1e-12)
    holed = plane.copy()
    holed[20:24, 20:24] = np.nan
    assert np.isfinite(regrind.gaussian(holed, spacing=(0.5, 0.5), cutoff=10.0)[40:, 40:]).all()


@pytest.mark.parametrize(
    "call",
    [
        lambda p, d: regrind.zernike_fit(p, d[:-1], radius=20.0),
        lambda p, d: regrind.zernike_fit(p, d, radius=0.0),
        lambda p, d: regrind.zernike_fit(p, d, radius=20.0, terms=0),
        lambda p, d: regrind.zernike_fit(p, d, radius=20.0, terms=1000),
        lambda p, d: regrind.zernike_fit(p, d, radius=1.0),
        lambda p, d: regrind.zernike_fit(p[:3], d[:3], radius=20.0),
        lambda p, d: regrind.zernike_fit(p, d * np.nan, radius=20.0),
        lambda p, d: regrind.zernike_fit(p, d[:, None], radius=20.0),
        lambda p, d: regrind.zernike_fit(p[:, :1], d, radius=20.0),
        lambda p, d: regrind.zernike_fit(p, "abc", radius=20.0),
        lambda p, d: regrind.iso10110(p, d, radius=-1.0),
        lambda p, d: regrind.iso10110(p, d, wavelength=0.0),
        lambda p, d: regrind.iso10110(p[:2], d[:2]),
        lambda p, d: regrind.iso10110(p * [1, 0], d),
        lambda p, d: regrind.error_map(p, d, cutoff=0.0),
        lambda p, d: regrind.error_map(p, d, cutoff=float("nan")),
        lambda p, d: regrind.error_map(p, d, cutoff=5.0, spacing=-1.0),
        lambda p, d: regrind.error_map(p, d, cutoff=5.0, spacing=1e-9),
        lambda p, d: regrind.error_map(p[:2], d[:2], cutoff=5.0),
        lambda p, d: regrind.gaussian(p, spacing=(0.0, 1.0), cutoff=5.0),
        lambda p, d: regrind.gaussian(p, spacing=(1.0, 1.0), cutoff=-5.0),
        lambda p, d: regrind.gaussian(p, spacing=(1.0, 1.0), cutoff=5.0, order=3),
        lambda p, d: regrind.gaussian(d, spacing=(1.0, 1.0), cutoff=5.0),
        lambda p, d: regrind.gaussian(p * np.inf, spacing=(1.0, 1.0), cutoff=5.0),
        lambda p, d: regrind.gaussian(p[:0], spacing=(1.0, 1.0), cutoff=5.0),
    ],
)
def test_misuse_is_refused(disc, call):
    with pytest.raises(regrind.DataError):
        call(disc, 1e-4 * disc[:, 0])
