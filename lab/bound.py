"""Posterior Cramér-Rao bound of the force in recordings: what no estimator that knows no more can fall below.

The state is linear about the true one, x <- F x + w, z = H x + n, force = J x, so that the bound of Tichavsky,
Muravchik and Nehorai (Posterior Cramér-Rao bounds for discrete-time nonlinear filtering, 1998) is the covariance
recursion

    P <- F P F^T + Q,    P <- P - P H^T (H P H^T + R)^-1 H P,    Var force = J P J^T,

with the modes of rest and motion known. The key points tell depth, tilt, height and traction ratio through the jaw's
full mechanics. Beside the noise stand the errors that are stated, each a Gauss-Markov process: offsets of the tare,
errors of the mechanics at the key points, of the pose, of friction and of the camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import interp1d
from scipy.ndimage import uniform_filter1d

from finforce_contact.loop import ContactSource
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.forces import evaluate_jaws, truth_sides
from finforce_eval.evaluation.scoring import match_truth
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.recordings.objects import read_friction
from finforce_eval.recordings.tracks import Recording
from finforce_eval.tasks import progress_bar
from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Coefficient
from finforce_ifea.contact_mechanics.indenter import OutlineIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.observation import ObjectOutline
from finforce_ifea.tare import compute_tare
from lab.ablation.scenes import settle
from lab.harness import Figures

_D, _V, _TILT, _HEIGHT, _MU, _DK, _E, _CX, _CZ, _CPHI, _SHARED = range(11)
_LEAST_DEPTH, _EVERY = 0.05e-3, 0.4e-3
# A true force from which on the object touches [N], and a change of the depth from which on it moves [m/s].
_TOUCH, _MOVES = 0.02, 0.2e-3
_SEEN, _WINDOW = 0.6, 31  # likelihood of a visible key point, and images in half of which it is seen


@dataclass(frozen=True, kw_only=True)
class Stated:
    """Standard deviations (1 sigma) that are stated, and over what each error stays the same.

    Attributes:
        floor: error of the mechanics at a key point [m].
        shape: the same of a shape, as a share of the displacement; like `floor` over 10 mm of motion and 60 s.
        relative: the same of all shapes, over 200 s.
        apparent: traction ratio that errors of the mechanics look like, over 10 s.
        traction: traction ratio beyond friction, over 2 mm and 60 s.
        traction_share: the same, as a share of the coefficient of friction.
        camera: shift [m] over 20 s.
        camera_turn: turn [rad] over 20 s.
        tilt: of the outline beyond its pose [rad], over 10 s like the pose.
        drift: of the depth at rest [m/s^0.5].
        acceleration: change of the speed in motion [m/s^1.5].
        start: speed at which motion begins [m/s].
    """

    floor: float = 0.02e-3
    shape: float = 0.004
    relative: float = 0.01
    apparent: float = 0.2
    traction: float = 0.04
    traction_share: float = 0.15
    camera: float = 0.02e-3
    camera_turn: float = 0.3e-3
    tilt: float = 0.02
    drift: float = 0.01e-3
    acceleration: float = 4e-3
    start: float = 5e-3


# The mechanics, a still camera and a stated friction without error: noise, tare and pose are left.
NOISE_ALONE = Stated(
    floor=0.0, shape=0.0, relative=0.0, apparent=0.0, traction=0.0, traction_share=0.0, camera=0.0, camera_turn=0.0
)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueImages:
    """The truth of n images, linearised.

    Attributes:
        stamps: (n,) [s].
        depth: below first touch, 0 where nothing touches (n,) [m].
        mobilization: share of friction that is used, -1 to 1 (n,).
        motions: of the key points along x and z by depth, tilt, height and traction ratio (n, K, 2, 4).
        displacement: of the key points (n, K) [m].
        places: of the key points, x and z (n, K, 2) [m].
        modes: of the force by the same four (n, 3, 4).
        seen: mask of the key points that can be used (n, K).
        noise: of one along x and z, its y known (2, 2) [m^2].
        offset_variance: of the tare (K,) [m^2].
        pose: standard deviation of tilt [rad] and height [m] (2,).
        friction: coefficient.
    """

    stamps: NDArray
    depth: NDArray
    mobilization: NDArray
    motions: NDArray
    displacement: NDArray
    places: NDArray
    modes: NDArray
    seen: NDArray
    noise: NDArray
    offset_variance: NDArray
    pose: NDArray
    friction: Coefficient


def bound_forces(images: TrueImages, stated: Stated | None = None) -> NDArray:
    """Return the covariance (n, 3, 3) [N^2] below which that of no unbiased estimate falls."""
    stated = stated or Stated()
    count = images.seen.shape[1]
    size, touches = _SHARED + 4 * count, images.depth > 0.0
    steps = np.diff(images.depth, prepend=images.depth[0])
    dts = np.diff(images.stamps, prepend=images.stamps[0])
    P, before, bounds = np.zeros((size, size)), None, np.zeros((len(dts), 3, 3))
    for i, (dt, step) in enumerate(zip(dts, steps, strict=True)):
        V = _expect(images, stated, images.displacement[i])
        P = np.diag(V) if before is None else _predict(P, V, before, float(dt), abs(float(step)), stated)
        if not touches[i]:
            P[[_D, _V], :] = P[:, [_D, _V]] = 0.0
            P[_D, _D], P[_V, _V] = V[_D], V[_V]
        before, H = V, _observe(images, i)
        P = _update(P, H, images.noise)
        J = np.zeros((3, size))
        J[:, [_D, _TILT, _HEIGHT, _DK]] = images.modes[i]
        J[:, _MU] = images.mobilization[i] * images.modes[i, :, 3]
        bounds[i] = J @ P @ J.T
    return bounds


def _expect(images: TrueImages, stated: Stated, displacement: NDArray) -> NDArray:
    """Return the stationary variance (n,) of the state; that of the coefficient of friction is its first one."""
    mu, mu_stddev = images.friction
    traction = stated.traction**2 + (stated.traction_share * mu) ** 2
    tilt, height = images.pose
    own = images.offset_variance + stated.floor**2 + (stated.shape * displacement) ** 2
    shared = [(2e-3) ** 2, stated.start**2, tilt**2 + stated.tilt**2, height**2, mu_stddev**2, traction,
              stated.apparent**2, stated.camera**2, stated.camera**2, stated.camera_turn**2]  # fmt: skip
    return np.concatenate([shared, np.repeat(own, 2), np.full(2 * len(own), stated.relative**2)])


def _predict(P: NDArray, V: NDArray, before: NDArray, dt: float, motion: float, stated: Stated) -> NDArray:
    """Return the covariance after a time [s] and a motion [m], for the stationary variances after and before it."""
    count, a = (len(V) - _SHARED) // 2, np.ones(len(V))
    a[[_TILT, _HEIGHT]] = np.exp(-dt / 10.0)
    a[_DK], a[_E] = np.exp(-motion / 2e-3 - dt / 60.0), np.exp(-dt / 10.0)
    a[_CX : _CPHI + 1] = np.exp(-dt / 20.0)
    a[_SHARED : _SHARED + count] = np.exp(-motion / 10e-3 - dt / 60.0)
    a[_SHARED + count :] = np.exp(-dt / 200.0)
    grows = np.sqrt(np.divide(V, before, out=np.ones_like(V), where=before > 0.0))
    f = a * grows
    P = f[:, None] * P * f + np.diag((1.0 - a**2) * V)
    P[_D, _D] += stated.drift**2 * dt
    if motion > _MOVES * dt:
        F = np.eye(len(V))
        F[_D, _V] = dt
        P = F @ P @ F.T
        q = stated.acceleration**2
        P[_D, _D], P[_V, _V] = P[_D, _D] + q * dt**3 / 3.0, P[_V, _V] + q * dt
        P[_D, _V] = P[_V, _D] = P[_D, _V] + q * dt**2 / 2.0
    else:
        P[_V, :] = P[:, _V] = 0.0
        P[_V, _V] = V[_V]
    return P


def _observe(images: TrueImages, i: int) -> NDArray:
    """Return the derivatives (2 m, n) of the key points that are seen in image i."""
    seen = np.flatnonzero(images.seen[i])
    count, places = images.seen.shape[1], images.places[i, seen]
    H = np.zeros((len(seen), 2, _SHARED + 4 * count))
    H[:, :, [_D, _TILT, _HEIGHT, _DK]] = images.motions[i, seen]
    H[:, :, _E] = images.motions[i, seen, :, 3]
    H[:, :, _MU] = images.mobilization[i] * images.motions[i, seen, :, 3]
    H[:, 0, _CX], H[:, 1, _CZ] = 1.0, 1.0
    H[:, 0, _CPHI], H[:, 1, _CPHI] = places[:, 1], -places[:, 0]
    for axis in range(2):
        H[np.arange(len(seen)), axis, _SHARED + 2 * seen + axis] = 1.0
        H[np.arange(len(seen)), axis, _SHARED + 2 * count + 2 * seen + axis] = images.displacement[i, seen]
    return H.reshape(2 * len(seen), -1)


def _update(P: NDArray, H: NDArray, noise: NDArray) -> NDArray:
    """Return the covariance (n, n) after a measurement, each two rows of H (2 m, n) with the noise (2, 2)."""
    HP = H @ P
    S = HP @ H.T + np.kron(np.eye(len(H) // 2), noise)
    P = P - HP.T @ np.linalg.solve(S, HP)
    return 0.5 * (P + P.T)


def _find_outline(source: ContactSource, stamps: Sequence[int], jaw: Jaw) -> ObjectOutline | None:
    """Return the last outline of the object that a source has at stamps [ns]; None without any."""
    contacts = [source.contact_at(stamp, lambda: jaw.keypoints) for stamp in stamps]
    outlines = [contact.outline for contact in contacts if contact is not None and contact.outline is not None]
    return outlines[-1] if outlines else None


def read_truth(recording: Recording, side: str, setup: EvaluationSetup) -> TrueImages:
    """Return the truth of one jaw of a recording, linearised by the full mechanics of the jaw.

    The depth is that at which the mechanics has the size of the true force, the share of friction that is used follows
    from its direction. Derivatives are those without traction: their change by it is of second order.

    Raises:
        FinforceError: truth, phases or outline are missing.
    """
    if recording.phases is None:
        raise RecordingError(f"{recording.name}: no /bench/phase, which tells how deep the object was pressed")
    own, track = setup.side(side), recording.jaw(side).keypoints
    jaw = own.calibration.apply(own.jaw) if own.calibration else own.jaw
    force = match_truth(recording.truth(side), track.stamps_ns)
    size = np.nan_to_num(np.linalg.norm(force, axis=1))
    outline = _find_outline(own.source(recording), track.stamps_ns[: int(np.argmax(size)) + 1].tolist(), jaw)
    if outline is None:
        raise RecordingError(f"{recording.name}: no outline of the object; expected its mesh and poses")
    mechanics = build_mechanics(jaw, replace(own.settings, solver=jaw.model))
    height = 1e-3 * float(recording.case["object"]["z"])
    friction, indenter = read_friction(recording), OutlineIndenter(outline.polygons)
    deepest = 1e-3 * float(recording.phases.displacement_mm.max())
    depths, table, smooth = tabulate(mechanics, jaw.keypoints, indenter, height, deepest)
    depth = np.where(size > _TOUCH, np.interp(size, np.linalg.norm(smooth, axis=1), depths), 0.0)
    mobilization = np.ones_like(depth)
    if friction is None:
        settings = own.settings.resolve_friction(jaw.material)
        friction = Coefficient(settings.friction, settings.friction_stddev)
        flat = np.interp(depth, depths, np.arctan2(smooth[:, 2], -smooth[:, 0]))
        ratio = np.where(size > 5 * _TOUCH, np.tan(np.arctan2(force[:, 2], -force[:, 0]) - flat), 0.0)
        mobilization = np.clip(ratio / np.quantile(np.abs(ratio[size > 5 * _TOUCH]), 0.9), -1.0, 1.0)
    values = table(np.maximum(depth, _LEAST_DEPTH))
    count = len(jaw.keypoints)
    motions, places = np.split(values[:, : 10 * count].reshape(-1, count, 10), [8], axis=2)
    motions, modes = motions.reshape(-1, count, 2, 4), values[:, 10 * count :].reshape(-1, 3, 4)
    motions[depth <= 0.0], modes[depth <= 0.0] = 0.0, 0.0
    rest = jaw.keypoints[:, [0, 2]]
    places = np.where((depth > 0.0)[:, None, None], places, rest)
    seen = (track.likelihood >= _SEEN) & np.isfinite(track.points).all(axis=2)
    seen &= uniform_filter1d((track.likelihood >= _SEEN).astype(float), _WINDOW, axis=0) > 0.5
    first = int(np.argmax(size > _TOUCH))
    points = np.where(seen[..., None], track.points, np.nan)
    tare = compute_tare(list(points[max(0, first - 300) : first]), jaw.keypoints)
    C = tare.noise
    return TrueImages(
        stamps=track.stamps,
        depth=depth,
        mobilization=mobilization,
        motions=motions,
        displacement=np.linalg.norm(places - rest, axis=2),
        places=places,
        modes=modes,
        seen=seen,
        noise=C[np.ix_([0, 2], [0, 2])] - np.outer(C[[0, 2], 1], C[1, [0, 2]]) / C[1, 1],
        offset_variance=tare.offset_variance(),
        pose=outline.stddev[[2, 1]],
        friction=friction,
    )


class PressTable(NamedTuple):
    """Linearised equilibria of a press without traction.

    Attributes:
        depths: (m,) [m].
        linear: by depth, of each key point eight derivatives and its place, then twelve derivatives of the force.
        forces: (m, 3) [N].
    """

    depths: NDArray
    linear: interp1d
    forces: NDArray


def tabulate(
    mechanics: Mechanics, keypoints: NDArray, indenter: OutlineIndenter, height: float, deepest: float
) -> PressTable:
    """Return the equilibria of a jaw that an object presses.

    Args:
        mechanics: of the jaw.
        keypoints: (K, 3) [m].
        indenter: the object.
        height: of its origin [m].
        deepest: depth up to which it is pressed [m].
    """
    contact, rows, forces = mechanics.contact, [], []
    contact.set_indenter(indenter)
    probe, q = contact.model.attach(keypoints, KEYPOINT_DISTANCE), np.zeros(contact.model.size)
    touch = contact.find_touch(np.array([0.0, 0.0, height]))
    depths = np.concatenate([[_LEAST_DEPTH], np.arange(_EVERY, deepest + 0.5 * _EVERY, _EVERY)])
    for depth in depths:
        x = np.array([depth + touch, 0.0, height])
        q = settle(contact, q, x, FRICTIONLESS).q
        pressed = contact.linearize(q, x, FRICTIONLESS)
        motions = contact.model.project(probe, q, pressed.modes)[:, [0, 2]].reshape(len(keypoints), 8)
        places = contact.model.positions(probe, q)[:, [0, 2]]
        rows.append(np.r_[np.hstack([motions, places]).ravel(), pressed.force_modes.ravel()])
        forces.append(pressed.force)
    ends = {"bounds_error": False, "fill_value": (rows[0], rows[-1])}
    return PressTable(depths, interp1d(depths, np.array(rows), axis=0, **ends), np.array(forces))


def compare(recordings: Iterable[Recording], setup: EvaluationSetup) -> Figures:
    """Return the force error of the estimator over the bound, for each jaw of recordings with truth.

    Raises:
        FinforceError: a recording has no truth, or cannot be evaluated.
    """
    rows, recordings = [], list(recordings)
    with progress_bar(len(recordings), "recording", "bound") as bar:
        for recording in recordings:
            sides = truth_sides(recording)
            for side, series in zip(sides, evaluate_jaws(recording, setup), strict=True):
                images, counted = read_truth(recording, side, setup), series.counted
                error = (series.column("force") - series.column("true_force"))[counted]
                exact = images if read_friction(recording) is None else replace(images, friction=Coefficient(0.0, 0.0))
                row = {"recording": series.name, "error/N": float(np.sqrt((error**2).sum(axis=1).mean()))}
                limits = {"as stated": (images, Stated()), "friction known": (exact, Stated())}
                for name, (own, stated) in (limits | {"noise alone": (exact, NOISE_ALONE)}).items():
                    bound = _measure(bound_forces(own, stated)[counted])
                    row |= {f"{name}/N": bound, f"over {name}": row["error/N"] / bound}
                rows.append(row)
            bar.update(1)
    table = pd.DataFrame(rows)
    medians = ", ".join(f"{table[name].median():.2f} ({name})" for name in table if name.startswith("over "))
    return Figures(tables={"bound": table}, notes=[f"Median of the error over the bound: {medians}."])


def _measure(covariance: NDArray) -> float:
    """Return the root mean square length [N] of errors with covariances (n, 3, 3) [N^2]."""
    return float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()))
