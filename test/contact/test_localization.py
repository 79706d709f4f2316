from dataclasses import replace

import numpy as np
import pytest
from contact_fakes import FACE, JAW, box, cylinder, joined, opened, pose, wrapped
from scipy.spatial.transform import Rotation

from finforce_contact.errors import ObjectMeshError
from finforce_contact.location import ClosestLocalizer, OutlineLocalizer, build_inner_face
from finforce_contact.mesh.object_mesh import surrounds, to_manifold
from finforce_contact.paper_contact import OFFSET, IntersectionLocalizer, centre_of_volume, check_surface, intersect
from finforce_contact.section import (
    SectionKeeper,
    compute_gaps,
    count_inside,
    distances_to,
    edges_of,
    place_edges,
    split_turn,
)
from finforce_ifea.errors import MeshError

INNER = build_inner_face(JAW, "default")
NODES = INNER.mesh.nodes
MM = 1e-3


def look(localizer, mesh, T, surface=None):
    """What a localizer finds of a mesh at a pose."""
    return localizer.locate(T, SectionKeeper(mesh, INNER.half_width).at(T), surface)


def locate(mesh, T):
    return look(OutlineLocalizer(INNER), mesh, T)


class TestInnerFace:
    def test_line_is_the_inner_face(self):
        np.testing.assert_allclose(INNER.line[:, 0], FACE)
        on_face = NODES[JAW.face.holds(NODES)]
        assert INNER.half_width == pytest.approx(on_face[:, 1].max())
        assert INNER.heights[[0, -1]] == pytest.approx([on_face[:, 2].min(), on_face[:, 2].max()], abs=0.5 * MM)

    @pytest.mark.parametrize("density", ["coarse", "fine"])
    def test_line_does_not_depend_on_the_mesh(self, density):
        np.testing.assert_allclose(build_inner_face(JAW, density).line, INNER.line, atol=1e-12)


class TestGaps:
    def test_gap_to_a_disc_is_that_of_its_equation(self):
        angle = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
        edges = place_edges(
            edges_of((0.01 * np.stack([np.cos(angle), np.sin(angle)], 1),)), np.array([0.03, 0.04]), 0.3
        )
        z = np.linspace(0.031, 0.049, 50)
        gaps = compute_gaps(np.stack([np.full(50, FACE), z], 1), edges)
        # a chord of 2000 leaves the circle by r / 8 (2 pi / n)^2, more where the line grazes it
        np.testing.assert_allclose(gaps, 0.03 - np.sqrt(1e-4 - (z - 0.04) ** 2) - FACE, atol=1e-7)

    def test_nothing_before_the_point_is_an_infinite_gap(self):
        edges = edges_of((np.array([[0.02, 0.0], [0.03, 0.0], [0.03, 0.01], [0.02, 0.01]]),))
        assert np.isinf(compute_gaps(np.array([[FACE, 0.02]]), edges)[0])

    def test_far_wall_of_a_cup_around_the_finger_does_not_count(self):
        walls = [box((0.003, 0.05, 0.1), (x, 0.0, 0.0)) for x in (-0.025, 0.02)]
        section = SectionKeeper(joined(*walls), INNER.half_width).at(pose(0.0, 0.04))
        np.testing.assert_allclose(compute_gaps(INNER.line, section.edges), 0.0185 - FACE, atol=1e-5)

    def test_points_within_the_outline_are_counted_but_not_those_in_its_holes(self):
        square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
        edges = edges_of((square, 1.0 + 0.5 * square[::-1]))
        assert count_inside(np.array([[0.5, 2.0], [2.0, 2.0], [3.5, 2.0], [5.0, 2.0]]), edges) == 2

    def test_distance_is_that_to_the_nearest_edge(self):
        edges = edges_of((np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]),))
        np.testing.assert_allclose(distances_to(np.array([[0.5, -2.0], [4.0, -4.0]]), edges), [2.0, 5.0], atol=1e-12)


