"""Misuse: each is a typed exception with the value, and none ends the interpreter or leaks."""

import resource
import threading

import numpy as np
import pytest
import regrind
from conftest import PROBE_RADIUS

NUMBERS = [0.0, -1.0, float("nan"), float("inf"), -float("inf"), 1e300]
SHAPES = [(0,), (3,), (7, 2), (7, 4), (2, 3, 3), (0, 3), (1, 3), (6, 3)]
TYPES = ["U8", "S4", "O", "complex128", "datetime64[s]", "bool"]


def arrays() -> list:
    """Arguments that are no usable points."""
    rng = np.random.default_rng(1)
    good = rng.normal(0.0, 10.0, (60, 3))
    of_shapes = [rng.normal(0.0, 10.0, shape) for shape in SHAPES]
    of_types = [np.zeros((60, 3), dtype=kind) for kind in TYPES]
    holed = []
    for bad in [np.nan, np.inf, -np.inf]:
        for row in [0, 30, 59]:
            given = good.copy()
            given[row, row % 3] = bad
            holed.append(given)
    scaled = [good * factor for factor in (1e-300, 1e-9, 1e9, 1e300)]
    flat = [np.zeros((60, 3)), np.ones((60, 3)), np.column_stack([np.arange(60.0), np.zeros(60), np.zeros(60)])]
    return [None, "points", 3.0, {}, object(), [[1, 2], [3]], [["a", "b", "c"]], *of_shapes, *of_types, *holed, *scaled, *flat]


@pytest.mark.parametrize("given", arrays(), ids=lambda given: f"{type(given).__name__}{getattr(given, 'shape', '')}")
def test_points_are_refused(nominal, given):
    with pytest.raises(regrind.RegrindError) as refused:
        regrind.register(nominal, given, probe_radius=PROBE_RADIUS)
    assert len(str(refused.value)) > 20
    with pytest.raises(regrind.RegrindError):
        regrind.Nominal.from_points(np.asarray(given, dtype=object) if isinstance(given, list) else given, projection="none")


@pytest.mark.parametrize("key", ["side", "lock", "loss", "method", "distance"])
@pytest.mark.parametrize("word", ["", "AUTO", "none ", "x;y", "\u2603", "a" * 10_000])
def test_words_are_refused(nominal, centres, key, word):
    if (key, word) == ("lock", ""):
        return
    with pytest.raises(regrind.DataError, match=key):
        regrind.register(nominal, centres, probe_radius=PROBE_RADIUS, **{key: word})


@pytest.mark.parametrize("key", ["outlier_sigmas", "max_rms"])
@pytest.mark.parametrize("number", [0.0, -1.0, float("nan"), -float("inf")])
def test_numbers_are_refused(nominal, centres, key, number):
    with pytest.raises(regrind.DataError, match=key):
        regrind.register(nominal, centres, probe_radius=PROBE_RADIUS, **{key: number})


@pytest.mark.parametrize("radius", [-1.0, float("nan"), float("inf"), 1e300, 1e3])
def test_probe_radius_is_refused(nominal, centres, radius):
    with pytest.raises(regrind.RegrindError):
        regrind.register(nominal, centres, probe_radius=radius)


@pytest.mark.parametrize("factor", [1000.0, 1e-3, 25.4, 1 / 25.4])
def test_other_unit_is_refused(nominal, centres, factor):
    with pytest.raises(regrind.RegistrationError):
        regrind.register(nominal, centres * factor, probe_radius=PROBE_RADIUS)


@pytest.mark.parametrize(
    "pose", [np.ones((4, 4)), np.eye(3), np.diag([1, 1, -1, 1]), np.eye(4) * np.nan, np.diag([2, 2, 2, 1]), "eye"]
)
def test_initial_pose_is_refused(nominal, centres, pose):
    with pytest.raises(regrind.DataError, match="initial"):
        regrind.register(nominal, centres, probe_radius=PROBE_RADIUS, initial=pose)


