"""Pictures of random fingers for training, rendered square to their side plane: `python -m lab.training.scenes FOLDER`.

Each finger is drawn by chance, bends under loads by chance, and stands in several scenes with materials, lights,
background, things and a camera place of their own. The camera is a virtual one that looks square at the side plane
from the real one's place: its image is the rectified picture.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, project
from finforce.optional import import_cv2
from finforce_eval.cli.parser import add_engine_options, read_engine, whole_number
from finforce_eval.tasks import EngineOptions, Task
from finforce_keypoints.geometry.side_picture import PlaneGrid
from finforce_keypoints.geometry.template import MARK_RADIUS, SideShape, draw_template, fit_grid
from finforce_sim.objects import OBJECT_NAMES, build_object
from finforce_sim.render import (
    Body,
    Decal,
    Lighting,
    Paint,
    RenderedScene,
    draw_color,
    draw_jaw_paint,
    draw_look,
    draw_paint,
)
from finforce_sim.sensor import expose
from finforce_sim.simulated_camera import build_box
from lab.training.commands import one_line_errors, read_share
from lab.training.fingers import FIRST_VALIDATION, SEED, BentFinger, draw_finger, outline
from lab.training.pictures import MARGIN, TRAIN, VALIDATION, FingerPictures, make_all, save_shard

STATES = 8  # pictures of a finger
KEYPOINTS, ANYWHERE = 24, 72  # points of a picture: key points with the mark, and points anywhere on the material
BARS = 0.35  # share of the pictures with something between camera and finger
HELD = 0.6  # share of the pictures of a grasp as the camera on a wrist sees it: aslant, a held object that juts out
ALIKE = 0.3  # share of the held objects that look much like the finger
NO_MARK = 0.08  # share of the fingers whose holder has no dot
R_CAMERA_JAW = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # square at the side, x right, z down
TEXTURES = Path(__file__).parent / "textures"


@dataclass(frozen=True, kw_only=True, eq=False)
class _PicturePaint:
    """A surface that shows a photograph, laid on from its three sides.

    Attributes:
        image: (s, s, 3) linear.
        size: [m] that it covers before it repeats.
        gloss, sharpness: of the highlight.
    """

    image: NDArray
    size: float
    gloss: float
    sharpness: float

    def colors_at(self, places: NDArray) -> NDArray:
        """Return the colours (n, 3) at places (n, 3) [m] of the body at rest."""
        across = places[:, [0, 2]] + 0.37 * places[:, [1]]
        index = np.floor(across / self.size * len(self.image)).astype(int) % len(self.image)
        return self.image[index[:, 1], index[:, 0]]


@lru_cache(maxsize=1)
def load_textures() -> list[NDArray]:
    """Return the photographs (s, s, 3), linear light."""
    cv2 = import_cv2()
    files = sorted(TEXTURES.glob("*.jpg"))
    return [(cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) / 255.0) ** 2.2 for file in files]


def _draw_texture(rng: np.random.Generator) -> NDArray:
    """Return a photograph, turned, cut and coloured by chance."""
    textures = load_textures()
    image = np.rot90(textures[rng.integers(len(textures))], rng.integers(4))
    if rng.random() < 0.5:
        image = image[:, ::-1]
    size = int(rng.uniform(0.35, 1.0) * len(image))
    row, column = rng.integers(0, len(image) - size + 1, 2)
    image = image[row : row + size, column : column + size]
    return np.clip(image[..., rng.permutation(3)] * np.exp(rng.normal(0.0, 0.5, 3)), 0.0, 1.0)


def _draw_any_paint(rng: np.random.Generator) -> Paint | _PicturePaint:
    if rng.random() < 0.4:
        size = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
        return _PicturePaint(
            image=_draw_texture(rng), size=size, gloss=rng.uniform(0.0, 0.6), sharpness=rng.uniform(5, 80)
        )
    return draw_paint(rng)


def _draw_finger_paint(rng: np.random.Generator, *, steel: bool) -> Paint:
    """Return the paint of a finger: printed in any colour, black, white, translucent and glossy, or bare metal."""
    paint = draw_jaw_paint(rng)
    chance = rng.random()
    if steel or chance < 0.06:
        grey = rng.uniform(0.15, 0.7) * (1.0 + rng.normal(0.0, 0.03, 3))
        return replace(
            paint, color=grey, pattern="plain", gloss=rng.uniform(0.3, 1.2), sharpness=rng.uniform(10.0, 120.0)
        )
    if chance < 0.22:  # black
        return replace(
            paint, color=rng.uniform(0.008, 0.04) * np.ones(3), pattern="plain", gloss=rng.uniform(0.05, 0.5)
        )
    if chance < 0.36:  # white or clear
        return replace(paint, color=rng.uniform(0.5, 0.95) * (1.0 + rng.normal(0.0, 0.03, 3)), pattern="plain")
    if chance < 0.5:
        return replace(paint, gloss=rng.uniform(0.4, 1.2), sharpness=rng.uniform(20.0, 200.0))
    return paint


@dataclass(frozen=True, kw_only=True, eq=False)
class _Solid:
    """An extruded finger: its section's vertices (n, 2) [m], half its width (n,) [m] there, and its triangles."""

    section: NDArray
    triangles: NDArray
    half: NDArray

    def rest(self) -> NDArray:
        """Return the vertices (2 n, 3) at rest."""
        return self.raise_vertices(self.section)

    def raise_vertices(self, places: NDArray) -> NDArray:
        """Return the vertices (2 n, 3) [m] on both sides for places (n, 2) [m] of the section."""
        sides = [np.insert(places, [1], y[:, None], axis=1) for y in (-self.half, self.half)]
        return np.vstack(sides)


