from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from contact_fakes import FACE, JAW, bent, box, cylinder, joined, opened, pose, wrapped
from scipy.spatial.transform import Rotation

from finforce_contact.errors import ObjectMeshError
from finforce_contact.localization.outline_localizer import (
    WRENCH_FORCE,
    WRENCH_GAIN,
    ClosestLocalizer,
    ContactPatch,
    ContactScene,
    OutlineLocalizer,
    build_inner_face,
    cross_line_of_action,
    overlap_of,
    patch_from_overlap,
    tilt_patch,
)
from finforce_contact.localization.section import (
    SectionKeeper,
    compute_gaps,
    count_inside,
    distances_to,
    edges_of,
    place_edges,
    split_turn,
)
from finforce_contact.mesh.object_mesh import surrounds, to_manifold
from finforce_contact.paper_contact import OFFSET, IntersectionLocalizer, centre_of_volume, intersect
from finforce_ifea.errors import MeshError

INNER = build_inner_face(JAW, "default")
NODES = INNER.mesh.nodes
MM = 1e-3


def scene_of(mesh, T, surface=NODES, wrench=None):
    section = SectionKeeper(mesh, INNER.half_width).at(T)
    return ContactScene(T=T, section=section, surface=surface, line=INNER.deform(surface), wrench=wrench)


def locate(mesh, T, surface=NODES, wrench=None):
    return OutlineLocalizer(INNER).locate(scene_of(mesh, T, surface, wrench))


def push_at(line, height, size=2.0, lean=0.0):
    """A force on the line's point of an undeformed height, with its torque about the jaw's origin."""
    x, z = (np.interp(height, INNER.heights, column) for column in line.T)
    force = size * np.array([-np.cos(lean), 0.0, np.sin(lean)])
    return force, np.array([0.0, z * force[0] - x * force[2], 0.0])


def test_a_broken_edge_of_the_inner_face_is_none_of_it():
    x, edge, half, top = 0.02, 0.01998, 0.01, 0.05
    corners = [(x, -half, 0.0), (x, half, 0.0), (x, half, top), (x, -half, top), (edge, -half, top), (edge, half, top)]
    mesh = SimpleNamespace(nodes=np.array(corners), surface=np.array([[0, 1, 2], [0, 2, 3], [3, 2, 5], [3, 5, 4]]))
    face = SimpleNamespace(holds=lambda nodes: np.ones(len(nodes), bool), read=np.zeros_like)
    jaw = SimpleNamespace(build_mesh=lambda density: mesh, face=face, inner_face_x=x)
    inner = build_inner_face(jaw, "default")
    np.testing.assert_allclose(inner.weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(
        inner.deform(mesh.nodes), np.column_stack((np.full(len(inner.heights), x), inner.heights))
    )


class TestInnerFace:
    def test_line_at_rest_is_the_plane_of_the_inner_face(self):
        line = INNER.deform(NODES)
        np.testing.assert_allclose(line, np.stack([np.full(len(line), FACE), INNER.heights], axis=1), atol=1e-12)

    def test_line_follows_a_rigid_motion(self):
        R = Rotation.from_euler("y", 0.2).as_matrix()
        expected = (np.stack([np.full(len(INNER.heights), FACE), 0 * INNER.heights, INNER.heights], 1) @ R.T)[:, [0, 2]]
        np.testing.assert_allclose(INNER.deform(NODES @ R.T), expected, atol=1e-12)

    @pytest.mark.parametrize("density", ["coarse", "fine"])
    def test_line_does_not_depend_on_the_mesh(self, density):
        other = build_inner_face(JAW, density)
        surface = bent(other.mesh.nodes, 2 * MM, 0.04)
        # what linear interpolation between nodes 3 mm apart makes of a bump 10 mm wide
        np.testing.assert_allclose(other.deform(surface), INNER.deform(bent(NODES, 2 * MM, 0.04)), atol=0.1 * MM)

    def test_another_surface_is_refused_and_the_mesh_setting_named(self):
        with pytest.raises(MeshError, match="mesh setting"):
            INNER.check_surface(NODES[:-1])
        with pytest.raises(MeshError, match="not finite"):
            INNER.check_surface(np.where(NODES.max() == NODES, np.nan, NODES))


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
        np.testing.assert_allclose(compute_gaps(INNER.deform(NODES), section.edges), 0.0185 - FACE, atol=1e-5)

    def test_points_within_the_outline_are_counted_but_not_those_in_its_holes(self):
        square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
        edges = edges_of((square, 1.0 + 0.5 * square[::-1]))
        assert count_inside(np.array([[0.5, 2.0], [2.0, 2.0], [3.5, 2.0], [5.0, 2.0]]), edges) == 2

    def test_distance_is_that_to_the_nearest_edge(self):
        edges = edges_of((np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]),))
        np.testing.assert_allclose(distances_to(np.array([[0.5, -2.0], [4.0, -4.0]]), edges), [2.0, 5.0], atol=1e-12)


