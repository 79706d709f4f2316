"""The loops of the geometry of one image, compiled once and kept beside this file."""

from __future__ import annotations

import numpy as np
from numba import njit

from finforce.elimination import eliminate

_OPTIONS = {"cache": True, "error_model": "numpy", "nogil": True}
POLYNOMIAL, FISHEYE = 1.0, 2.0  # kinds of lenses beside the pinhole, the fifth number of one
OUTSIDE = -1e4  # [px] where what the camera does not see is taken
FARTHEST = 4e3  # [px] that a piece can be from a picture's first pixel


@njit(**_OPTIONS)
def project_point(lens, x, y, z):
    """Return column and row of a point [m] in the camera frame; see `finforce.camera.project`.

    Args:
        lens: fx, fy, cx, cy, kind, eight coefficients of distortion, the widest angle [rad] (14,).
        x: of the point.
        y: of the point.
        z: of the point.
    """
    if not z > 0.0:
        return np.nan, np.nan
    u, v = x / z, y / z
    if lens[4] == FISHEYE:
        distance = np.hypot(u, v)
        angle = np.arctan(distance)
        s = angle * angle
        slope = 1.0 + s * (3.0 * lens[5] + s * (5.0 * lens[6] + s * (7.0 * lens[7] + s * 9.0 * lens[8])))
        if not (angle <= lens[13] and slope > 0.0):
            return np.nan, np.nan
        if distance > 1e-12:
            bent = angle * (1.0 + s * (lens[5] + s * (lens[6] + s * (lens[7] + s * lens[8]))))
            u, v = u * bent / distance, v * bent / distance
    elif lens[4] == POLYNOMIAL:
        k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
        s = u * u + v * v
        radial = 1.0 + s * (k1 + s * (k2 + s * k3))
        radial /= 1.0 + s * (lens[10] + s * (lens[11] + s * lens[12]))
        shift_u = 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)
        shift_v = p1 * (s + 2.0 * v * v) + 2.0 * p2 * u * v
        u, v = u * radial + shift_u, v * radial + shift_v
    return u * lens[0] + lens[2], v * lens[1] + lens[3]


@njit(**_OPTIONS)
def project_side(lens, T, side, places):
    """Return the pixels (n, 2) of places x, z (n, 2) [m] on a side (level, slopes) (3,) of a jaw at T (4, 4)."""
    pixels = np.empty(places.shape)
    for i in range(len(places)):
        x, z = places[i, 0], places[i, 1]
        y = side[0] + side[1] * x + side[2] * z
        pixels[i, 0], pixels[i, 1] = project_point(
            lens,
            T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
            T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
            T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
        )
    return pixels