class TestSection:
    @pytest.mark.parametrize("tilt", [-3.0, -0.4, 0.3, np.pi])
    def test_turn_in_the_plane_is_told_from_what_tips_y(self, tilt):
        turn, swing = split_turn(pose(0.0, 0.0, tilt=tilt)[:3, :3])
        assert np.cos(turn - tilt) == pytest.approx(1.0, abs=1e-12)
        assert swing == pytest.approx(0.0, abs=1e-7)
        tipped = Rotation.from_euler("x", 0.1).as_matrix() @ pose(0.0, 0.0, tilt=tilt)[:3, :3]
        assert split_turn(tipped)[1] == pytest.approx(0.1, abs=1e-7)

    def test_tilted_outline_is_the_one_cut_at_that_tilt(self):
        mesh = box((0.02, 0.03, 0.04), (0.003, 0.0, -0.002))
        keeper = SectionKeeper(mesh, INNER.half_width)
        keeper.at(pose(0.03, 0.04))
        tilted = keeper.at(pose(0.031, 0.041, tilt=0.3))
        anew = SectionKeeper(mesh, INNER.half_width).at(pose(0.031, 0.041, tilt=0.3))
        line = INNER.line
        assert keeper.cuts == 1
        assert tilted.tilt == pytest.approx(0.3)
        np.testing.assert_allclose(compute_gaps(line, tilted.edges), compute_gaps(line, anew.edges), atol=0.05 * MM)

    def test_outline_is_cut_anew_when_the_object_tips_or_slides_across(self):
        keeper = SectionKeeper(box(), INNER.half_width)
        keeper.at(pose(0.03, 0.04))
        keeper.at(pose(0.03, 0.04, y=0.9 * MM))
        assert keeper.cuts == 1
        keeper.at(pose(0.03, 0.04, y=1.1 * MM))
        T = pose(0.03, 0.04, y=1.1 * MM)
        T[:3, :3] = Rotation.from_euler("z", 2.0, degrees=True).as_matrix()
        keeper.at(T)
        assert keeper.cuts == 3

    def test_outline_is_cut_anew_when_the_object_turned_far_unless_it_touches(self):
        keeper = SectionKeeper(box(), INNER.half_width)
        keeper.at(pose(0.03, 0.04))
        assert keeper.at(pose(0.03, 0.04, tilt=1.0), touching=True).tilt == pytest.approx(1.0)
        assert keeper.at(pose(0.03, 0.04, tilt=1.0)).tilt == 0.0
        assert keeper.cuts == 2


class TestOutline:
    @pytest.mark.parametrize("x", [FACE + 0.0125 - 3 * MM, FACE + 0.0125, FACE + 0.05])
    def test_place_of_a_cylinder_is_its_height_wherever_it_is_along_x(self, x):
        assert locate(cylinder(), pose(x, 0.0412)).height == pytest.approx(0.0412, abs=0.1 * MM)

    @pytest.mark.parametrize("depth", [-1.0, -0.05, 0.05, 3.0])
    def test_meshes_that_intersect_touch(self, depth):
        assert locate(cylinder(), pose(FACE + 0.0125 - depth * MM, 0.04)).touching is (depth > 0.0)

    def test_box_touches_in_the_middle_of_its_face(self):
        assert locate(box(), pose(FACE + 0.015, 0.045)).height == pytest.approx(0.045, abs=0.3 * MM)

    def test_tilted_box_touches_with_its_edge(self):
        # tilted from x to z the face leans, its lower edge goes first
        place = locate(box(), pose(0.04, 0.045, tilt=np.radians(20)))
        corner = pose(0.0, 0.045, tilt=np.radians(20)) @ [-0.015, 0.0, -0.015, 1.0]
        other = pose(0.0, 0.045, tilt=np.radians(20)) @ [-0.015, 0.0, 0.015, 1.0]
        leading = corner if corner[0] < other[0] else other
        assert place.height == pytest.approx(leading[2], abs=0.5 * MM)

    def test_object_above_the_jaw_has_no_place(self):
        assert locate(box(), pose(0.03, 0.13)) is None

    def test_open_mesh_has_the_same_place(self):
        T = pose(FACE + 0.0125, 0.0412)
        assert locate(opened(cylinder()), T).height == pytest.approx(0.0412, abs=0.2 * MM)

    def test_right_jaw_has_the_same_place(self):
        face = build_inner_face(JAW.mirrored(), "default")
        T = pose(FACE + 0.0125, 0.0412)
        assert look(OutlineLocalizer(face), cylinder(), T).height == pytest.approx(0.0412, abs=0.1 * MM)


class TestClosest:
    @pytest.mark.parametrize("depth", [2 * MM, -17.5 * MM])
    def test_nearest_candidate_of_the_undeformed_surface_is_taken(self, depth):
        place = look(ClosestLocalizer(JAW, INNER), cylinder(), pose(FACE + 0.0125 - depth, 0.0412))
        assert place.height == pytest.approx(0.043)
        assert place.touching is (depth > 0.0)

    def test_distance_counts_not_the_way_along_x(self):
        # beyond the tip the nearest point is the tip's end, whatever is before the surface along x
        mesh = joined(box((0.01, 0.03, 0.01), (0.03, 0.0, 0.03)), box((0.01, 0.03, 0.01), (0.0, 0.0, 0.087)))
        place = look(ClosestLocalizer(JAW, INNER), mesh, pose(FACE, 0.0))
        assert place.height == pytest.approx(JAW.candidates[-1, 2])


