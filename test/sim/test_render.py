from dataclasses import replace

import numpy as np
import pytest

from finforce.camera import CameraIntrinsics, project
from finforce_sim.render import (
    FAR,
    PATTERNS,
    Body,
    Decal,
    Exposure,
    Light,
    Lighting,
    Paint,
    RenderedScene,
    draw_background,
    draw_jaw_paint,
    draw_look,
)
from finforce_sim.sensor import expose, measure_depth
from finforce_sim.simulated_camera import _BOX, _BOX_TRIANGLES

CAMERA = CameraIntrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
WHITE = Paint(color=np.full(3, 0.8), gloss=0.0, grain=0.0)
EVEN = Exposure(blur=0.4, vignetting=0.0, white=np.ones(3))
PLAIN = Lighting(
    ambient=np.full(3, 0.5),
    lights=(),
    background=np.zeros((384, 384, 3)),
    background_distance=10.0,
    exposure=EVEN,
)


def box(low, high, paint=WHITE, decals=()):
    rest = np.asarray(low) + _BOX * (np.asarray(high) - np.asarray(low))
    return Body(vertices=rest, triangles=_BOX_TRIANGLES, rest=rest, paint=paint, decals=decals)


def render(bodies, look=PLAIN, rows=slice(None)):
    return RenderedScene(bodies, look, np.eye(3), np.zeros(3)).render(CAMERA, rows)


SLAB = box([-0.02, -0.02, 0.10], [0.02, 0.02, 0.11])


def test_depth_is_that_of_the_face_and_edges_lie_where_they_are_projected():
    picture = render([SLAB])
    inside = picture.depth < 0.5 * FAR
    np.testing.assert_allclose(picture.depth[inside], 0.10, atol=1e-6)  # float32 rays
    assert (picture.depth[~inside] == FAR).all()
    corners = project(np.array([[-0.02, -0.02, 0.10], [0.02, 0.02, 0.10]]), CAMERA)
    rows, columns = np.nonzero(inside)
    found = np.array([[columns.min() - 0.5, rows.min() - 0.5], [columns.max() + 0.5, rows.max() + 0.5]])
    np.testing.assert_allclose(found, corners, atol=0.5)  # of a pixel, by its centre


def test_edge_pixels_mix_what_is_on_both_sides():
    picture = render([box([-0.0201, -0.0201, 0.10], [0.0199, 0.0199, 0.11])])
    level = picture.color[60, :, 0]
    full = level[80]
    mixed = (level > 0.05 * full) & (level < 0.95 * full)
    assert 1 <= mixed.sum() <= 2


def test_a_body_before_another_hides_it():
    near = box([-0.005, -0.02, 0.08], [0.005, 0.02, 0.09])
    stage = RenderedScene([SLAB, near], PLAIN, np.eye(3), np.zeros(3))
    points = np.array([[0.0, 0.0, 0.10], [0.015, 0.0, 0.10]])
    np.testing.assert_array_equal(stage.sees(points), [False, True])
    np.testing.assert_array_equal(RenderedScene([SLAB], PLAIN, np.eye(3), np.zeros(3)).sees(points), [True, True])


def test_a_lamp_casts_a_shadow_and_one_without_shadows_does_not():
    lamp = Light(direction=np.array([0.7, 0.0, -0.714]), color=np.ones(3))
    near = box([0.004, -0.01, 0.09], [0.006, 0.01, 0.099])
    brightness = []
    for light in (lamp, replace(lamp, casts_shadow=False)):
        picture = render([SLAB, near], replace(PLAIN, lights=(light,)))
        brightness.append(picture.color[60, 80, 0])
    assert brightness[0] < 0.5 * brightness[1]