@pytest.mark.parametrize("text", ["", "x", "[surface]", "[surface]\nkind = 3", "\x00", "[" * 10_000])
def test_definitions_are_refused(text):
    with pytest.raises(regrind.DataError):
        regrind.Nominal.from_toml(text)


@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b"x,y,z\n", b"x,y,z\n1,2\n", b"solid a\nendsolid", b"ply\n"])
def test_files_are_refused(tmp_path, content):
    path = tmp_path / "points.csv"
    path.write_bytes(content)
    with pytest.raises(regrind.DataError, match="points.csv"):
        regrind.Nominal.from_file(path)
    with pytest.raises(regrind.DataError, match="points.csv"):
        regrind.read(path)
    with pytest.raises(regrind.DataError):
        regrind.read(tmp_path / "missing.csv")


@pytest.mark.parametrize("triangles", [[[0, 1, 99]], [[0, 1, -1]], [[0, 1, 1.5]], [[0, 1]], []])
def test_triangles_are_refused(triangles):
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    with pytest.raises(regrind.DataError):
        regrind.Nominal.from_mesh(points, triangles)


@pytest.mark.parametrize("returned", [0.0, None, "z", [1.0], np.zeros((3, 3))])
def test_functions_are_refused(returned):
    with pytest.raises(regrind.DataError):
        regrind.Nominal.from_function(lambda x, y: returned, np.arange(9.0), np.arange(7.0))


def test_exception_of_a_function_is_passed_on():
    with pytest.raises(ZeroDivisionError):
        regrind.Nominal.from_function(lambda x, y: 1 / 0, np.arange(9.0), np.arange(7.0))


def test_array_that_changes_meanwhile_is_refused_or_used(nominal, centres):
    """Another thread writes NaN into the array: each call refuses it or has copied it before."""
    measured, stop, told = centres.copy(), threading.Event(), []

    def spoil() -> None:
        while not stop.is_set():
            measured[7] = np.nan
            measured[7] = centres[7]

    spoiler = threading.Thread(target=spoil)
    spoiler.start()
    for _ in range(30):
        try:
            told.append(np.isfinite(regrind.register(nominal, measured, probe_radius=PROBE_RADIUS).rms))
        except regrind.DataError as refused:
            told.append("row 7" in str(refused))
    stop.set()
    spoiler.join()
    assert len(told) == 30 and all(told)


@pytest.mark.parametrize("radius", [-1.0, float("nan"), 1e3])
def test_threads_are_refused_side_by_side(nominal, centres, radius):
    refusals: list[str] = []

    def misuse() -> None:
        try:
            regrind.register(nominal, centres, probe_radius=radius)
        except regrind.RegrindError as refused:
            refusals.append(str(refused))

    threads = [threading.Thread(target=misuse) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(refusals) == 8 and len(set(refusals)) == 1


def test_ten_thousand_registrations_leak_nothing():
    x = np.linspace(-20.0, 20.0, 9)
    small = regrind.Nominal.from_function(lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2, x, x)
    measured = small.offset(1.0)[12:-12:2]

    def often(count: int) -> int:
        for _ in range(count):
            found = regrind.register(small, measured, probe_radius=1.0, initial=np.eye(4))
        assert found.rms < 1e-6
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before = often(1000)
    after = often(9000)
    # 4 kB kept by each call would be 36 MB.
    assert after - before < 10_000, f"{after - before} kB more"


def test_ten_thousand_refusals_and_calls_leak_nothing(nominal, centres):
    found = regrind.register(nominal, centres, probe_radius=PROBE_RADIUS)

    def often(count: int) -> int:
        for _ in range(count):
            found.deviations.sum(), found.points.sum(), found.pose.sum()
            with pytest.raises(regrind.DataError):
                regrind.register(nominal, centres[:, :2], probe_radius=PROBE_RADIUS)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before = often(1000)
    after = often(9000)
    # One array of these calls kept each time would be 250 MB.
    assert after - before < 20_000, f"{after - before} kB more"
