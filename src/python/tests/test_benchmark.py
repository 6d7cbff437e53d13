"""The benchmark: its exact solution finds a planted pose, and Regrind agrees with it to nanometres."""

import numpy as np
import pytest
import regrind
from regrind.benchmark import cases, surfaces
from regrind.benchmark.__main__ import compare, score


def test_exact_pose_of_planted_points_is_the_planted_one():
    part = surfaces.FreeForm()
    x, y = cases.lattice(40, 30, 90.0, 50.0)
    touched = surfaces.points_of(part, x, y) + 1.5 * surfaces.normals_of(part, x, y)
    pose = surfaces.placement((3.0, -2.0, 1.0), (2.0, -1.0, 3.0))
    near = surfaces.placement((2.99, -2.0, 1.0), (2.01, -1.0, 3.0))
    found, deviations = surfaces.exact(part, surfaces.moved(pose, touched), near, 1.5)
    np.testing.assert_allclose(found, pose, atol=1e-10)
    assert np.abs(deviations).max() < 1e-11


@pytest.mark.parametrize("surface", [surfaces.FreeForm(), cases.MIRROR])
def test_derivatives_are_those_of_the_height(surface):
    x, y, h = np.array([3.0, -20.0, 41.0]), np.array([-7.0, 15.0, 22.0]), 1e-4
    p, q = surface.gradient(x, y)
    xx, xy, yy = surface.hessian(x, y)
    np.testing.assert_allclose(p, (surface.height(x + h, y) - surface.height(x - h, y)) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(q, (surface.height(x, y + h) - surface.height(x, y - h)) / (2 * h), atol=1e-7)
    for found, (a, b) in [
        (xx, (surface.gradient(x + h, y)[0], surface.gradient(x - h, y)[0])),
        (xy, (surface.gradient(x, y + h)[0], surface.gradient(x, y - h)[0])),
        (yy, (surface.gradient(x, y + h)[1], surface.gradient(x, y - h)[1])),
    ]:
        np.testing.assert_allclose(found, (a - b) / (2 * h), atol=1e-7)


def test_regrind_agrees_with_the_exact_solution():
    case = cases.free_form_cases()["partial"]()
    best, exact = case.exact()
    found = regrind.register(regrind.Nominal.from_points(case.nominal), case.measured, probe_radius=1.5)
    told = score(case, found.pose, np.where(found.used, found.deviations, np.nan), (best, exact))
    assert told["pose_nm"] < 1.0 and told["map_nm"] < 0.1 and told["used"] == len(case.measured)


def test_rows_of_contenders_and_of_faults(monkeypatch):
    case = cases.free_form_cases()["partial"]()
    rows = compare(case, ["Regrind, search"])
    assert list(rows) == ["Regrind, search"]
    assert rows["Regrind, search"]["pose_nm"] < 1.0 and rows["Regrind, search"]["total_s"] > 0
    broken = cases.free_form_cases()["partial"]()
    broken.measured = broken.measured[:2]
    broken.inliers = broken.inliers[:2]
    with pytest.raises(np.linalg.LinAlgError):
        broken.exact()


def test_cases_are_the_same_in_every_run():
    first, second = (cases.free_form_cases()["outliers"]() for _ in range(2))
    assert (first.measured == second.measured).all() and (~first.inliers).sum() == round(0.05 * len(first.measured))