def test_a_decal_is_round_and_of_its_colour():
    decal = Decal(centre=np.array([0.0, 0.0, 0.10]), radius=4e-3, color=np.array([0.1, 0.0, 0.0]))
    picture = render([box([-0.02, -0.02, 0.10], [0.02, 0.02, 0.11], decals=(decal,))])
    red = (picture.color[..., 1] == 0.0) & (picture.depth < 0.5 * FAR)
    expected = np.pi * (4e-3 / 0.10 * 150.0) ** 2
    assert red.sum() == pytest.approx(expected, rel=0.15)  # 36 pixels across its border


def test_some_rows_are_those_of_the_whole_image():
    np.testing.assert_array_equal(render([SLAB], rows=slice(40, 80)).color, render([SLAB]).color[40:80])


@pytest.mark.parametrize("pattern", PATTERNS)
def test_paint_sticks_to_the_body_and_stays_a_colour(pattern):
    paint = Paint(color=np.array([0.7, 0.2, 0.1]), second=np.array([0.0, 0.3, 0.9]), pattern=pattern, size=3e-3)
    places = np.random.default_rng(0).uniform(-0.03, 0.03, (500, 3))
    colors = paint.colors_at(places)
    np.testing.assert_array_equal(colors, paint.colors_at(places))
    assert colors.min() >= 0.0 and colors.max() < 1.0
    varied = np.ptp(colors[:, 0])
    assert varied < 0.1 if pattern == "plain" else varied > 0.3


def test_looks_and_paints_follow_their_seed():
    one, other = (draw_look(np.random.default_rng(seed)) for seed in (1, 2))
    np.testing.assert_array_equal(one.background, draw_look(np.random.default_rng(1)).background)
    assert not np.array_equal(one.background, other.background)
    assert draw_jaw_paint(np.random.default_rng(1)).color.min() >= 0.0
    assert np.isfinite(draw_background(np.random.default_rng(3))).all()


def test_an_unknown_light_is_not_drawn():
    with pytest.raises(KeyError):
        draw_look(np.random.default_rng(0), "twilight")


def test_the_camera_makes_a_dim_scene_brighter_and_noisier():
    light = np.full((60, 80, 3), 0.4)
    rng = np.random.default_rng(5)
    bright = expose(light, EVEN, rng)
    dim = expose(light, replace(EVEN, brightness=0.08), rng)
    darkest = expose(light, replace(EVEN, brightness=0.005), rng)
    assert bright.mean() == pytest.approx(dim.mean(), rel=0.1)  # the gain makes up for it
    assert dim.std() > 2.0 * bright.std()
    assert darkest.mean() < 0.6 * dim.mean()  # beyond the largest gain


def test_motion_smears_across_the_way_of_the_motion_only():
    light = np.zeros((60, 80, 3))
    light[:, 40:] = 1.0
    quiet = replace(EVEN, full_well=1e9, read_noise=0.0)

    def width(smear):
        row = expose(light, quiet, np.random.default_rng(0), np.array(smear))[30, :, 0].astype(float)
        return int(((row > 0.2 * row.max()) & (row < 0.8 * row.max())).sum())

    assert width([3.0, 0.0]) > width([0.0, 3.0])


def test_depth_gets_lost_on_dark_flat_surfaces_and_stays_on_textured_ones():
    depth, rng = np.full((120, 160), 0.15), np.random.default_rng(7)
    black = np.zeros((120, 160, 3), dtype=np.uint8)
    speckled = rng.integers(0, 255, (120, 160, 3)).astype(np.uint8)
    lost = [np.isnan(measure_depth(depth, color, CAMERA, rng)).mean() for color in (black, speckled)]
    assert lost[0] > 0.15
    assert lost[1] < 0.03


def test_near_things_look_wider_in_depth_by_a_pixel():
    depth = np.full((120, 160), 0.30)
    depth[:, 60:100] = 0.15
    color = np.random.default_rng(0).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    measured = measure_depth(depth, color, CAMERA, np.random.default_rng(1))
    beside = np.nanmedian(measured[:, [59, 100]])
    assert beside < 0.25  # though the pixel's centre is on the far side
