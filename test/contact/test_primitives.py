from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from contact_fakes import distance_mm, make_case
from table_fakes import build_d405, draw_scene

from finforce.optional import import_manifold3d
from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction import reconstruction
from finforce_contact.reconstruction.evidence import collect_evidence, score_shape
from finforce_contact.reconstruction.reconstruction import complete_surface, reconstruct
from finforce_contact.reconstruction.shape_search import HANDICAP, build_primitive, fit_primitive, spread_directions


def make_ball(radius):
    shape = import_manifold3d().Manifold.sphere(radius, 100).to_mesh()
    vertices, triangles = np.array(shape.vert_properties[:, :3], dtype=float), np.array(shape.tri_verts)
    return ObjectMesh(vertices=vertices, triangles=triangles, watertight=True, name="ball")


@lru_cache(maxsize=4)
def fit_once(name, seed=0, hidden=0.0):
    """Return the best primitive of a case and the stages that were reported."""
    stages = {}
    fit = fit_primitive(make_case(name, seed, hidden).evidence, stages.__setitem__)
    return fit, stages


@pytest.mark.parametrize("name, shape", [("cylinder", "cylinder"), ("cube", "box")])
def test_true_shape_is_chosen_with_its_size(name, shape):
    case = make_case(name)
    result, _ = fit_once(name)
    assert result.method == f"primitive: {shape}" and result.mesh.watertight
    assert result.mesh.notes == (f"The back was not seen; it is guessed to be that of a {shape}.",)
    assert distance_mm(case, result.mesh, result.T_camera_object) < 0.5
    sides = np.sort(np.ptp(result.mesh.vertices, axis=0))
    np.testing.assert_allclose(sides, np.sort(np.ptp(case.scene.mesh.vertices, axis=0)), atol=1e-3)


def test_ball_is_a_sphere_and_no_short_cylinder():
    scene = draw_scene(make_ball(0.035), build_d405(step=2), np.random.default_rng(0))
    result = fit_primitive(collect_evidence(scene.depth, scene.mask, scene.camera))
    assert result.method == "primitive: sphere"
    np.testing.assert_allclose(np.ptp(result.mesh.vertices, axis=0), 0.07, atol=1e-3)
    np.testing.assert_allclose(result.T_camera_object[:3, 3], scene.T_camera_object[:3, 3], atol=1e-3)


def test_a_pen_before_a_background_that_was_not_measured_keeps_its_size():
    pen = make_pen(0.02, 0.12)
    scene = draw_scene(pen, build_d405(step=2), np.random.default_rng(3))
    depth = np.where(scene.mask, scene.depth, np.nan)
    result = fit_primitive(collect_evidence(depth, scene.mask, scene.camera))
    np.testing.assert_allclose(np.sort(np.ptp(result.mesh.vertices, axis=0)), [0.02, 0.02, 0.12], rtol=0.1)
    ball = place_ball(0.2, result.T_camera_object)
    assert score_shape(MeshView(ball), np.eye(4), collect_evidence(depth, scene.mask, scene.camera)).overlap < 0.5


def test_depth_in_steps_of_another_size_is_refused():
    scene = draw_scene(make_pen(0.02, 0.12), build_d405(step=2), np.random.default_rng(3))
    # 0.26 m in steps of 0.1 mm, or 0.52 m in those of 0.2 mm, taken for millimetres
    with pytest.raises(ReconstructionError, match="m away and .* m across; expected .*--depth-scale 0.0002"):
        collect_evidence(10.0 * scene.depth, scene.mask, scene.camera)


def make_pen(thickness, length):
    pen = build_primitive("cylinder").mesh
    return replace(pen, vertices=pen.vertices * (thickness, thickness, length))


def place_ball(radius, T):
    ball = make_ball(radius)
    away = T[:3, 3] / np.linalg.norm(T[:3, 3])
    return replace(ball, vertices=ball.vertices + T[:3, 3] + radius * away)


def test_half_hidden_cylinder_keeps_its_size():
    case = make_case("cylinder", seed=1, hidden=0.4)
    result, _ = fit_once("cylinder", 1, 0.4)
    assert distance_mm(case, result.mesh, result.T_camera_object) < 0.8


def test_bottle_is_no_primitive_and_is_completed_nearer_than_by_one(monkeypatch):
    case = make_case("bottle")
    shape, _ = fit_once("bottle")
    monkeypatch.setattr(reconstruction, "fit_primitive", lambda evidence, report: shape)
    completed = reconstruct(case.evidence)
    assert completed.method == "completion" and completed.mesh.watertight
    assert any("not seen" in note for note in completed.mesh.notes)
    near = distance_mm(case, completed.mesh, completed.T_camera_object)
    assert near < 1.5 < distance_mm(case, shape.mesh, shape.T_camera_object)


def test_what_agrees_with_a_primitive_becomes_one(monkeypatch):
    case = make_case("cylinder")
    shape, _ = fit_once("cylinder")
    monkeypatch.setattr(reconstruction, "fit_primitive", lambda evidence, report: shape)
    assert reconstruct(case.evidence) is shape
    assert reconstruct(case.evidence, None, "completion").method == "completion"


def test_completion_of_a_cylinder_has_the_back_of_a_cylinder():
    case = make_case("cylinder")
    result = complete_surface(case.evidence, fit_once("cylinder")[0])
    assert result.mesh.watertight
    assert 0.003 < result.mesh.unseen_stddev < 0.006
    assert "± " in result.mesh.notes[-1]
    # pixels of 1.2 mm here; the outline is half of one short on each side
    assert distance_mm(case, result.mesh, result.T_camera_object) < 0.8


def test_stages_are_reported_up_to_their_end():
    _, stages = fit_once("cylinder")
    assert {"sphere: starts", "cylinder: refinement", "box: refinement"} <= set(stages)
    assert set(stages.values()) == {1.0}


@pytest.mark.parametrize("name", list(HANDICAP))
def test_unit_shapes_are_turned_outward(name):
    mesh = build_primitive(name).mesh
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    full = {"sphere": np.pi / 6.0, "cylinder": 0.25 * np.pi, "box": 1.0}[name]
    assert volume == pytest.approx(full, rel=0.02)


def test_directions_are_spread_over_the_whole_sphere():
    directions = spread_directions(200)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=0.01)
    nearest = np.sort(directions @ directions.T, axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).min() > 8.0
