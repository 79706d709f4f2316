"""The fin-ray drawing: what it computes and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mechanics_fakes import shoelace_area

from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw.drawing import Band, Drawing, Rib
from finforce_ifea.jaw.jaw import load_jaw

BENCH = load_jaw("bench").drawing
STEEL = load_jaw("steel").drawing
TILTED = replace(
    BENCH,
    ribs=(
        Rib(inner_z=0.012, outer_z=0.020, thickness=0.0012),
        Rib(inner_z=0.030, outer_z=0.028, thickness=0.0008),
        Rib(inner_z=0.050, outer_z=0.061, thickness=0.0010),
    ),
)


@pytest.mark.parametrize("rib", TILTED.ribs + BENCH.ribs)
def test_rib_edges_keep_the_thickness_normal_to_the_rib(rib):
    lower, upper = TILTED.rib_edges(rib)
    along = lower[1] - lower[0]
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    for corner in upper:
        assert abs(np.dot(corner - lower[0], normal)) == pytest.approx(rib.thickness, rel=1e-12)


@pytest.mark.parametrize("rib", TILTED.ribs)
def test_rib_edges_end_on_the_backs_of_the_bands(rib):
    edges = TILTED.rib_edges(rib)
    for column, band in enumerate((TILTED.inner, TILTED.outer)):
        x, z = edges[:, column].T
        np.testing.assert_allclose(x, band.back_x(z), atol=1e-15)


@pytest.mark.parametrize("number", range(3))
def test_rib_centre_line_passes_through_both_junctions(number):
    lower, upper = TILTED.rib_edges(TILTED.ribs[number])
    inner, outer = TILTED.junctions[:, number]
    centre = (inner + outer) / 2
    area_below = shoelace_area([lower[0], lower[1], outer, inner])
    area_above = shoelace_area([upper[0], upper[1], outer, inner])
    assert area_below == pytest.approx(area_above, rel=0.05)
    assert lower[:, 1].mean() < centre[1] < upper[:, 1].mean()


def test_arc_lengths_become_heights_on_the_leaning_strip():
    ends = STEEL.junctions
    strip_base, strip_tip = np.array([-0.03662, 0.0]), np.array([0.03662, 0.15016])
    along = (strip_tip - strip_base) / np.linalg.norm(strip_tip - strip_base)
    arcs = np.array([0.04567, 0.07869, 0.1075, 0.13227])
    np.testing.assert_allclose(ends[1], strip_base + arcs[:, None] * along, atol=1e-9)
    np.testing.assert_allclose(ends[0, :, 1], [0.027, 0.054, 0.081, 0.108])


def test_strips_of_the_steel_finger_meet_in_the_apex():
    assert STEEL.inner.centre_x(STEEL.length) == pytest.approx(0.03662, abs=1e-12)
    assert STEEL.outer.centre_x(STEEL.length) == pytest.approx(0.03662, abs=1e-12)
    assert STEEL.outer.normal_thickness == pytest.approx(0.0002, rel=1e-4)


def test_only_the_bench_finger_is_solid():
    assert BENCH.is_solid
    assert not STEEL.is_solid
    assert not replace(BENCH, joints="hinged").is_solid
    assert not replace(BENCH, tip_z=None).is_solid


@given(x=st.floats(-0.05, 0.05), y=st.floats(-0.03, 0.03), z=st.floats(-0.02, 0.1), nudge=st.floats(-1e-3, 1e-3))
def test_distance_grows_no_faster_than_the_way_walked(x, y, z, nudge):
    points = np.array([[x, y, z], [x + nudge, y, z], [x, y + nudge, z], [x, y, z + nudge]])
    distances = TILTED.distance_to(points)
    assert (distances >= 0).all()
    assert (abs(distances[1:] - distances[0]) <= abs(nudge) + 1e-12).all()


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.0135, 0.0, 0.04), 0.0),
        ((-0.0072, 0.0, 0.022), 0.0),
        ((0.015, 0.0, 0.04), 0.001),
        ((0.0135, 0.013, 0.04), 0.003),
        ((0.0, 0.0, 0.009), 0.0),
        ((0.0, 0.0, 0.0110), 0.0015),
        ((0.012, 0.01, 0.08), 0.0),
        ((0.012, 0.0, 0.085), 0.005),
    ],
)
def test_distance_of_known_points(point, distance):
    assert BENCH.distance_to(np.array([point]))[0] == pytest.approx(distance, abs=1e-12)


def test_points_on_a_line_without_thickness_are_on_the_finger():
    middle = STEEL.junctions.mean(axis=0)
    points = np.column_stack([middle[:, 0], np.zeros(4), middle[:, 1]])
    np.testing.assert_allclose(STEEL.distance_to(points), 0.0, atol=1e-12)


def test_points_on_the_line_of_a_bar_but_beyond_its_end_are_off_the_finger():
    finger = replace(STEEL, ribs=(Rib(inner_z=0.05, outer_z=0.05, thickness=0.0),))
    distance = finger.distance_to(np.array([[finger.inner_face_x + 0.01, 0.0, 0.05]]))[0]
    assert distance == pytest.approx(0.01)


LEANING = Band(base=(0.014, 0.0), tip=(0.013, 0.08), thickness=0.0016, inward=-1)
WIDE = Band(base=(-0.014, 0.0), tip=(0.0125, 0.08), thickness=0.0016, inward=1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 0.0}, "drawing.width: got 0.0"),
        ({"width": float("nan")}, "drawing.width: got nan"),
        ({"inner": replace(BENCH.inner, thickness=-1e-3)}, "inner_band.thickness: got -0.001"),
        ({"clamped_z": -1e-3}, "clamped_z: got -0.001"),
        ({"clamped_z": 0.08}, "clamped_z: got 0.08"),
        ({"clamped_z": 0.009}, "rib 1 begins at z = 8.5 mm on the inner band, but the clamped part"),
        ({"tip_z": 0.09}, "solid from z = 0.09"),
        ({"tip_z": 0.066}, "rib 7 reaches z = 66.5 mm on the inner band"),
        ({"inner": LEANING}, "leans"),
        ({"outer": WIDE}, "overlap"),
        ({"ribs": BENCH.ribs[::-1]}, "rib 2 begins"),
        ({"ribs": (Rib(inner_z=0.02, outer_z=0.02, thickness=0.0),)}, "ribs.thickness"),
        ({"ribs": (BENCH.ribs[0], Rib(inner_z=0.018, outer_z=0.0095, thickness=0.001))}, "outer band"),
    ],
)
def test_what_cannot_be_drawn_is_refused(change, words):
    with pytest.raises(JawFileError, match=words):
        replace(BENCH, **change)


def test_strips_that_cross_are_refused():
    crossing = Band(base=(-0.03662, 0.0), tip=(0.04, 0.15016), thickness=0.0002, inward=1)
    with pytest.raises(JawFileError, match="cross"):
        replace(STEEL, outer=crossing)


def test_a_finger_without_ribs_is_allowed():
    assert Drawing(length=0.08, width=0.02, inner=BENCH.inner, outer=BENCH.outer, tip_z=0.07).ribs == ()