class TestRows:
    def test_overlap_does_not_depend_on_a_shift_along_x(self):
        gaps = np.array([3e-3, 1e-3, 1.1e-3, np.inf])
        expected = [0.0, 0.2e-3, 0.1e-3, 0.0]
        for shift in (-1e-3, 0.0, 5e-3):
            np.testing.assert_allclose(overlap_of(gaps + shift, 0.2e-3), expected, atol=1e-15)

    def test_mean_of_the_rows_is_that_of_the_overlap(self):
        heights = np.arange(0.0, 0.08, 0.5e-3)
        overlap = np.maximum(0.0, 1.0 - ((heights - 0.03) / 0.02) ** 2)
        rows = patch_from_overlap(heights, overlap, 2.5 * MM, 5 * MM)
        assert rows.mean == pytest.approx(heights @ overlap / overlap.sum(), abs=1e-12)
        assert rows.weights.sum() == pytest.approx(1.0)
        assert np.diff(rows.heights).max() < 3 * MM

    def test_narrow_contact_is_one_row_and_two_contacts_are_two(self):
        heights = np.arange(0.0, 0.08, 0.5e-3)
        overlap = np.zeros(len(heights))
        overlap[20:26] = 1.0
        assert len(patch_from_overlap(heights, overlap, 2.5 * MM, 5 * MM).heights) == 1
        overlap[100:103] = 2.0
        rows = patch_from_overlap(heights, overlap, 2.5 * MM, 5 * MM)
        np.testing.assert_allclose(rows.heights, [heights[20:26].mean(), heights[101]], atol=1e-12)
        np.testing.assert_allclose(rows.weights, [0.5, 0.5], atol=1e-12)

    @pytest.mark.parametrize("mean", [0.021, 0.03, 0.0389])
    def test_tilted_rows_have_the_mean_asked_for_and_stay_where_they_are(self, mean):
        rows = ContactPatch(heights=np.linspace(0.02, 0.04, 9), weights=np.full(9, 1 / 9))
        tilted = tilt_patch(rows, mean)
        assert tilted.mean == pytest.approx(mean, abs=1e-7)
        assert tilted.weights.min() >= 0.0
        np.testing.assert_array_equal(tilted.heights, rows.heights)

    def test_mean_beyond_the_rows_is_one_row_there(self):
        rows = ContactPatch(heights=np.array([0.02, 0.03]), weights=np.array([0.5, 0.5]))
        assert tilt_patch(rows, 0.031).heights.tolist() == [0.031]

    @pytest.mark.parametrize("lean", [-0.5, 0.0, 0.4])
    def test_line_of_action_meets_the_surface_in_the_pressure_centre(self, lean):
        line = INNER.deform(bent(NODES, 6 * MM, 0.04))
        found = cross_line_of_action(line, INNER.heights, *push_at(line, 0.034, lean=lean), 0.035)
        assert found == pytest.approx(0.034, abs=1e-9)

    def test_line_of_action_beside_the_jaw_meets_nothing(self):
        force, torque = np.array([-1.0, 0.0, 0.0]), np.array([0.0, -0.2, 0.0])
        assert np.isnan(cross_line_of_action(INNER.deform(NODES), INNER.heights, force, torque, 0.04))


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
        line = INNER.deform(NODES)
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


