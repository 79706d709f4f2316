"""Claims about how the growth of cost is measured."""

import json

import numpy as np
import pytest
from eval_fakes import drawn_hues

from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings
from lab.bench import growth as bench_growth
from lab.bench.cases import bench_finger
from lab.bench.growth import (
    Curve,
    Growth,
    GrowthFigures,
    _density,
    _measure_density,
    _measure_keypoints,
    _measure_program,
    as_json,
    build_sphere,
    fit_slope,
    format_table,
    grow_triangles,
    list_densities,
    mesh_jaw,
    spread_keypoints,
)

JAW = bench_finger()


def curve(power, constant=0.0, sizes=(1, 10, 100, 1000)):
    return Curve(name="work", sizes=sizes, seconds=[constant + 1e-6 * size**power for size in sizes])


def test_slope_is_the_exponent_of_a_power_law():
    assert curve(1.5).slope == pytest.approx(1.5)
    assert curve(1.5).end_slope == pytest.approx(1.5)
    assert np.isnan(fit_slope([1], [1]))


def test_end_slope_leaves_constant_costs_behind():
    late = curve(1.0, constant=1e-5)
    assert late.slope < 0.8
    assert late.end_slope > 0.95


@pytest.mark.parametrize("solid", [False, True])
def test_meshes_reach_from_hundreds_to_twenty_thousand_vertices(solid):
    counts = [len(mesh_jaw(JAW, density).build_mesh("coarse").nodes) for density in list_densities(False, solid=solid)]
    assert counts == sorted(counts)
    assert counts[0] < (600 if solid else 250)
    assert 15_000 < counts[-1] < 25_000


def test_step_and_its_shares_are_measured_on_the_same_mesh():
    row = _measure_density(_density(1, 1, 1, 2))
    assert row["vertices"] == len(mesh_jaw(JAW, _density(1, 1, 1, 2)).build_mesh().nodes)
    assert {"a step of the full solver", "SuperLU on its matrix", "assembly", "factorisation"} <= row.keys()


@pytest.mark.parametrize("count", [5, 200])
def test_key_points_spread_over_the_side_face_and_stay_on_the_jaw(count):
    jaw = spread_keypoints(JAW, count)
    assert jaw.keypoints.shape == (count, 3)
    assert len(set(map(tuple, jaw.keypoints))) == len(set(jaw.keypoint_names)) == count
    np.testing.assert_allclose(jaw.keypoints[:, 1], 0.010, atol=1e-12)
    assert np.ptp(jaw.keypoints[:, 2]) > 0.06
    build_mechanics(jaw, EstimatorSettings()).model.attach(jaw.keypoints, KEYPOINT_DISTANCE)


def test_steps_with_many_key_points_give_forces(monkeypatch):
    def run(estimator, observations, contact):
        return [estimator.update(observation, contact) for observation in observations]

    monkeypatch.setattr(bench_growth, "time_steps", run)
    *_, last = _measure_keypoints("frame", 40)
    assert last.status == "ok" and last.force[0] < -0.3


def test_program_with_many_candidates_is_solved(monkeypatch):
    monkeypatch.setattr(bench_growth, "time_median", lambda call, count: call())
    moved, solved = _measure_program(JAW, 20).values()
    assert moved.shape == (len(JAW.keypoints), 3, 20) and np.ptp(moved[:, 0], axis=1).max() > 0
    assert solved.kkt < 1e-8


def test_sphere_has_the_triangles_that_it_is_asked_for():
    mesh = build_sphere(2)
    assert len(mesh.triangles) == 20 * 4**2
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.02, rtol=1e-9)


def test_images_of_spheres_are_measured_at_every_size(monkeypatch):
    monkeypatch.setattr("lab.bench.growth.SUBDIVISIONS", (1, 2))
    growth = grow_triangles(quick=True)
    assert [list(curve.sizes) for curve in growth.curves] == [[80, 320]] * 4


def test_table_json_and_picture_hold_slopes(tmp_path):
    figures = GrowthFigures(
        growths=[Growth(name="things", unit="things", curves=[curve(2.0), curve(1.0, sizes=(1, 2))])]
    )
    assert "  2.00" in format_table(figures)
    assert json.loads(json.dumps(as_json(figures)))["growths"][0]["curves"][0]["slope"] == pytest.approx(2.0)
    bench_growth.draw(figures, tmp_path / "growth.png")
    assert drawn_hues(tmp_path / "growth.png") >= 2
