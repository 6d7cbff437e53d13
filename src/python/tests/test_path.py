"""Corrections, tool paths and files: a correction worked by hand, the known zero, exact contact, and round trips."""

import numpy as np
import pytest
import regrind
from conftest import PROBE_RADIUS

PLACES = np.column_stack([axis.ravel() for axis in np.meshgrid(np.arange(-20.0, 21.0), np.arange(-10.0, 11.0))])
LIMITS = {"depth_of_cut": 0.01, "max_correction": 0.05, "removal_budget": 0.1}


def map_of(deviations: np.ndarray) -> regrind.ErrorMap:
    return regrind.error_map(PLACES, deviations, cutoff=5.0, spacing=1.0)


def test_correction_reverses_the_error_and_accumulates():
    error = map_of(1e-4 * PLACES[:, 0])
    first = regrind.compensate(error, gain=0.5, allowance=0.02, **LIMITS)
    np.testing.assert_allclose(first.values, -0.5 * error.values, atol=1e-15)
    # It rises by 1 um where the part is 2 um too low, so the wheel goes 0.5 um deeper there than that at least.
    assert first.cycle == 2 and first.depth == 0.01 and first.level == pytest.approx(0.01, abs=1e-15)
    second = regrind.compensate(error, previous=first, gain=0.5, allowance=0.02, **LIMITS)
    np.testing.assert_allclose(second.values, -error.values, atol=1e-15)
    assert second.cycle == 3 and second.removed == pytest.approx(0.02 + np.abs(error.values).max(), abs=1e-12)
    assert first.values.shape == (len(first.y), len(first.x))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"max_correction": 0.001}, "max_correction"),
        ({"removal_budget": 0.001}, "budget"),
        ({"max_depth": 0.001}, "max_depth"),
        ({"gain": 0.0}, "gain"),
        ({"gain": float("nan")}, "gain"),
        ({"gain": 2.0}, "gain"),
        ({"depth_of_cut": -1.0}, "depth_of_cut"),
        ({"depth_of_cut": float("inf")}, "depth_of_cut"),
        ({"max_correction": 0.0}, "max_correction"),
        ({"max_correction": float("nan")}, "max_correction"),
        ({"removal_budget": 0.0}, "removal_budget"),
        ({"allowance": -1.0}, "allowance"),
        ({"min_depth": float("nan")}, "min_depth"),
        ({"max_depth": 0.0}, "max_depth"),
    ],
)
def test_impossible_corrections_are_refused(change, words):
    with pytest.raises(regrind.DataError, match=words):
        regrind.compensate(map_of(1e-4 * PLACES[:, 0]), **{**LIMITS, **change})


def test_ball_touches_the_corrected_surface(nominal):
    """The centre of a ball on a plane plus a constant correction is exactly one radius above it."""
    x, y = np.arange(-20.0, 21.0), np.arange(-10.0, 11.0)
    plane = regrind.Nominal.from_function(lambda x, y: 0.0 * x, x, y)
    raised = regrind.compensate(map_of(np.full(len(PLACES), -1e-3)), allowance=0.02, **LIMITS)
    path = regrind.toolpath(plane, raised, wheel_radius=5.0, track=0.5, feed=600.0)
    points = path.points
    inside = (np.abs(points[:, 0]) < 15) & (np.abs(points[:, 1]) < 8)
    # 5 mm radius, 10 um of level (20 um less 10 um deep), 1 um of correction.
    np.testing.assert_allclose(points[inside, 2], 5.0 + raised.level + 1e-3, atol=1e-9)
    assert len(path) == len(points) == len(path.tracks) and path.track == pytest.approx(0.5)
    assert (np.diff(path.tracks.astype(int)) >= 0).all() and path.tracks[-1] == 40
    assert path.duration == pytest.approx(60.0 * path.length / 600.0, rel=1e-9)


