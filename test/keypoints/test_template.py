"""Claims about what the network is told of a finger: its template shows material where there is some."""

from types import SimpleNamespace

import numpy as np
import pytest

from finforce_ifea.jaw.jaw import list_shipped_jaws, load_jaw
from finforce_keypoints.geometry.side_picture import find_side
from finforce_keypoints.geometry.template import MARK_RADIUS, draw_template, find_shape, fit_grid


@pytest.mark.parametrize("name", list_shipped_jaws())
def test_the_grid_holds_every_point_with_room_to_bend(name):
    jaw = load_jaw(name)
    shape = find_shape(jaw)
    grid = fit_grid(shape)
    places = grid.pixels(np.vstack((jaw.keypoints, jaw.reference_point))[:, [0, 2]])
    assert (places > 5.0).all() and (places < np.array([grid.width, grid.height]) - 6.0).all()
    length = np.ptp(np.vstack(shape.rings)[:, 1]) / grid.scale
    assert length > 0.6 * grid.height or np.ptp(np.vstack(shape.rings)[:, 0]) / grid.scale > 0.3 * grid.width


@pytest.mark.parametrize("name", list_shipped_jaws())
def test_key_points_lie_on_material_and_the_mark_is_where_it_is(name):
    jaw = load_jaw(name)
    shape = find_shape(jaw)
    grid = fit_grid(shape)
    template = draw_template(shape, grid)
    inside = template[..., 0] > 127
    for x, z in grid.pixels(jaw.keypoints[:, [0, 2]]):
        row, column = round(z), round(x)
        reach = max(2, round(3e-3 / grid.scale))  # a hinge's screw lies beside its strip
        assert template[row - reach : row + reach + 1, column - reach : column + reach + 1, [0, 2]].max() > 60
    if name != "steel":
        assert 0.02 < inside.mean() < 0.4
    marks = template[..., 2] > 127
    column, row = grid.pixels(jaw.reference_point[None, [0, 2]])[0]
    assert marks[round(row), round(column)]
    distance = np.hypot(*(np.indices(marks.shape) - np.array([row, column])[:, None, None])) * grid.scale
    assert marks[distance < 0.6 * MARK_RADIUS].all()


def test_material_is_where_the_drawing_says():
    jaw = load_jaw("bench")
    shape = find_shape(jaw)
    grid = fit_grid(shape)
    material = draw_template(shape, grid)[..., 0] / 255.0
    area = material.sum() * grid.scale**2
    bands = 2 * 1.6e-3 * 0.080
    assert bands < area < 1.6 * bands
    columns, rows = np.round(grid.pixels(np.array([[0.0, 0.0140], [0.0132, 0.040], [-0.02, 0.04]]))).astype(int).T
    assert material[rows[0], columns[0]] < 0.1  # between the first two ribs
    assert material[rows[1], columns[1]] > 0.9  # in the inner band
    assert material[rows[2], columns[2]] == 0.0  # beside the finger


def test_what_is_held_is_marked_to_its_height():
    shape = find_shape(load_jaw("ssg48_fin_ray_1"))
    grid = fit_grid(shape)
    held = draw_template(shape, grid)[..., 1] > 127
    heights = grid.places(np.column_stack((np.zeros(grid.height), np.arange(grid.height))))[:, 1]
    np.testing.assert_array_equal(held.all(axis=1), heights <= 0.020)
    np.testing.assert_array_equal(held.any(axis=1), heights <= 0.020)


def test_a_mesh_is_drawn_by_the_side_of_its_surface():
    jaw = load_jaw("bench")
    grid = fit_grid(find_shape(jaw))
    mesh = jaw.build_mesh("coarse")
    meshed = SimpleNamespace(
        section=None,
        drawing=None,
        build_mesh=lambda: mesh,
        keypoints=jaw.keypoints,
        reference_point=jaw.reference_point,
    )
    first, second = (draw_template(find_shape(which), grid)[..., 0] / 255.0 for which in (jaw, meshed))
    assert np.abs(first - second).mean() < 0.005


def test_the_side_of_a_tapered_finger_is_read_where_the_mark_is():
    jaw = load_jaw("xlerobot")
    for x, y, z in (jaw.reference_point, *jaw.keypoints):
        assert find_side(jaw).at(np.array([x, z])) == pytest.approx(y, abs=0.3e-3)
    for name in ("bench", "umi"):
        jaw = load_jaw(name)
        assert find_side(jaw).at(jaw.reference_point[[0, 2]]) == pytest.approx(jaw.keypoints[0, 1], abs=1e-9)