def extrude(rings: Sequence[NDArray], half: Callable[[NDArray], NDArray]) -> _Solid:
    """Return what is inside some rings (n, 2) [m] as a surface that can bend, so wide as `half` says of heights."""
    points = np.vstack(rings)
    count = len(points)
    cells = shapely.constrained_delaunay_triangles(shapely.Polygon(rings[0], rings[1:])).geoms
    corners = np.array([np.array(cell.exterior.coords)[:3] for cell in cells])
    keys = {tuple(point): number for number, point in enumerate(points.tolist())}
    caps = np.array([[keys[tuple(corner)] for corner in cell] for cell in corners.tolist()])
    first, second = points[caps[:, 1]] - points[caps[:, 0]], points[caps[:, 2]] - points[caps[:, 0]]
    turned = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0.0
    caps[turned] = caps[turned][:, [0, 2, 1]]
    start, sides = 0, []
    for ring in rings:
        index = start + np.arange(len(ring))
        following = np.roll(index, -1)
        sides += [np.column_stack((index, index + count, following))]
        sides += [np.column_stack((following, index + count, following + count))]
        start += len(ring)
    # seen from +y, x to the right and z down: what is counterclockwise in (x, z) is clockwise there
    triangles = np.vstack((caps + count, caps[:, ::-1], *sides))
    return _Solid(section=points, triangles=triangles, half=half(points[:, 1]))


def _box(low: ArrayLike, high: ArrayLike, paint: Paint | _PicturePaint, decals: tuple[Decal, ...] = ()) -> Body:
    """Return a box of two corners (3,) [m], jaw frame."""
    return build_box(np.array([low, high], dtype=float), np.eye(4), paint, decals)


def _rod(rng: np.random.Generator, radius: NDArray, half: float, *, round_: bool) -> _Solid:
    """Return a cylinder or a turned box along y, of some radius and half length [m]."""
    if round_:
        angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
        line = np.column_stack((np.cos(angles), np.sin(angles))) * radius
    else:
        turn = rng.uniform(-0.5, 0.5) if rng.random() < 0.5 else 0.0
        c, s = np.cos(turn), np.sin(turn)
        line = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * radius @ np.array([[c, s], [-s, c]])
    return extrude([line], lambda z: np.full(len(z), half))