@njit(**_OPTIONS)
def map_side(lens, T, side, grid, width, height, step):
    """Return the image column and row (height, width, 2) float32 at which the pixels of a picture of a side are taken.

    Every `step`-th pixel is projected, those between are on a line.

    Args:
        lens: as for `project_point`.
        T: T_camera_jaw (4, 4).
        side: level [m] and slopes (3,).
        grid: pixel size, x and z of the first pixel (3,) [m].
        width: of the picture [px].
        height: of the picture [px].
        step: between exact places [px].
    """
    rows, columns = (height - 1) // step + 2, (width - 1) // step + 2
    places = np.empty((rows * columns, 2))
    for knot in range(rows * columns):
        places[knot, 0] = grid[1] + grid[0] * step * (knot % columns)
        places[knot, 1] = grid[2] + grid[0] * step * (knot // columns)
    exact = project_side(lens, T, side, places)
    knots = np.empty((rows, columns, 2), np.float32)
    for knot in range(rows * columns):
        for k in range(2):
            seen = np.isfinite(exact[knot, k])
            knots[knot // columns, knot % columns, k] = exact[knot, k] if seen else OUTSIDE
    return fill_between(knots, width, height, step)


@njit(**_OPTIONS)
def fill_between(knots, width, height, step):
    """Return values (height, width, 2) float32 on lines between knots (rows, columns, 2) that are `step` apart."""
    filled = np.empty((height, width, 2), np.float32)
    line = np.empty(knots.shape[1:], np.float32)
    for r in range(height):
        i, down = r // step, np.float32((r % step) / step)
        for j in range(len(line)):
            for k in range(2):
                line[j, k] = knots[i, j, k] + down * (knots[i + 1, j, k] - knots[i, j, k])
        for c in range(width):
            j, across = c // step, np.float32((c % step) / step)
            for k in range(2):
                filled[r, c, k] = line[j, k] + across * (line[j + 1, k] - line[j, k])
    return filled


@njit(**_OPTIONS)
def undistort(lens, pixels, steps, tolerance):
    """Return the rays (n, 3), z = 1, through pixels (n, 2) of a lens that is no fisheye, and whether all were found.

    Rays of pixels that are NaN are NaN; see `finforce.camera.rays_from_pixels`.
    """
    rays, found = np.ones((len(pixels), 3)), True
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    for i in range(len(pixels)):
        aim_u, aim_v = (pixels[i, 0] - lens[2]) / lens[0], (pixels[i, 1] - lens[3]) / lens[1]
        u, v, change = aim_u, aim_v, 0.0
        for _ in range(steps if lens[4] == POLYNOMIAL else 0):
            s = u * u + v * v
            radial = 1.0 + s * (k1 + s * (k2 + s * k3))
            radial /= 1.0 + s * (lens[10] + s * (lens[11] + s * lens[12]))
            next_u = (aim_u - 2.0 * p1 * u * v - p2 * (s + 2.0 * u * u)) / radial
            next_v = (aim_v - p1 * (s + 2.0 * v * v) - 2.0 * p2 * u * v) / radial
            change = max(abs(next_u - u), abs(next_v - v))
            u, v = next_u, next_v
            if change < tolerance:
                break
        found = found and not change >= tolerance
        rays[i, 0], rays[i, 1] = u, v
        rays[i, 2] = 1.0 if np.isfinite(u) and np.isfinite(v) else np.nan
    return rays, found


@njit(**_OPTIONS)
def sample_side(depth, lens, T, points, offsets, used):
    """Return measured less expected depths (n, S) [m] at places around points of a side; NaN without one.

    Args:
        depth: (h, w) [m].
        lens: as for `project_point`.
        T: T_camera_jaw (4, 4).
        points: (n, 3) [m], jaw frame.
        offsets: (n, S, 3) of the places [m], jaw frame.
        used: (n, S) which of them there are.
    """
    height, width = depth.shape
    excess = np.full(used.shape, np.nan)
    for i in range(used.shape[0]):
        if not np.isfinite(points[i]).all():
            continue
        for s in range(used.shape[1]):
            if not used[i, s]:
                continue
            x, y, z = points[i, 0] + offsets[i, s, 0], points[i, 1] + offsets[i, s, 1], points[i, 2] + offsets[i, s, 2]
            away = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            u, v = project_point(
                lens,
                T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
                T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
                away,
            )
            if -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
                excess[i, s] = depth[int(np.rint(v)), int(np.rint(u))] - away
    return excess


@njit(**_OPTIONS)
def median_of(values, count):
    """Return the median of the first values (count,), NaN of none."""
    if count == 0:
        return np.nan
    part, middle = values[:count].copy(), count // 2
    low, high = 0, count - 1
    while low < high:  # values are only sorted as far as it takes to have the middle one in its place
        pivot, i, j = part[(low + high) // 2], low, high
        while i <= j:
            while part[i] < pivot:
                i += 1
            while part[j] > pivot:
                j -= 1
            if i <= j:
                part[i], part[j] = part[j], part[i]
                i, j = i + 1, j - 1
        if j < middle < i:
            break
        low, high = (low, j) if middle <= j else (i, high)
    return part[middle] if count % 2 else 0.5 * (part[:middle].max() + part[middle])


@njit(**_OPTIONS)
def weigh_samples(excess, centre, gate, quantum, limits):
    """Return excess, stddev, known, count, share and nearer (6, n) of `DepthEvidence`.

    Args:
        excess: (n, S) measured less expected depths [m], NaN where nothing was measured.
        centre: (n,) [m].
        gate: [m].
        quantum: [m].
        limits: how many deviations are believed, MAD to standard deviation, how many samples are alike (3,).
    """
    n, size = excess.shape
    found, chosen, apart = np.zeros((6, n)), np.empty(size), np.empty(size)
    for i in range(n):
        known, near, count = 0, 0, 0
        for s in range(size):
            away = excess[i, s] - centre[i]
            if not np.isfinite(away):
                continue
            known += 1
            if away < -gate:
                near += 1
            elif not away > gate:
                chosen[count] = away
                count += 1
        middle = median_of(chosen, count)
        for s in range(count):
            apart[s] = abs(chosen[s] - middle)
        spread = limits[1] * median_of(apart, count)
        widest, total, kept = limits[0] * max(spread, 0.5 * quantum), 0.0, 0
        for s in range(count):
            if abs(chosen[s] - middle) <= widest:
                total += chosen[s]
                kept += 1
        found[0, i] = total / kept + centre[i] if kept else np.nan
        rounded = max(spread, quantum / np.sqrt(12.0)) if count else np.nan
        found[1, i] = rounded / np.sqrt(max(kept / limits[2], 1.0))
        found[2, i], found[3, i] = known, kept
        found[4, i], found[5, i] = kept / max(known, 1), near / max(known, 1)
    return found


@njit(**_OPTIONS)
def fit_shape(places, relief, beforehand, measured, stddev, lever, error, limits):
    """Return y, stddev and misfit (3, K + 1), and the scale's error and its stddev; see `depth.fit_side`.

    Args:
        places: (K + 1, 2) x and z at rest [m], the reference point last.
        relief: of single key points [m].
        beforehand: (5,) standard deviations of offset, tilts, bow and scale.
        measured: (K + 1,) [m], NaN without depth.
        stddev: (K + 1,) [m].
        lever: (K + 1,) [m].
        error: of the scale, so far.
        limits: least standard deviation, deviations of an outlier, number of steps (3,).
    """
    count = len(measured)
    seen, noise, own = np.isfinite(measured), np.ones(count), np.zeros(count)
    rows, known, left = np.zeros((count, 5)), measured - lever * error, np.full(count, np.nan)
    own[:-1] = relief**2
    rows[:-1, 0], rows[:-1, 1], rows[:-1, 2], rows[:-1, 3] = 1.0, places[:-1, 0], places[:-1, 1], places[:-1, 1] ** 2
    rows[:, 4] = lever
    noise[seen] = np.maximum(stddev[seen], limits[0]) ** 2
    variance = noise.copy()
    prior = np.diag(1.0 / np.maximum(beforehand, limits[0]) ** 2)
    covariance, theta = prior, beforehand
    for _ in range(int(limits[2])):
        covariance, theta = solve_weighted(prior, rows, known, seen, own + noise)
        left = known - rows @ theta
        noise = variance * (1.0 + left**2 / (own + variance) / limits[1] ** 2)
    found, spread = np.full((3, count), np.nan), np.empty(5)
    for i in range(count):
        share = own[i] / (own[i] + noise[i]) if seen[i] else 0.0
        spread[:] = (1.0 - share) * rows[i]
        spread[4] = -share * rows[i, 4]
        found[0, i] = rows[i, :4] @ theta[:4] + (share * left[i] if seen[i] else 0.0)
        found[1, i] = np.sqrt(spread @ (covariance @ spread) + (1.0 - share) * own[i])
        if seen[i]:
            found[2, i] = left[i] / np.sqrt(own[i] + variance[i])
    return found, error + theta[4], np.sqrt(covariance[4, 4])


@njit(**_OPTIONS)
def solve_weighted(prior, rows, known, seen, variance):
    """Return covariance (m, m) and mean (m,) by least squares with a prior information (m, m), of rows (n, m) seen."""
    size = len(prior)
    A, g = prior.copy(), np.zeros(size)
    for i in range(len(rows)):
        if not seen[i]:
            continue
        w = 1.0 / variance[i]
        for a in range(size):
            g[a] += w * rows[i, a] * known[i]
            for b in range(size):
                A[a, b] += w * rows[i, a] * rows[i, b]
    covariance = np.eye(size)
    eliminate(A, covariance)
    return covariance, covariance @ g


@njit(**_OPTIONS)
def cut_pieces(picture, centres, size):
    """Return pieces (K, size, size, 3) uint8 of a picture (h, w, 3) around places (K, 2) [px], its edge continued."""
    height, width = picture.shape[:2]
    pieces = np.empty((len(centres), size, size, 3), np.uint8)
    line = np.empty(3 * (size + 1), np.float32)
    upper, lower = np.empty(3 * size, np.float32), np.empty(3 * size, np.float32)
    for k in range(len(centres)):
        x, y = centres[k]
        if not (abs(x) < FARTHEST and abs(y) < FARTHEST):
            x = y = -FARTHEST
        left, top = x - 0.5 * (size - 1), y - 0.5 * (size - 1)
        column, row = int(np.floor(left)), int(np.floor(top))
        across, down = np.float32(left - column), np.float32(top - row)
        piece = pieces[k].reshape(size, 3 * size)
        for r in range(size + 1):
            here = min(max(row + r, 0), height - 1)
            for c in range(size + 1):
                there = min(max(column + c, 0), width - 1)
                for n in range(3):
                    line[3 * c + n] = picture[here, there, n]
            for n in range(3 * size):
                upper[n] = lower[n]
                lower[n] = line[n] + across * (line[n + 3] - line[n])
            if r > 0:
                for n in range(3 * size):
                    piece[r - 1, n] = np.uint8(upper[n] + down * (lower[n] - upper[n]) + np.float32(0.5))
    return pieces


@njit(**_OPTIONS)
def fit_motion(shapes, pairs, moves, stddev, weight, limits):
    """Return the motion (K, 2) [px] within a finger's shapes that is nearest to another; see `shapes.fit_motion`.

    Args:
        shapes: (2 K, m), the last columns those of products.
        pairs: (p, 2) of which columns.
        moves: (K, 2) [px], not finite where nobody knows.
        stddev: (K,) [px].
        weight: (K,).
        limits: largest size, number of rounds, change [px] after which there is no other (3,).
    """
    sizes, believed = np.zeros(shapes.shape[1] - len(pairs)), np.zeros(len(moves))
    found, doubt = np.zeros(moves.shape), np.ones(len(moves))
    for k in range(len(moves)):
        if np.isfinite(moves[k, 0]) and np.isfinite(moves[k, 1]) and np.isfinite(stddev[k]):
            believed[k] = weight[k] / stddev[k] ** 2
    for _ in range(int(limits[1])):
        sizes = improve_sizes(shapes, pairs, sizes, moves - found, believed * doubt)
        sizes = np.minimum(np.maximum(sizes, -limits[0]), limits[0])
        before, found = found, move_by(shapes, pairs, sizes)
        if np.abs(found - before).max() < limits[2]:
            break
        for k in range(len(moves)):
            if believed[k] > 0.0:
                apart = (moves[k, 0] - found[k, 0]) ** 2 + (moves[k, 1] - found[k, 1]) ** 2
                doubt[k] = 1.0 / (1.0 + 0.5 * apart / stddev[k] ** 2)
    return found


@njit(**_OPTIONS)
def improve_sizes(shapes, pairs, sizes, left, weight):
    """Return the sizes (n,) of shapes by least squares of what is left (K, 2) [px], to first order around some."""
    count = len(sizes)
    A, g, slope = np.eye(count), np.zeros((count, 1)), np.empty(count)
    for row in range(len(shapes)):
        w = weight[row // 2]
        if not w > 0.0:
            continue
        slope[:] = shapes[row, :count]
        for p in range(len(pairs)):
            i, j = pairs[p]
            slope[i] += sizes[j] * shapes[row, count + p]
            slope[j] += sizes[i] * shapes[row, count + p]
        aim = left[row // 2, row % 2] + (slope * sizes).sum()
        for a in range(count):
            g[a, 0] += w * slope[a] * aim
            for b in range(count):
                A[a, b] += w * slope[a] * slope[b]
    eliminate(A, g)
    return g.reshape(count)


@njit(**_OPTIONS)
def move_by(shapes, pairs, sizes):
    """Return the motion (K, 2) [px] of shapes by their sizes (n,)."""
    moved = np.zeros((len(shapes) // 2, 2))
    for row in range(len(shapes)):
        for a in range(len(sizes)):
            moved[row // 2, row % 2] += shapes[row, a] * sizes[a]
        for p in range(len(pairs)):
            moved[row // 2, row % 2] += shapes[row, len(sizes) + p] * sizes[pairs[p, 0]] * sizes[pairs[p, 1]]
    return moved
