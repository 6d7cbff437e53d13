"""Pictures: places, scale, colours of zero and of the ends, extremes, and refusals. Left out without matplotlib."""

import numpy as np
import pytest
import regrind
from conftest import PROBE_RADIUS

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("agg")

from regrind import plot  # noqa: E402


@pytest.fixture
def bent(nominal, centres):
    normals = regrind.register(nominal, centres, probe_radius=PROBE_RADIUS).normals
    proud = 1e-3 * np.sin(centres[:, 0] / 5)
    return regrind.register(nominal, centres + proud[:, None] * normals, probe_radius=PROBE_RADIUS)


def test_deviations_are_drawn_at_their_places(bent, tmp_path):
    axes = plot.show(bent, title="part")
    (drawn,) = axes.collections
    np.testing.assert_allclose(drawn.get_offsets(), bent.points[:, :2])
    np.testing.assert_allclose(drawn.get_array(), 1e3 * bent.deviations)
    end = 1e3 * plot.rounded_up(np.abs(bent.deviations).max())
    assert (drawn.norm.vmin, drawn.norm.vmax) == (-end, end)
    assert axes.get_title() == "part" and axes.get_aspect() == 1.0
    assert len(axes.lines) == 2
    axes.figure.savefig(tmp_path / "part.png")


def test_map_has_its_nodes_and_one_scale_about_zero(bent):
    error = regrind.error_map(bent.points, bent.deviations, cutoff=8.0)
    axes = plot.show(error, limit=0.002)
    (drawn,) = axes.collections
    assert drawn.get_array().size == error.values.size
    red, _, blue, _ = drawn.cmap(drawn.norm(2.0))
    assert red > blue
    red, _, blue, _ = drawn.cmap(drawn.norm(-2.0))
    assert red < blue
    np.testing.assert_allclose(drawn.cmap(drawn.norm(0.0))[:3], 0xF7 / 255, atol=0.01)


def test_values_in_tolerance_have_a_tint_only(bent):
    axes = plot.show(bent, tolerance=0.0005, limit=0.001)
    (drawn,) = axes.collections
    inside, outside = (np.array(drawn.cmap(drawn.norm(value))[:3]) for value in (0.49, 0.51))
    assert inside.min() > 0.85 and outside.min() < 0.8


@pytest.mark.parametrize(("value", "up"), [(0.0, 1e-9), (0.001, 0.001), (0.0011, 0.002), (3.0, 5.0), (7.0, 10.0), (1e-9, 1e-9)])
def test_scales_end_at_round_numbers(value, up):
    assert plot.rounded_up(value) == pytest.approx(up)


@pytest.mark.parametrize("change", [{"limit": 0.0}, {"limit": float("nan")}, {"tolerance": -1.0}, {"tolerance": float("inf")}])
def test_impossible_scales_are_refused(bent, change):
    with pytest.raises(regrind.DataError):
        plot.show(bent, **change)


@pytest.mark.parametrize("what", [None, 3.0, "map", np.zeros((3, 3))])
def test_other_things_are_not_drawn(what):
    with pytest.raises(regrind.DataError):
        plot.show(what)
    with pytest.raises(regrind.DataError):
        plot.histogram([np.nan])


def test_histogram_states_the_rms():
    axes = plot.histogram([0.001, -0.001, 0.001, -0.001])
    assert "RMS 1.000 µm" in axes.get_title()