@pytest.mark.parametrize("side", ["above", "below"])
def test_wheel_is_one_radius_from_a_free_form(nominal, side):
    path = regrind.toolpath(nominal, wheel_radius=3.0, scallop=1e-4, feed=600.0, side=side, chord_error=1e-5)
    inside = (np.abs(path.points[:, 0]) < 35) & (np.abs(path.points[:, 1]) < 25)
    centres = path.points[inside][::50]
    found = regrind.register(nominal, centres, probe_radius=3.0, side=side, lock="x,y,z,rx,ry,rz")
    assert np.abs(found.deviations).max() < 1e-5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"wheel_radius": 0.0}, "wheel_radius"),
        ({"wheel_radius": float("nan")}, "wheel_radius"),
        ({"wheel_radius": 1e4}, "mm"),
        ({"track": None}, "track"),
        ({"track": 0.0}, "track"),
        ({"track": -1.0}, "track"),
        ({"track": 1e-12}, "track"),
        ({"scallop": 0.0}, "scallop"),
        ({"scallop": float("nan")}, "scallop"),
        ({"feed": 0.0}, "feed"),
        ({"feed": float("inf")}, "feed"),
        ({"rim_radius": 9.0}, "rim_radius"),
        ({"rim_radius": 0.0}, "rim_radius"),
        ({"pattern": "zigzag"}, "pattern"),
        ({"side": "auto"}, "side"),
        ({"side": ""}, "side"),
        ({"chord_error": 0.0}, "chord_error"),
        ({"chord_error": 1e-30}, "chord_error"),
        ({"overrun": 1e6}, "overrun"),
        ({"track": 1e-5, "pattern": "spiral"}, "track"),
        ({"overrun": -1.0}, "overrun"),
        ({"safe_height": float("nan")}, "safe height"),
    ],
)
def test_impossible_paths_are_refused(nominal, change, words):
    with pytest.raises(regrind.DataError, match=words):
        regrind.toolpath(nominal, **{"wheel_radius": 3.0, "track": 0.5, "feed": 600.0, **change})


def test_files_are_read_back(tmp_path, nominal, centres):
    found = regrind.register(nominal, centres, probe_radius=PROBE_RADIUS)
    error = regrind.error_map(found.points, found.deviations + 1e-3, cutoff=8.0)
    correction = regrind.compensate(error, **LIMITS)
    path = regrind.toolpath(nominal, correction, wheel_radius=3.0, track=2.0, feed=600.0, chord_error=1e-3)
    regrind.write(tmp_path / "points.csv", centres)
    assert (regrind.read(tmp_path / "points.csv") == centres).all()
    regrind.write(tmp_path / "deviations.csv", found)
    rows = np.loadtxt(tmp_path / "deviations.csv", delimiter=",", skiprows=1)
    assert (rows[:, :3] == found.points).all() and (rows[:, 6] == found.deviations).all()
    regrind.write(tmp_path / "map.csv", error, nominal=nominal)
    rows = np.loadtxt(tmp_path / "map.csv", delimiter=",", comments=["#", "x"])
    known = rows[:, 4] == 1
    assert (rows[known, 2] == error.values.ravel()[known]).all() and known.sum() == np.isfinite(error.values).sum()
    regrind.write(tmp_path / "map.x3p", error)
    heights = regrind.read(tmp_path / "map.x3p")
    np.testing.assert_allclose(heights[:, 2], error.values[np.isfinite(error.values)], atol=1e-12)
    regrind.write(tmp_path / "correction.csv", correction, nominal=nominal)
    rows = np.loadtxt(tmp_path / "correction.csv", delimiter=",", comments=["#", "x"])
    assert (rows[:, 2] == correction.values.ravel()).all()
    for dialect in ["linuxcnc", "fanuc", "sinumerik", "heidenhain"]:
        regrind.write(tmp_path / "part", path, dialect=dialect, controller_tolerance=1e-3)
        text = (tmp_path / "part").read_text(encoding="utf-8")
        assert len(text.splitlines()) > len(path)


@pytest.mark.parametrize("what", [None, "text", 3.0, {}, np.zeros((4, 2)), np.full((4, 3), np.nan)])
def test_other_things_are_not_written(tmp_path, what):
    with pytest.raises(regrind.DataError):
        regrind.write(tmp_path / "file", what)
    assert list(tmp_path.iterdir()) == []


def test_files_that_cannot_be_written_are_refused(tmp_path, nominal, centres):
    error = map_of(1e-4 * PLACES[:, 0])
    with pytest.raises(regrind.DataError, match="nominal is missing"):
        regrind.write(tmp_path / "map.csv", error)
    with pytest.raises(regrind.DataError, match="no-such-folder"):
        regrind.write(tmp_path / "no-such-folder" / "points.csv", centres)
    path = regrind.toolpath(nominal, wheel_radius=3.0, track=5.0, feed=600.0, chord_error=1e-2)
    with pytest.raises(regrind.DataError, match="dialect"):
        regrind.write(tmp_path / "part.ngc", path, dialect="apt")
    for tolerance in [None, 0.0, float("nan")]:
        with pytest.raises(regrind.DataError, match="tolerance"):
            regrind.write(tmp_path / "part.nc", path, dialect="fanuc", controller_tolerance=tolerance)
    assert list(tmp_path.iterdir()) == []
