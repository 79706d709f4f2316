"""Claims about the place at which the measured force meets the jaw."""

from dataclasses import replace

import numpy as np
import pytest
from eval_fakes import BOX, PERIOD, START, make_recording

from finforce_eval.evaluation.pressure_centre import InnerSurface, true_lines
from finforce_eval.recordings.tracks import parse_phases
from finforce_ifea.jaw.section import FaceLine

FACE = 0.014
HEIGHTS = np.linspace(0.0, 0.08, 41)


def strip():
    """Vertices of an inner surface at two sides, and some behind it."""
    front = np.array([[FACE, y, z] for z in HEIGHTS for y in (-0.01, 0.01)])
    return np.vstack([front - [0.002, 0.0, 0.0], front])


def bend(points):
    """A finger bent into a circular arc about its base, 0.2 m in radius, away from the object."""
    radius, angle = 0.2, points[:, 2] / 0.2
    x = FACE - radius + (radius + points[:, 0] - FACE) * np.cos(angle)
    return np.stack([x, points[:, 1], (radius + points[:, 0] - FACE) * np.sin(angle)], axis=1)


def test_line_across_the_undeformed_surface_is_cut_at_its_own_height():
    surface = InnerSurface(strip(), FaceLine.flat(FACE))
    np.testing.assert_allclose(surface.heights, HEIGHTS, atol=1e-9)
    height = surface.cut(strip(), np.array([0.03, 0.0333]), np.array([-1.0, 0.0]))
    assert height == pytest.approx(0.0333, abs=1e-9)


def test_height_is_that_of_the_material_and_not_of_the_place_in_space():
    surface = InnerSurface(strip(), FaceLine.flat(FACE))
    for z in (0.011, 0.05, 0.0777):
        there = bend(np.array([[FACE, 0.0, z]]))[0]
        normal = np.array([np.cos(z / 0.2), np.sin(z / 0.2)])
        height = surface.cut(bend(strip()), there[[0, 2]] + 0.02 * normal, -normal)
        # the chord of a 2 mm edge on a 200 mm arc hides 2.5 um
        assert height == pytest.approx(z, abs=5e-6)
    assert abs(there[2] - z) > 1e-3


def test_first_crossing_along_the_force_counts():
    front = strip()
    # folded back: the upper half lies behind the lower one
    folded = front.copy()
    upper = front[:, 2] > 0.04
    folded[upper, 2] = 0.08 - front[upper, 2]
    folded[upper, 0] -= 0.005
    surface = InnerSurface(front, FaceLine.flat(FACE))
    assert surface.cut(folded, np.array([0.03, 0.02]), np.array([-1.0, 0.0])) == pytest.approx(0.02)
    assert surface.cut(folded, np.array([-0.03, 0.02]), np.array([1.0, 0.0])) == pytest.approx(0.06)


def test_line_that_misses_the_surface_or_is_not_known_has_no_place():
    surface = InnerSurface(strip(), FaceLine.flat(FACE))
    along = np.array([-1.0, 0.0])
    assert np.isnan(surface.cut(strip(), np.array([0.03, 0.09]), along))
    assert np.isnan(surface.cut(strip(), np.array([np.nan, 0.02]), along))
    assert np.isnan(surface.cut(strip(), np.array([0.03, 0.02]), along * np.nan))
    assert np.isnan(InnerSurface(strip(), FaceLine.flat(0.5)).cut(strip(), np.array([0.03, 0.02]), along))


def test_measured_torque_tells_the_line_of_action():
    recording = make_recording()
    track = recording.jaws["left"]
    force = np.tile([-2.0, 0.1, 0.5], (60, 1))
    arm = np.array([0.012, 0.003, 0.045])
    truth = replace(track.truth, force=force, torque=np.cross(arm, force))
    lines = true_lines(
        replace(recording, jaws={"left": replace(track, truth=truth)}, case={}), "left", track.keypoints.stamps_ns, FACE
    )
    away = arm[[0, 2]] - lines.points
    # the line of the in-plane force through the point at which it acts, moment of the force along y included
    across = lines.directions[:, 0] * away[:, 1] - lines.directions[:, 1] * away[:, 0]
    np.testing.assert_allclose(across, 0.0, atol=1e-12)
    np.testing.assert_allclose(lines.directions[0], np.array([-2.0, 0.5]) / np.hypot(2.0, 0.5))


def pressed_cylinder(**case):
    """A recording without torque, 3 frames unloaded, then a ramp to 4 mm over 10 frames, held."""
    recording = make_recording(phases=False)
    track = recording.jaws["left"]
    begins = START + PERIOD * np.array([0, 3, 13, 40, 50])
    texts = ["0:load:0:record", "0:load:4:ramp", "0:load:4:record", "0:unload:0:ramp", "0:unload:0:record"]
    force = track.truth.force * 1.0
    force[:, 2] = -0.1 * force[:, 0]
    truth = replace(track.truth, force=force, torque=np.zeros((60, 3)))
    return replace(
        recording,
        jaws={"left": replace(track, truth=truth)},
        phases=parse_phases(begins.tolist(), texts, "case"),
        case={"object": {"kind": "cylinder", "diameter": 25, "z": 40.0, **case}},
    )


def lines_of(recording):
    return true_lines(recording, "left", recording.jaws["left"].keypoints.stamps_ns, FACE)


def test_force_of_a_frictionless_cylinder_passes_through_its_axis():
    points = lines_of(pressed_cylinder()).points
    np.testing.assert_allclose(points[:, 1], 0.04)
    depth = 1e3 * (FACE + 0.0125 - points[:, 0])
    np.testing.assert_allclose(depth[[0, 3, 8, 13, 30, 45, 55]], [0, 0, 2, 4, 4, 2, 0], atol=1e-9)


@pytest.mark.parametrize("case", [{"kind": "cube"}, {"diameter": None}, {"z": "high"}, {"diameter": True}])
def test_without_torque_other_objects_tell_no_line(case):
    assert np.isnan(lines_of(pressed_cylinder(**case)).points).any(axis=1).all()


def test_without_torque_and_phases_there_is_no_line():
    assert np.isnan(lines_of(replace(pressed_cylinder(), phases=None)).points).all()
    assert np.isnan(lines_of(replace(pressed_cylinder(), case={})).points).all()


def test_magnitude_written_along_x_tells_no_line():
    recording = pressed_cylinder()
    track = recording.jaws["left"]
    truth = replace(track.truth, force=track.truth.force * [1.0, 1.0, 0.0])
    assert np.isnan(lines_of(replace(recording, jaws={"left": replace(track, truth=truth)})).points).all()


def test_unloaded_frame_has_no_direction():
    lines = lines_of(pressed_cylinder())
    assert np.isnan(lines.directions[0]).all()
    np.testing.assert_allclose(np.linalg.norm(lines.directions[5:20], axis=1), 1.0)


def test_ramp_without_end_stays_at_its_begin():
    phases = parse_phases([START, START + PERIOD], ["0:load:2:record", "0:load:4:ramp"], "case")
    stamps = START + PERIOD * np.array([-1, 0, 1, 5])
    np.testing.assert_allclose(phases.displacement_at(stamps), [0.0, 2.0, 2.0, 2.0])


def test_box_of_the_fakes_has_an_inner_surface():
    np.testing.assert_allclose(InnerSurface(BOX, FaceLine.flat(FACE)).heights, [0.0, 0.08])