class FingerScenes:
    """Draw the pictures of one finger, the same for the same seed.

    Args:
        seed: of finger and scenes.
        held: share of the pictures that show a grasp as the camera on a wrist sees it.
    """

    def __init__(self, seed: int, held: float = HELD) -> None:
        self._rng = rng = np.random.default_rng((SEED, seed))
        self._held = held
        self._finger = finger = draw_finger(rng)
        self._bent = BentFinger(finger, rng)
        self._solid = extrude(outline(finger), finger.half_width)
        self._attached = self._bent.attach(self._solid.section)
        self.shape = SideShape(
            rings=outline(finger), clamped_z=finger.clamped_z, reference=finger.reference, bolts=finger.bolts
        )
        self.grid = fit_grid(self.shape)
        self._marked = rng.random() > NO_MARK

    def draw(self) -> FingerPictures:
        """Return the pictures of this finger."""
        rng, finger = self._rng, self._finger
        states: list[NDArray | None] = [None]
        while len(states) < STATES:
            place, spread = rng.uniform(0.1, 1.0) * finger.length, rng.uniform(0.02, 0.15) * finger.length
            largest = rng.uniform(0.03, 0.2) * finger.length
            found = self._bent.bend(place, spread, rng.normal(0.0, 0.25), largest, 3)
            states += [found[k] for k in rng.permutation(len(found))[:2]] or [None]
        drawn = [self._picture(state) for state in states[:STATES]]
        template = draw_template(self.shape, self.grid)
        pictures, rest, places, visible = (np.stack(column) for column in zip(*drawn, strict=True))
        return FingerPictures(
            picture=pictures,
            rest=rest.astype(np.float32),
            place=places.astype(np.float32),
            visible=visible,
            template=template[None],
            finger=np.zeros(len(pictures), int),
            keypoints=np.full(len(pictures), min(KEYPOINTS, len(self._finger.keypoints) + 1)),
        )

    def _picture(self, state: NDArray | None) -> tuple[NDArray, ...]:
        """Return one picture, its points at rest and where they are [px], and which of them can be seen."""
        rng, finger, grid = self._rng, self._finger, self.grid.padded(MARGIN)
        bend = (lambda points, attached: points) if state is None else (lambda _, a: self._bent.places(a, state))
        section = bend(self._solid.section, self._attached)
        rest = self._choose_points()
        places = bend(rest, self._bent.attach(rest))
        places[0] = rest[0] = finger.reference
        side_y = float(finger.half_width(finger.keypoints[:, 1]).mean())
        held = self._held > 0.0 and bool(rng.random() < self._held)
        camera, centre = self._draw_camera(grid, side_y, held=held)
        bodies, (look, R) = self._build(section, side_y, held=held)
        moved = [replace(body, vertices=(body.vertices - centre) @ R_CAMERA_JAW.T) for body in bodies]
        scene = RenderedScene(moved, look, R, R_CAMERA_JAW @ -centre)
        color = expose(scene.render(camera).color, look.exposure, rng)
        points = (np.insert(places, [1], finger.half_width(rest[:, 1])[:, None], axis=1) - centre) @ R_CAMERA_JAW.T
        pixels = project(points, camera)
        inside = ((pixels >= 0.0) & (pixels <= np.array([grid.width, grid.height]) - 1.0)).all(axis=1)
        visible = inside & scene.sees(points, 0.6e-3)
        visible[0] &= self._marked
        return color, self.grid.pixels(rest), pixels, visible

    def _choose_points(self) -> NDArray:
        """Return points (KEYPOINTS + ANYWHERE, 2) [m] on the finger: the mark, the tip, key points, and any."""
        rng, finger = self._rng, self._finger
        count = len(finger.keypoints)
        order = rng.permutation(count - 1)[: KEYPOINTS - 2]
        chosen = [finger.reference, finger.keypoints[-1], *finger.keypoints[order]]
        low, high = self.shape.bounds
        extra = rng.integers(0, len(self._solid.section), KEYPOINTS + ANYWHERE - len(chosen))
        anywhere = self._solid.section[extra]
        inner = np.array(shapely.points(rng.uniform(low, high, (600, 2))))
        inner = inner[shapely.contains(self._finger.polygon, inner)][: ANYWHERE // 2]
        anywhere[len(anywhere) - len(inner) :] = shapely.get_coordinates(inner)
        return np.vstack((chosen, anywhere))

    def _draw_camera(self, grid: PlaneGrid, side_y: float, *, held: bool) -> tuple[CameraIntrinsics, NDArray]:
        """Return the virtual camera and its centre (3,) [m] in the jaw frame."""
        rng, length = self._rng, self._finger.length
        if held:
            away, steep = rng.uniform(0.06, 0.14), np.array([rng.uniform(-0.15, 0.6), rng.uniform(-1.5, -0.5)])
        else:
            away = max(0.05, length) * rng.uniform(0.8, 3.5)
            steep = np.array([np.clip(rng.normal(0.0, 0.35), -0.9, 0.9), np.clip(rng.normal(-0.25, 0.55), -1.4, 1.0)])
        centre = np.array([0.0, side_y + away, 0.5 * length]) + np.insert(steep * away, 1, 0.0)
        f = away / grid.scale
        at = grid.pixels(centre[None, [0, 2]])[0]
        camera = CameraIntrinsics(width=grid.width, height=grid.height, fx=f, fy=f, cx=float(at[0]), cy=float(at[1]))
        return camera, centre

    def _build(self, section: NDArray, side_y: float, *, held: bool) -> tuple[list[Body], tuple[Lighting, NDArray]]:
        """Return the bodies of a scene in the jaw frame, its look, and the rotation of the look's directions."""
        rng = self._rng
        light = self._light(side_y, held=held)
        paint = _draw_finger_paint(rng, steel=self._finger.has_hinges)
        jaw, holder = self._mount(section, paint)
        bodies = [jaw, holder]
        if self._finger.reference[1] > 0.0 and rng.random() < 0.3:
            bodies = [jaw]
        mirrored = len(bodies)
        if rng.random() < 0.7:
            palm = draw_paint(rng, ("plain", "noise"))
            corner = (0.1, side_y + rng.uniform(-0.01, 0.01), -rng.uniform(0.02, 0.05))
            bodies.append(_box((-0.1, -0.04, -0.12), corner, palm))
        thing = None if not held and rng.random() < 0.15 else self._thing(section, side_y, paint, held=held)
        if thing is not None:
            bodies.append(thing)
        if held or rng.random() < 0.55:  # the other jaw, closing from the other side
            front = section[:, 0].max()
            face = front if thing is None else thing.vertices[:, 0].max()
            middle = 0.5 * (front + max(face, front + 1e-3)) + rng.uniform(0.0, 0.01)
            bodies += [_mirror(body, middle) for body in bodies[:mirrored]]
        if rng.random() < BARS:
            bodies.append(self._bar(side_y, self._solid.section.min(axis=0), self._solid.section.max(axis=0)))
        return bodies, light

    def _light(self, side_y: float, *, held: bool) -> tuple[Lighting, NDArray]:
        """Return lights and background, and the rotation of their directions."""
        rng = self._rng
        look = draw_look(rng, "dim" if rng.random() < (0.5 if held else 0.2) else "any")
        if rng.random() < 0.6:
            texture = np.ascontiguousarray(_draw_texture(rng))  # as large as backgrounds are
            cv2 = import_cv2()
            look = replace(look, background=cv2.resize(texture, (384, 384), interpolation=cv2.INTER_AREA))
        if rng.random() < 0.15:  # light that does not come from single lamps
            look = replace(look, lights=look.lights[1:], ambient=look.ambient * 2.0)
        R = R_CAMERA_JAW
        if rng.random() < 0.5:  # a table behind, square to the camera or nearly
            R = Rotation.from_euler("xyz", rng.normal(0.0, 0.25, 3)).as_matrix()
            look = replace(look, background_distance=float(rng.uniform(0.02, 0.2) + side_y))
        return look, R

    def _mount(self, section: NDArray, paint: Paint) -> tuple[Body, Body]:
        """Return the bent finger and what holds it; one of them has the mark."""
        rng, finger, solid = self._rng, self._finger, self._solid
        bolts = draw_color(rng, 0.2, 0.9)
        sides = finger.half_width(finger.bolts[:, 1])
        decals = [
            Decal(centre=np.array([x, y, z]), radius=r, color=bolts)
            for (x, z, r), y in zip(finger.bolts, sides, strict=True)
        ]
        base_y = float(finger.half_width(finger.reference[1:])[0])
        holder_paint = replace(draw_paint(rng, ("plain", "noise")), gloss=0.3)
        own = finger.reference[1] > 0.0
        under = (paint if own else holder_paint).color
        dot = draw_color(rng, 0.6, 0.95) ** 0.3 if float(np.max(under)) < 0.2 else draw_color(rng, 0.005, 0.03)
        place = np.array([finger.reference[0], base_y, finger.reference[1]])
        mark = Decal(centre=place, radius=MARK_RADIUS * rng.uniform(0.75, 1.25), color=dot)
        marks = (mark,) if self._marked else ()
        jaw = Body(
            vertices=solid.raise_vertices(section),
            triangles=solid.triangles,
            rest=solid.rest(),
            paint=paint,
            decals=(*decals, *(marks if own else ())),
        )
        base, lowest = solid.section[solid.section[:, 1] < 0.02 * finger.length], solid.section[:, 1].min()
        reach = rng.uniform(-0.002, 0.006, 2)
        deep = -base_y - rng.uniform(0.0, 0.01)
        low = (base[:, 0].min() - reach[0], deep, min(lowest, 0.0) - rng.uniform(0.012, 0.05))
        return jaw, _box(low, (base[:, 0].max() + reach[1], base_y, 0.0), holder_paint, () if own else marks)

    def _thing(self, section: NDArray, side_y: float, paint: Paint, *, held: bool) -> Body:
        """Return an object that touches the finger, or stands before it; some of those held look like its paint."""
        rng, length = self._rng, self._finger.length
        height = rng.uniform(0.15, 1.0) * length
        half = (rng.uniform(1.0, 3.5) if held else rng.uniform(0.3, 2.6)) * side_y
        if rng.random() < 0.2:
            mesh = _load_objects()[rng.integers(len(_load_objects()))]
            T = Rotation.random(rng=rng).as_matrix()
            vertices = mesh.vertices * rng.uniform(0.3, 0.9) @ T.T
            line = vertices[:, [0, 2]]
            triangles, rest = mesh.triangles, mesh.vertices
        else:
            radius = rng.uniform(0.05, 0.35, 2) * length
            round_ = bool(rng.random() < 0.6)
            radius = radius[:1].repeat(2) if round_ else radius
            rod = _rod(rng, radius, half, round_=round_)
            line, triangles, vertices = rod.section, rod.triangles, rod.rest()
            rest = vertices
        # moved towards the finger until it touches
        near = section[(section[:, 1] > height + line[:, 1].min()) & (section[:, 1] < height + line[:, 1].max())]
        at = 0.0 if len(near) == 0 else np.max(near[:, 0] - np.interp(near[:, 1] - height, *_left_side(line)))
        gap = 0.0 if rng.random() < 0.75 else rng.uniform(0.0, 0.25) * length
        shift = np.array([at + gap, rng.uniform(-0.3, 0.3) * side_y, height])
        if held and rng.random() < ALIKE:
            own = replace(paint, color=np.clip(paint.color * np.exp(rng.normal(0.0, 0.25)), 0.0, 1.0))
        else:
            own = _draw_any_paint(rng)
        return Body(vertices=vertices + shift, triangles=triangles, rest=rest, paint=own)

    def _bar(self, side_y: float, low: NDArray, high: NDArray) -> Body:
        """Return something between camera and finger."""
        rng, length = self._rng, self._finger.length
        x, z = rng.uniform(low - 0.1 * length, high)
        size = rng.uniform((0.03, 0.003, 0.03), (0.6, 0.01, 0.5)) * np.array([length, 1.0, length])
        corner = np.array([x, side_y + rng.uniform(0.002, 0.015), z])
        return _box(corner, corner + size, _draw_any_paint(rng))


def _left_side(line: NDArray) -> tuple[NDArray, NDArray]:
    """Return heights and the least x of a convex outline (n, 2) there."""
    heights = np.linspace(line[:, 1].min(), line[:, 1].max(), 25)
    polygon = shapely.MultiPoint(line).convex_hull
    bounds = [polygon.intersection(shapely.LineString([(-1.0, h), (1.0, h)])).bounds for h in heights]
    return heights, np.array([b[0] if b else 0.0 for b in bounds])


def _mirror(body: Body, middle: float) -> Body:
    """Return the image of a body in the plane x = middle."""
    turn = np.array([-1.0, 1.0, 1.0])
    vertices = body.vertices * turn + np.array([2.0 * middle, 0.0, 0.0])
    return replace(body, vertices=vertices, triangles=body.triangles[:, ::-1])


@lru_cache(maxsize=1)
def _load_objects() -> list:
    """Return the meshes of household things."""
    return [build_object(name) for name in OBJECT_NAMES]


def write_shard(seeds: Sequence[int], path: str, held: float = HELD) -> dict[str, int]:
    """Write the pictures of the fingers with these seeds as one file and return how many fingers they are."""
    save_shard(Path(path), FingerPictures.join([FingerScenes(seed, held).draw() for seed in seeds]))
    return {"fingers": len(seeds)}


def make_shards(
    seeds: range, folder: Path, name: str, engine: EngineOptions, fingers: int = 32, held: float = HELD
) -> None:
    """Render the pictures of fingers and write them as `NAME_SEED.npz`, several fingers a file.

    Raises:
        TrainingError: one could not be made or written.
    """
    parts = [seeds[begin : begin + fingers] for begin in range(0, len(seeds), fingers)]
    tasks = []
    for part in parts:
        path = str(folder / f"{name}_{part[-1]:09d}.npz")
        given = {"seeds": list(part), "path": path, "held": held}
        tasks.append(Task(name=Path(path).stem, key=str(part), work=write_shard, given=given, output=path))
    make_all(tasks, engine, folder, "file")


def main() -> None:
    """Render a data set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the files are written")
    parser.add_argument(
        "--fingers", type=whole_number(0, 10**9), default=1500, help="for training (1500), 8 pictures each"
    )
    parser.add_argument("--validation", type=whole_number(0, 10**9), default=100, help="fingers for validation (100)")
    parser.add_argument("--first", type=whole_number(0, 10**9), default=0, help="seed of the first finger (0)")
    parser.add_argument(
        "--held", type=read_share, default=HELD, help=f"share of pictures of a grasp from the wrist ({HELD})"
    )
    add_engine_options(parser)
    options = parser.parse_args()
    with one_line_errors():
        engine = read_engine(options)
        for name, first, count in ((VALIDATION, FIRST_VALIDATION, options.validation), (TRAIN, 0, options.fingers)):
            if count:
                start = first + options.first
                seeds = range(start, start + count)
                make_shards(seeds, options.folder, name, engine, held=options.held)


if __name__ == "__main__":
    from lab.training.scenes import main as run  # under the name by which the workers of a cluster find its functions

    run()