class TestOutline:
    @pytest.mark.parametrize("x", [FACE + 0.0125 - 3 * MM, FACE + 0.0125, FACE + 0.05])
    def test_place_of_a_cylinder_is_its_height_wherever_it_is_along_x(self, x):
        place = locate(cylinder(), pose(x, 0.0412))
        assert place.patch.heights == pytest.approx([0.0412], abs=0.1 * MM)
        assert place.gap == pytest.approx(x - 0.0125 - FACE, abs=0.02 * MM)

    def test_box_touches_along_its_face_in_rows_with_even_weights(self):
        place = locate(box(), pose(FACE + 0.015, 0.045))
        assert place.patch.heights[0] < 0.0325 and place.patch.heights[-1] > 0.0575
        assert np.diff(place.patch.heights).max() <= 2.5 * MM + 1e-9
        assert place.patch.mean == pytest.approx(0.045, abs=0.3 * MM)
        assert np.ptp(place.patch.weights) < 0.3 * place.patch.weights.mean()

    def test_tilted_box_touches_with_its_edge(self):
        # tilted from x to z the face leans, its lower edge goes first
        place = locate(box(), pose(0.04, 0.045, tilt=np.radians(20)))
        corner = pose(0.0, 0.045, tilt=np.radians(20)) @ [-0.015, 0.0, -0.015, 1.0]
        other = pose(0.0, 0.045, tilt=np.radians(20)) @ [-0.015, 0.0, 0.015, 1.0]
        leading = corner if corner[0] < other[0] else other
        assert place.patch.mean == pytest.approx(leading[2], abs=0.5 * MM)

    def test_two_bumps_are_two_contacts(self):
        mesh = joined(box((0.01, 0.03, 0.004), (0, 0, -0.015)), box((0.01, 0.03, 0.004), (0, 0, 0.015)))
        place = locate(mesh, pose(FACE + 0.005, 0.04))
        np.testing.assert_allclose(place.patch.heights, [0.025, 0.055], atol=0.3 * MM)
        np.testing.assert_allclose(place.patch.weights, [0.5, 0.5], atol=0.1)

    def test_object_above_the_jaw_has_no_place(self):
        assert locate(box(), pose(0.03, 0.13)) is None

    def test_place_is_on_the_material_that_the_bent_jaw_brings_there(self):
        surface = bent(NODES, 3 * MM, 0.04)
        surface[:, 2] += 4 * MM
        assert locate(cylinder(), pose(0.03, 0.064), surface).patch.mean == pytest.approx(0.06, abs=0.3 * MM)

    @pytest.mark.parametrize("noise", [-0.3 * MM, 0.3 * MM])
    def test_noise_along_x_moves_no_place_and_noise_along_z_no_more_than_itself(self, noise):
        radius, x = 0.0175, FACE + 0.0175 - 4 * MM
        surface = wrapped(NODES, radius, x, 0.04)
        still = locate(cylinder(radius), pose(x, 0.04), surface)
        pushed = locate(cylinder(radius), pose(x + noise, 0.04), surface)
        assert pushed.patch.mean == pytest.approx(still.patch.mean, abs=1e-9)
        assert pushed.gap - still.gap == pytest.approx(noise, abs=1e-9)
        lifted = locate(cylinder(radius), pose(x, 0.04 + 0.2 * noise), surface)
        # where the face is wrapped by 7 mm to either side, the shape alone tells the place only roughly
        assert abs(lifted.patch.mean - still.patch.mean) < 2.5 * MM

    def test_rows_follow_the_line_of_action_within_the_overlap(self):
        mesh, T = box(), pose(FACE + 0.015, 0.045)
        gain = WRENCH_GAIN
        place = locate(mesh, T, wrench=push_at(INNER.deform(NODES), 0.039))
        shape = locate(mesh, T).patch.mean
        assert place.patch.mean == pytest.approx(shape + gain * (0.039 - shape), abs=1e-6)
        assert len(place.patch.heights) == len(locate(mesh, T).patch.heights)

    def test_line_of_action_far_from_the_object_is_not_believed(self):
        T = pose(FACE + 0.0125, 0.045)
        place = locate(cylinder(), T, wrench=push_at(INNER.deform(NODES), 0.02))
        assert place.patch.mean == pytest.approx(0.045, abs=0.1 * MM)

    def test_force_too_weak_has_no_line_of_action(self):
        T = pose(FACE + 0.015, 0.045)
        weak = push_at(INNER.deform(NODES), 0.035, size=0.9 * WRENCH_FORCE)
        assert locate(box(), T, wrench=weak).patch.mean == pytest.approx(locate(box(), T).patch.mean)

    def test_open_mesh_has_the_same_place(self):
        T = pose(FACE + 0.0125, 0.0412)
        assert locate(opened(cylinder()), T).patch.mean == pytest.approx(0.0412, abs=0.2 * MM)

    def test_right_jaw_has_the_same_place(self):
        face = build_inner_face(JAW.mirrored(), "default")
        T = pose(FACE + 0.0125, 0.0412)
        section = SectionKeeper(cylinder(), face.half_width).at(T)
        scene = ContactScene(T=T, section=section, surface=face.mesh.nodes, line=face.deform(face.mesh.nodes))
        assert OutlineLocalizer(face).locate(scene).patch.mean == pytest.approx(0.0412, abs=0.1 * MM)


