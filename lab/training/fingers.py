"""Fin-ray fingers by chance: what they look like from the side, and how they bend, by frames of beams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce_ifea.fem.frame import BeamPoints, add_beams, build_beams, point_positions, shape_weights
from finforce_ifea.fem.model import factorise_banded
from finforce_ifea.jaw.cad.make_jaw import FEW
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.section import order_rings

SEED = 40_000_000_000  # of training's fingers begin here
FIRST_VALIDATION = 10_000_000  # number of the first of those that judge
BETWEEN = 3  # beams along a band from rib to rib
ALONG = 3  # beams along a rib
LONGEST_STEP = 0.012  # of a boundary between two vertices, in lengths of the finger


@dataclass(frozen=True, kw_only=True, eq=False)
class Member:
    """A band or a rib: its centre line (n, 2) [m] and its thickness (n,) [m] there."""

    line: NDArray
    thickness: NDArray

    @property
    def polygon(self) -> shapely.Polygon:
        """The area that it covers."""
        along = np.gradient(self.line, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        normal = np.column_stack((-along[:, 1], along[:, 0])) * 0.5 * self.thickness[:, None]
        return shapely.Polygon(np.vstack((self.line + normal, (self.line - normal)[::-1]))).buffer(0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Finger:
    """A finger as its section, with what its key points are.

    Attributes:
        polygon: its section in x and z [m], jaw frame.
        members: front band, back band, then the ribs; the front band is the one that touches objects.
        length: [m].
        width: [m], along y, at the base.
        taper: by how much of it the width has become less at the tip.
        clamped_z: [m], everything up to this height is held.
        solid_z: [m], from here on the tip is solid.
        keypoints: (K, 2) [m], where ribs meet bands, of few also half way between, and at last the tip.
        reference: (2,) [m], a mark on what is held.
        bolts: (b, 3) [m], x, z and radius of what is seen on its side: heads of screws.
        has_hinges: True if its ribs are bars that turn on the bands.
    """

    polygon: shapely.Polygon
    members: tuple[Member, ...]
    length: float
    width: float
    taper: float
    clamped_z: float
    solid_z: float
    keypoints: NDArray
    reference: NDArray
    bolts: NDArray
    has_hinges: bool

    def half_width(self, z: NDArray) -> NDArray:
        """Return the y (n,) [m] of its side at heights z (n,) [m]."""
        return 0.5 * self.width * (1.0 - self.taper * np.clip(z / self.length, 0.0, 1.0))


def draw_finger(rng: np.random.Generator) -> Finger:
    """Return a finger by chance: 3 to 20 ribs, bands straight, slanted or curved, 50 to 150 mm long."""
    while True:
        finger = _try_finger(rng)
        if finger is not None:
            return finger


def _try_finger(rng: np.random.Generator) -> Finger | None:
    length = float(np.exp(rng.uniform(np.log(0.05), np.log(0.15))))
    scale = (length / 0.08) ** 0.7
    base = length * rng.uniform(0.22, 0.6)
    steel = rng.random() < 0.12
    clamped = float(rng.choice([0.0, rng.uniform(0.02, 0.22) * length]))
    solid = length * rng.uniform(0.86, 0.97)
    tip = rng.uniform(2.0, 8.0) * 1e-3 * scale * (1.0 if not steel else 0.4)
    front, back = _draw_bands(rng, length, base, tip, scale, steel)
    ribs = _draw_ribs(rng, (front, back), (clamped, solid), scale, steel)
    if ribs is None:
        return None
    polygon = _draw_section(rng, (front, back, *ribs), base, (clamped, solid), scale, steel)
    if not isinstance(polygon, shapely.Polygon):
        return None
    junctions = [rib.line[0] for rib in ribs] + [rib.line[-1] for rib in ribs]
    middle = 0.5 * (front.line[:, 0] + 0.5 * front.thickness + back.line[:, 0] - 0.5 * back.thickness)
    front_x = front.line[-1, 0] + 0.5 * front.thickness[-1]
    top = np.array([front_x - 0.5 * tip, length - rng.uniform(0.0, 0.04) * length])
    few = len(junctions) + 1 < FEW and not steel
    keypoints = np.array([*junctions, *(_find_middles(front, back, ribs, clamped, top[1]) if few else ()), top])
    reference_z = rng.uniform(0.15, 0.85) * clamped if clamped > 0.06 * length else -rng.uniform(0.04, 0.13) * length
    at = np.interp(max(reference_z, 0.0), front.line[:, 1], middle)
    reference = np.array([at + rng.uniform(-0.3, 0.3) * base * 0.8, reference_z])
    bolts = np.zeros((0, 3))
    if steel:
        bolts = np.column_stack((np.array(junctions), np.full(len(junctions), rng.uniform(0.9, 1.8) * 1e-3)))
    elif clamped > 0.08 * length and rng.random() < 0.4:
        bolts = _draw_discs(rng, base, clamped)
    return Finger(
        polygon=shapely.Polygon(polygon.exterior, polygon.interiors),
        members=(front, back, *ribs),
        length=length,
        width=float(rng.uniform(0.15, 0.5) * length),
        taper=float(rng.uniform(0.1, 0.6)) if rng.random() < 0.25 else 0.0,
        clamped_z=clamped,
        solid_z=solid,
        keypoints=keypoints,
        reference=reference,
        bolts=bolts,
        has_hinges=steel,
    )


def _draw_bands(
    rng: np.random.Generator, length: float, base: float, tip: float, scale: float, steel: bool
) -> tuple[Member, Member]:
    """Return the front and the back band, straight, slanted or curved, of a finger this wide at base and tip [m]."""
    lean = 0.0 if rng.random() < 0.6 else rng.uniform(-0.25, 0.25)
    bulge = 0.0 if rng.random() < 0.6 else rng.uniform(-0.06, 0.06) * length
    back_bulge = 0.0 if rng.random() < 0.5 else rng.uniform(-0.05, 0.18) * length * min(base / (0.5 * length), 1.0)
    share = np.linspace(0.0, 1.0, 81)
    front_x = 0.5 * base + lean * length * share + bulge * 4.0 * share * (1.0 - share)
    back_x = -0.5 * base + (front_x[-1] - tip + 0.5 * base) * share - back_bulge * 4.0 * share * (1.0 - share)
    thick = rng.uniform(0.9, 2.6, 2) * 1e-3 * scale if not steel else np.full(2, rng.uniform(0.25, 1.0) * 1e-3)
    front, back = (t * (1.0 + (k - 1.0) * share) for t, k in zip(thick, rng.uniform(0.65, 1.3, 2), strict=True))
    return (
        Member(line=np.column_stack((front_x - 0.5 * front, share * length)), thickness=front),
        Member(line=np.column_stack((back_x + 0.5 * back, share * length)), thickness=back),
    )


def _draw_section(
    rng: np.random.Generator,
    members: tuple[Member, ...],
    base: float,
    ends: tuple[float, float],
    scale: float,
    steel: bool,
) -> shapely.Geometry:
    """Return what members cover, with the solid parts at both ends [m], a boss, holes and fillets by chance."""
    front, back, (clamped, solid), length = *members[:2], ends, members[0].line[-1, 1]
    parts = [member.polygon for member in members]
    if not steel or rng.random() < 0.5:
        parts.append(_between(front, back, solid, length))
    if clamped > 0.0:
        parts.append(_between(front, back, 0.0, clamped))
    if rng.random() < 0.1:  # a boss on the back
        at = rng.uniform(0.1, 0.5) * length
        x = np.interp(at, back.line[:, 1], back.line[:, 0])
        parts.append(shapely.Point(x, at).buffer(rng.uniform(0.025, 0.05) * length))
    polygon = shapely.union_all([part.buffer(2e-5) for part in parts])
    if clamped > 0.08 * length and rng.random() < 0.4:
        discs = [shapely.Point(x, height).buffer(radius) for x, height, radius in _draw_discs(rng, base, clamped)]
        polygon = polygon.difference(shapely.union_all(discs))
    rounding = rng.uniform(0.0, 0.5) * 1e-3 * scale
    if not steel and rounding > 1e-4:
        polygon = polygon.buffer(rounding, quad_segs=3).buffer(-rounding, quad_segs=3)  # fillets
    return polygon


def _draw_ribs(
    rng: np.random.Generator, bands: tuple[Member, Member], ends: tuple[float, float], scale: float, steel: bool
) -> list[Member] | None:
    """Return ribs between two bands, from a height to another; None when they cross or crowd."""
    (front, back), (low, high) = bands, ends
    length = front.line[-1, 1]
    count = int(rng.integers(3, 7 if steel else 21))
    thickness = (rng.uniform(0.5, 1.9) * 1e-3 * scale) if not steel else rng.uniform(2.0, 6.0) * 1e-3
    first, last = low + rng.uniform(0.04, 0.15) * length, high - rng.uniform(0.03, 0.12) * length
    tilt = 0.0 if rng.random() < 0.35 else rng.uniform(-0.9, 0.9)
    fan = 0.0 if rng.random() < 0.6 else rng.uniform(-0.8, 0.8)  # by how much the tilt changes from base to tip
    spread = 1.0 if rng.random() < 0.6 else rng.uniform(0.7, 1.4)
    heights = first + (last - first) * np.linspace(0.0, 1.0, count) ** spread
    if rng.random() < 0.3:
        heights = heights + rng.normal(0.0, 0.06, count) * (last - first) / count
    if np.diff(heights).min() < 2.6 * thickness + 0.8e-3:
        return None
    ribs = []
    for share, height in zip(np.linspace(0.0, 1.0, count), heights, strict=True):
        x_front = np.interp(height, front.line[:, 1], front.line[:, 0])
        gap = x_front - np.interp(height, back.line[:, 1], back.line[:, 0])
        z_back = height - (tilt + fan * share) * gap
        if not low + 0.02 * length < z_back < high - 0.01 * length or gap < 2.0 * thickness:
            return None
        ends = np.array([[x_front, height], [np.interp(z_back, back.line[:, 1], back.line[:, 0]), z_back]])
        line = np.linspace(ends[0], ends[1], ALONG + 1)
        ribs.append(Member(line=line, thickness=np.full(len(line), thickness)))
    backs = np.array([rib.line[-1, 1] for rib in ribs])
    return ribs if np.diff(backs).min() > 1.5 * thickness else None


def _find_middles(front: Member, back: Member, ribs: list[Member], low: float, high: float) -> NDArray:
    """Return the points (n, 2) [m] of both bands half way between two ribs, from a height to another."""
    found = []
    for band, end in ((front, 0), (back, -1)):
        heights = np.array([low, *sorted(rib.line[end, 1] for rib in ribs), high])
        middles = 0.5 * (heights[1:] + heights[:-1])
        found.append(np.column_stack((np.interp(middles, band.line[:, 1], band.line[:, 0]), middles)))
    return np.vstack(found)


def _draw_discs(rng: np.random.Generator, base: float, low: float) -> NDArray:
    """Return x, z and radius (n, 3) [m] of bolts or holes in what is held."""
    count = int(rng.integers(1, 4))
    radius = np.full(count, rng.uniform(1.2, 2.8) * 1e-3)
    return np.column_stack((rng.uniform(-0.35, 0.35, count) * base, rng.uniform(0.2, 0.8, count) * low, radius))


def _between(front: Member, back: Member, low: float, high: float) -> shapely.Polygon:
    """Return the area between the outer faces of two bands from a height to another."""
    z = np.linspace(low, high, 12)
    x_front = np.interp(z, front.line[:, 1], front.line[:, 0] + 0.5 * front.thickness)
    x_back = np.interp(z, back.line[:, 1], back.line[:, 0] - 0.5 * back.thickness)
    return shapely.Polygon(np.vstack((np.column_stack((x_front, z)), np.column_stack((x_back, z))[::-1]))).buffer(0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Attached:
    """Points of a finger: what carries them at its front and back, the front's share (p, 1), which are held (p, 1)."""

    probes: tuple[BeamPoints, ...]
    share: NDArray
    held: NDArray