class TestIntersection:
    @pytest.fixture
    def localizer(self):
        pytest.importorskip("manifold3d")
        return IntersectionLocalizer(JAW, INNER, cylinder())

    def test_centre_of_volume_of_a_box_is_its_centre(self):
        mesh = box((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
        np.testing.assert_allclose(centre_of_volume(mesh.vertices, mesh.triangles), [4.0, 5.0, 6.0], atol=1e-12)

    def test_intersection_of_boxes_has_the_centre_of_what_they_share(self):
        pytest.importorskip("manifold3d")
        jaw, solid = box((2.0, 2.0, 2.0)), to_manifold(box((2.0, 2.0, 2.0)))
        centre = intersect(solid, pose(1.0, 0.5), jaw.vertices, jaw.triangles)
        np.testing.assert_allclose(centre, [0.5, 0.0, 0.25], atol=1e-6)
        assert intersect(solid, pose(3.0, 0.0), jaw.vertices, jaw.triangles) is None

    def test_before_contact_the_object_is_brought_into_the_surface_and_does_not_touch(self, localizer):
        place = localizer.locate(pose(0.06, 0.0412), None, None)
        assert place.height == pytest.approx(0.043)
        assert place.touching is False

    def test_shift_before_contact_is_equation_two(self, localizer):
        expected = FACE - OFFSET + 0.0125
        assert localizer._slight_contact(pose(0.06, 0.04)) == pytest.approx(expected, abs=1e-12)

    def test_shift_goes_by_the_middle_of_an_object_whose_origin_is_elsewhere(self):
        pytest.importorskip("manifold3d")
        localizer = IntersectionLocalizer(JAW, INNER, box((0.02, 0.03, 0.03), (0.004, 0.0, 0.0)))
        assert localizer._slight_contact(pose(0.06, 0.04)) == pytest.approx(FACE - 1 * MM + 0.006, abs=1e-12)

    def test_status_turns_false_after_an_empty_intersection_and_the_place_is_kept(self, localizer):
        first, second = (localizer.locate(pose(0.06, 0.0412), None, None) for _ in range(2))
        assert localizer._status is False
        assert second.height == first.height

    def test_touching_is_an_intersection_where_the_object_is(self, localizer):
        pressed = pose(FACE + 0.0125 - 0.5 * MM, 0.0412)
        localizer.locate(pressed, None, None)
        assert localizer.locate(pressed, None, None).touching is True

    def test_bent_jaw_keeps_its_contact_when_one_intersection_was_empty(self, localizer):
        surface = wrapped(NODES, 0.0125, FACE + 0.0125 - 5 * MM, 0.0412)
        localizer.locate(pose(FACE + 0.0125 - 4.8 * MM, 0.0412), None, surface)
        assert localizer._status is False
        assert localizer.locate(pose(FACE + 0.0125 - 5.2 * MM, 0.0412), None, surface).touching is True

    def test_surface_of_another_mesh_is_refused_and_the_mesh_setting_named(self, localizer):
        with pytest.raises(MeshError, match="mesh setting"):
            localizer.locate(pose(0.06, 0.0412), None, NODES[:-1])
        with pytest.raises(MeshError, match="not finite"):
            check_surface(np.where(NODES.max() == NODES, np.nan, NODES), INNER.mesh)

    def test_open_mesh_is_refused_and_the_way_out_named(self):
        pytest.importorskip("manifold3d")
        with pytest.raises(ObjectMeshError, match="mode 'estimate'"):
            IntersectionLocalizer(JAW, INNER, opened(cylinder()))


class TestEnclosure:
    @pytest.mark.parametrize("turned", [False, True])
    def test_point_within_is_told_from_points_without(self, turned):
        mesh = cylinder()
        mesh = replace(mesh, triangles=mesh.triangles[:, ::-1].copy()) if turned else mesh
        assert surrounds(mesh, np.array([0.003, 0.01, 0.002]))
        assert not surrounds(mesh, np.array([0.012, 0.0, 0.012]))
        assert not surrounds(mesh, np.array([0.05, 0.0, 0.0]))

    def test_open_mesh_surrounds_too(self):
        assert surrounds(opened(cylinder()), np.zeros(3))