class TestClosest:
    def test_nearest_candidate_of_the_undeformed_surface_is_taken(self):
        localizer = ClosestLocalizer(JAW, INNER)
        for x in (FACE + 0.0125 - 2 * MM, FACE + 0.03):
            place = localizer.locate(scene_of(cylinder(), pose(x, 0.0412), bent(NODES, 2 * MM, 0.04)))
            assert place.patch.heights.tolist() == [pytest.approx(0.043)]

    def test_distance_counts_not_the_way_along_x(self):
        # beyond the tip the nearest point is the tip's end, whatever is before the surface along x
        mesh = joined(box((0.01, 0.03, 0.01), (0.03, 0.0, 0.03)), box((0.01, 0.03, 0.01), (0.0, 0.0, 0.087)))
        place = ClosestLocalizer(JAW, INNER).locate(scene_of(mesh, pose(FACE, 0.0)))
        assert place.patch.mean == pytest.approx(JAW.candidates[-1, 2])


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
        place = localizer.locate(scene_of(cylinder(), pose(0.06, 0.0412)))
        assert place.patch.heights.tolist() == [pytest.approx(0.043)]
        assert place.touching is False

    def test_shift_before_contact_is_equation_two(self, localizer):
        expected = FACE - OFFSET + 0.0125
        assert localizer._slight_contact(pose(0.06, 0.04)) == pytest.approx(expected, abs=1e-12)

    def test_shift_goes_by_the_middle_of_an_object_whose_origin_is_elsewhere(self):
        pytest.importorskip("manifold3d")
        localizer = IntersectionLocalizer(JAW, INNER, box((0.02, 0.03, 0.03), (0.004, 0.0, 0.0)))
        assert localizer._slight_contact(pose(0.06, 0.04)) == pytest.approx(FACE - 1 * MM + 0.006, abs=1e-12)

    def test_status_turns_false_after_an_empty_intersection_and_the_place_is_kept(self, localizer):
        far = scene_of(cylinder(), pose(0.06, 0.0412))
        first, second = localizer.locate(far), localizer.locate(far)
        assert localizer._status is False
        assert second.patch.heights.tolist() == first.patch.heights.tolist()

    def test_touching_is_an_intersection_where_the_object_is(self, localizer):
        scene = scene_of(cylinder(), pose(FACE + 0.0125 - 0.5 * MM, 0.0412))
        localizer.locate(scene)
        assert localizer.locate(scene).touching is True

    def test_bent_jaw_keeps_its_contact_when_one_intersection_was_empty(self, localizer):
        surface = wrapped(NODES, 0.0125, FACE + 0.0125 - 5 * MM, 0.0412)
        localizer.locate(scene_of(cylinder(), pose(FACE + 0.0125 - 4.8 * MM, 0.0412), surface))
        assert localizer._status is False
        assert localizer.locate(scene_of(cylinder(), pose(FACE + 0.0125 - 5.2 * MM, 0.0412), surface)).touching is True

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
