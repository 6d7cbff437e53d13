"""Registration: recovery of a planted pose, the known zero, layouts of arrays, threads."""

import pathlib
import threading

import numpy as np
import pytest
import regrind
from conftest import PROBE_RADIUS, turned


@pytest.mark.parametrize("angle", [0.0, 0.1, 1.0])
def test_planted_pose_is_found(nominal, centres, angle):
    measured, pose = turned(centres, angle, (10.0, -20.0, 5.0))
    found = regrind.register(nominal, measured, probe_radius=PROBE_RADIUS)
    np.testing.assert_allclose(found.pose, pose, atol=1e-6)
    assert found.rms < 1e-6 and found.pv < 1e-5
    np.testing.assert_allclose(found.normals[:, 2] > 0, True)
    assert found.used.all() and found.left_out == [] and len(found) == len(centres)


def test_deviation_is_positive_where_material_stands_proud(nominal, centres):
    measured = centres.copy()
    normals = regrind.register(nominal, centres, probe_radius=PROBE_RADIUS).normals
    measured[500] += 0.002 * normals[500]
    found = regrind.register(nominal, measured, probe_radius=PROBE_RADIUS, lock="x,y,z,rx,ry,rz")
    assert found.deviations[500] == pytest.approx(0.002, abs=1e-7)
    assert found.covariance.shape == (6, 6) and not found.covariance.any()


def test_known_noise_is_found_with_its_interval(nominal, centres):
    rng = np.random.default_rng(1)
    normals = regrind.register(nominal, centres, probe_radius=PROBE_RADIUS).normals
    measured = centres + rng.normal(0.0, 2e-4, (len(centres), 1)) * normals
    found = regrind.register(nominal, measured, probe_radius=PROBE_RADIUS)
    assert found.rms == pytest.approx(2e-4, rel=0.1)
    assert found.uncertainty.min() > 0.0
    form = regrind.model(found)
    assert form.noise_sigma == pytest.approx(2e-4, rel=0.15)
    assert form.rms.low <= form.rms.median <= form.rms.high < 1e-4
    assert form.values.shape == form.uncertainty.shape and form.frame_covariance.shape == (6, 6)


def test_every_layout_gives_the_same_bits(nominal, centres):
    measured, _ = turned(centres, 0.2, (1.0, 2.0, 3.0))
    expected = regrind.register(nominal, measured, probe_radius=PROBE_RADIUS)
    wide = np.zeros((len(measured), 6))
    wide[:, ::2] = measured
    for given in [np.asfortranarray(measured), wide[:, ::2], measured[::-1][::-1], measured.tolist()]:
        found = regrind.register(nominal, given, probe_radius=PROBE_RADIUS)
        assert (found.pose == expected.pose).all() and (found.deviations == expected.deviations).all()


def test_threads_register_side_by_side(nominal, centres):
    """The lock of the interpreter is released, so that another thread goes on."""
    measured, pose = turned(centres, 0.1, (1.0, 2.0, 3.0))
    poses = []
    work = lambda: poses.append(regrind.register(nominal, measured, probe_radius=PROBE_RADIUS).pose)  # noqa: E731
    threads = [threading.Thread(target=work) for _ in range(4)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert len(poses) == 4
    for found in poses:
        np.testing.assert_allclose(found, pose, atol=1e-6)


def test_nominal_from_every_source(tmp_path, nominal, centres):
    points = nominal.points
    np.savetxt(tmp_path / "nominal.csv", points, delimiter=",", fmt="%.17g", header="x,y,z", comments="")
    np.savetxt(tmp_path / "measured.csv", centres, delimiter=",", fmt="%.17g", header="x,y,z", comments="")
    measured = regrind.read(tmp_path / "measured.csv")
    assert (measured == centres).all()
    index = np.arange(len(points)).reshape(121, 161)
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    a, b, c, d = (corner.ravel() for corner in corners)
    triangles = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    for same in [
        regrind.Nominal.from_points(points),
        regrind.Nominal.from_file(tmp_path / "nominal.csv"),
        regrind.Nominal.from_mesh(points, triangles),
    ]:
        assert len(same) == len(nominal)
        found = regrind.register(same, measured, probe_radius=PROBE_RADIUS)
        np.testing.assert_allclose(found.pose, np.eye(4), atol=2e-5)


def test_face_of_cad_model_is_nominal():
    folder = pathlib.Path(__file__).parents[2] / "formats/tests/fixtures/cad"
    lens = folder / "e-lens-solid-ap242-inch.stp"
    plane = regrind.Nominal.from_file(lens, face=3, face_frame="face")
    assert abs(plane.points[:, 2]).max() < 1e-12
    assert len(regrind.Nominal.from_file(folder / "a-xy-ap214-mm.stp")) > 1000
    for wrong in [{"face": 9}, {"face": "nothing"}, {"face": 2}, {"face_frame": "part"}]:
        with pytest.raises(regrind.DataError):
            regrind.Nominal.from_file(lens, **wrong)