class BentFinger:
    """A finger's frame of beams, which tells where its material goes under loads on its front band."""

    def __init__(self, finger: Finger, rng: np.random.Generator) -> None:
        self.finger = finger
        self._dof: list[NDArray] = []
        self._ends: list[NDArray] = []
        self._thickness: list[float] = []
        self._of: list[int] = []
        self._count = 0
        front, back, *ribs = finger.members
        held = max(finger.clamped_z, 0.0)
        tip = self._joint()
        joints: list[list[NDArray]] = [[], []]
        for side, band in enumerate((front, back)):
            heights = sorted((rib.line[0 if side == 0 else -1, 1], number) for number, rib in enumerate(ribs))
            joints[side] = [np.zeros(3, int)] * len(ribs)
            start, below = np.full(3, -1), held
            for height, number in [*heights, (finger.length, -1)]:
                end = tip if number < 0 else self._joint()
                z = np.linspace(below, height, BETWEEN + 1)
                line = np.column_stack((np.interp(z, band.line[:, 1], band.line[:, 0]), z))
                chain = [start, *(self._joint() for _ in range(BETWEEN - 1)), end]
                stiff = 0.5 * (z[0] + z[1])
                self._chain(chain, line, float(np.interp(stiff, band.line[:, 1], band.thickness)), side)
                if number >= 0:
                    joints[side][number] = end
                start, below = end, height
        for number, rib in enumerate(ribs):
            first, last = joints[0][number].copy(), joints[1][number].copy()
            if finger.has_hinges:  # own rotations at both ends
                first = np.append(first[:2], self._unknowns(1))
                last = np.append(last[:2], self._unknowns(1))
            chain = [first, *(self._joint() for _ in range(ALONG - 1)), last]
            self._chain(chain, rib.line, float(rib.thickness[0]), 2)
        self._side = np.array(self._of)
        ends, thickness = np.array(self._ends), np.array(self._thickness)
        material = Material(young_modulus=1e6, poisson_ratio=float(rng.uniform(0.3, 0.49)))
        self._beams = build_beams(np.array(self._dof), ends, np.zeros_like(ends), thickness, 1.0, material)
        self._band = int(
            np.ptp(np.where(self._beams.dof < self._count, self._beams.dof, -1).reshape(-1, 8), axis=1).max()
        )

    def _unknowns(self, count: int) -> NDArray:
        self._count += count
        return np.arange(self._count - count, self._count)

    def _joint(self) -> NDArray:
        return self._unknowns(3)

    def _chain(self, joints: list[NDArray], line: NDArray, thickness: float, side: int) -> None:
        for k in range(len(line) - 1):
            self._dof.append(np.array([[*joints[k], joints[k][2]], [*joints[k + 1], joints[k + 1][2]]]))
            self._ends.append(np.array([line[k], line[k + 1]]))
            self._thickness.append(thickness)
            self._of.append(side)

    def bend(self, place: float, spread: float, slope: float, largest: float, states: int) -> list[NDArray]:
        """Return equilibria q (n,) under a load that grows until something has moved by `largest` [m].

        Args:
            place: height of the load's centre [m].
            spread: its standard deviation [m].
            slope: its share along z.
            largest: [m].
            states: number of equilibria, evenly spread.
        """
        load = np.zeros(self._count + 1)
        front = np.flatnonzero(self._side == 0)
        weight = np.exp(-0.5 * ((self._beams.ends[front, 1, 1] - place) / spread) ** 2)
        load[self._beams.dof[front, 1, 0]] -= weight
        load[self._beams.dof[front, 1, 1]] += slope * weight
        load = load[:-1]
        q, found, size, wanted = np.zeros(self._count), [], 0.0, largest / states
        step = None
        for _ in range(60):
            if step is None:
                tangent = self._linearize(q)[1]
                factor = factorise_banded(tangent)
                if factor is None:
                    break
                step = 0.25 * wanted / max(self._moved(factor.solve(load)), 1e-12)
            trial = self._solve(q, (size + step) * load)
            if trial is None or self._moved(trial - q) > wanted:
                step *= 0.5
                if step < 1e-9 * max(size, 1e-12):
                    break
                continue
            size, q = size + step, trial
            if self._moved(q) >= wanted * (len(found) + 1):
                found.append(q)
                if len(found) == states:
                    break
            step *= 1.4
        return found

    def _moved(self, q: NDArray) -> float:
        full = np.append(q, 0.0)
        return float(np.abs(full[self._beams.dof[:, :, :2]]).max())

    def _linearize(self, q: NDArray) -> tuple[NDArray, NDArray]:
        force, storage = np.zeros(self._count + 1), np.zeros((self._band + 1, self._count), order="F")
        add_beams(self._beams, q, force, storage)
        return force[:-1], storage

    def _solve(self, q: NDArray, load: NDArray) -> NDArray | None:
        q = q.copy()
        for _ in range(12):
            force, tangent = self._linearize(q)
            factor = factorise_banded(tangent)
            if factor is None:
                return None
            change = factor.solve(load - force)
            if not np.isfinite(change).all() or self._moved(change) > 0.05 * self.finger.length:
                return None
            q += change
            if self._moved(change) < 1e-6 * self.finger.length:
                return q
        return None

    def attach(self, points: NDArray) -> Attached:
        """Return what carries points (p, 2) [m]: the nearest beam, in a solid tip both bands."""
        thickness = np.array(self._thickness)
        solid = points[:, 1] > self.finger.solid_z
        everything = np.ones(len(thickness), bool)
        probes = []
        for side in (0, 1):
            allowed = np.where(solid[:, None], self._side == side, everything)
            probes.append(self._attach(points, thickness, allowed))
        x_front, x_back = (np.interp(points[:, 1], m.line[:, 1], m.line[:, 0]) for m in self.finger.members[:2])
        share = np.clip((points[:, 0] - x_back) / np.maximum(x_front - x_back, 1e-6), 0.0, 1.0)
        held = points[:, 1] <= self.finger.clamped_z + 5e-5
        return Attached(probes=tuple(probes), share=np.where(solid, share, 1.0)[:, None], held=held[:, None])

    def _attach(self, points: NDArray, thickness: NDArray, allowed: NDArray) -> BeamPoints:
        ends, along, length = self._beams.ends[:, 0], self._beams.direction, self._beams.length
        share = np.clip(((points[:, None] - ends) * along).sum(2) / length, 0.0, 1.0)
        feet = ends + (share * length)[..., None] * along
        away = np.maximum(np.linalg.norm(points[:, None] - feet, axis=2) - 0.5 * thickness, 0.0).round(9)
        beam = np.where(allowed, away, np.inf).argmin(axis=1)
        rows = np.arange(len(points))
        rest, d = points - feet[rows, beam], along[beam]
        offset = np.stack([(rest * d).sum(1), rest[:, 0] * d[:, 1] - rest[:, 1] * d[:, 0]], axis=1)
        shape = shape_weights(share[rows, beam], length[beam], np.ones(len(beam), bool))
        points = np.column_stack((points[:, 0], np.zeros(len(points)), points[:, 1]))
        return BeamPoints(points=points, beam=beam, shape=shape, offset=offset)

    def places(self, attached: Attached, q: NDArray) -> NDArray:
        """Return where attached points are (p, 2) [m]; what is held stays."""
        front, back = (point_positions(self._beams, probe, q)[:, [0, 2]] for probe in attached.probes)
        moved = attached.share * front + (1.0 - attached.share) * back
        return np.where(attached.held, attached.probes[0].points[:, [0, 2]], moved)


def outline(finger: Finger) -> list[NDArray]:
    """Return the rings (n, 2) [m] of a finger's section with vertices close enough to bend with it."""
    fine = shapely.segmentize(finger.polygon, LONGEST_STEP * finger.length)
    return list(order_rings(fine))
