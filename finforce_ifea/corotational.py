"""Compiled element loops of the co-rotational solid; knows elements and node coordinates, no boundary conditions."""

import numpy as np
from numba import njit

_OPTIONS = {"cache": True, "fastmath": {"contract", "reassoc", "nsz", "arcp"}, "error_model": "numpy"}


@njit(**_OPTIONS)
def _invert3(A, out):
    a, b, c = (
        A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1],
        A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2],
        A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0],
    )
    det = A[0, 0] * a + A[0, 1] * b + A[0, 2] * c
    s = 1.0 / det
    out[0, 0], out[1, 0], out[2, 0] = a * s, b * s, c * s
    out[0, 1] = (A[0, 2] * A[2, 1] - A[0, 1] * A[2, 2]) * s
    out[1, 1] = (A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]) * s
    out[2, 1] = (A[0, 1] * A[2, 0] - A[0, 0] * A[2, 1]) * s
    out[0, 2] = (A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]) * s
    out[1, 2] = (A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]) * s
    out[2, 2] = (A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]) * s
    return det


@njit(**_OPTIONS)
def _polar_rotation(F, R, inverse):
    """Overwrites R with the rotation of F = R U by Newton's iteration; returns det F."""
    for i in range(3):
        for j in range(3):
            R[i, j] = F[i, j]
    det = 1.0
    for iteration in range(30):
        d = _invert3(R, inverse)
        if iteration == 0:
            det = d
        change = 0.0
        for i in range(3):
            for j in range(3):
                value = 0.5 * (R[i, j] + inverse[j, i])
                change = max(change, abs(value - R[i, j]))
                R[i, j] = value
        if change < 1e-14:
            break
    return det


@njit(**_OPTIONS)
def corotational_elements(u, conn, X, K0, g, with_tangent, f, Ke):
    """Adds internal forces to f and writes element tangents.

    With F = sum (X_i + u_i) g_i^T = R U, x' = R^T x, d = x' - X (about the element's centroid) the energy is
    d.K0.d / 2. Its gradient is f_i = R (f'_i - G_i^T m), f' = K0 d, m = sum x'_i x f'_i, G_i = (tr(U) I - U)^-1 [g_i].
    The tangent is R (P^T K0 P - [p] G - G^T [f']^T P) R^T, symmetrised; P = I - S G, and S of the undeformed shape
    drops out because K0 does not feel rotations.

    Args:
        u: displacements (n, 3) [m].
        conn: element nodes (m, k).
        X: element node coordinates about their centroid (m, k, 3) [m].
        K0: element stiffness (m, 3 k, 3 k) [N/m].
        g: shape function gradients at the centre (m, k, 3) [1/m].
        with_tangent: whether to fill Ke.
        f: internal forces (n, 3) [N], added to.
        Ke: element tangents (m, 3 k, 3 k) [N/m], overwritten (lower 3 x 3 blocks only).

    Returns:
        Elastic energy [J] and the smallest det F of all elements.

    Source: Felippa, Haugen, A unified formulation of small-strain corotational finite elements, CMAME 194 (2005).
    """
    m, k = conn.shape
    n = 3 * k
    F, R, U, H, scratch = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
    )
    x, d, fl, p = np.empty((k, 3)), np.empty(n), np.empty(n), np.empty(n)
    G, KS, T, B = np.empty((3, n)), np.empty((n, 3)), np.empty((n, n)), np.empty((3, 3))
    energy, smallest = 0.0, 1e300
    for e in range(m):
        F[:] = 0.0
        F[0, 0] = F[1, 1] = F[2, 2] = 1.0
        mean0 = mean1 = mean2 = 0.0
        for i in range(k):
            node = conn[e, i]
            for a in range(3):
                for b in range(3):
                    F[a, b] += u[node, a] * g[e, i, b]
            mean0 += u[node, 0]
            mean1 += u[node, 1]
            mean2 += u[node, 2]
        mean0, mean1, mean2 = mean0 / k, mean1 / k, mean2 / k
        det = _polar_rotation(F, R, scratch)
        smallest = min(smallest, det)
        for i in range(k):
            node = conn[e, i]
            w0, w1, w2 = (
                X[e, i, 0] + u[node, 0] - mean0,
                X[e, i, 1] + u[node, 1] - mean1,
                X[e, i, 2] + u[node, 2] - mean2,
            )
            for a in range(3):
                x[i, a] = R[0, a] * w0 + R[1, a] * w1 + R[2, a] * w2
                d[3 * i + a] = x[i, a] - X[e, i, a]
        m0 = m1 = m2 = 0.0
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += K0[e, i, j] * d[j]
            fl[i] = s
            energy += 0.5 * s * d[i]
        for i in range(k):
            f0, f1, f2 = fl[3 * i], fl[3 * i + 1], fl[3 * i + 2]
            m0 += x[i, 1] * f2 - x[i, 2] * f1
            m1 += x[i, 2] * f0 - x[i, 0] * f2
            m2 += x[i, 0] * f1 - x[i, 1] * f0
        for a in range(3):
            for b in range(3):
                U[a, b] = -(R[0, a] * F[0, b] + R[1, a] * F[1, b] + R[2, a] * F[2, b])
        trace = -(U[0, 0] + U[1, 1] + U[2, 2])
        for a in range(3):
            U[a, a] += trace
        _invert3(U, H)
        h0 = H[0, 0] * m0 + H[1, 0] * m1 + H[2, 0] * m2
        h1 = H[0, 1] * m0 + H[1, 1] * m1 + H[2, 1] * m2
        h2 = H[0, 2] * m0 + H[1, 2] * m1 + H[2, 2] * m2
        for i in range(k):
            g0, g1, g2 = g[e, i, 0], g[e, i, 1], g[e, i, 2]
            p[3 * i] = fl[3 * i] + g1 * h2 - g2 * h1
            p[3 * i + 1] = fl[3 * i + 1] + g2 * h0 - g0 * h2
            p[3 * i + 2] = fl[3 * i + 2] + g0 * h1 - g1 * h0
            node = conn[e, i]
            for a in range(3):
                f[node, a] += R[a, 0] * p[3 * i] + R[a, 1] * p[3 * i + 1] + R[a, 2] * p[3 * i + 2]
        if not with_tangent:
            continue
        for i in range(k):
            g0, g1, g2 = g[e, i, 0], g[e, i, 1], g[e, i, 2]
            for a in range(3):
                G[a, 3 * i] = H[a, 1] * g2 - H[a, 2] * g1
                G[a, 3 * i + 1] = H[a, 2] * g0 - H[a, 0] * g2
                G[a, 3 * i + 2] = H[a, 0] * g1 - H[a, 1] * g0
        for i in range(n):
            s0 = s1 = s2 = 0.0
            for j in range(k):
                k0, k1, k2 = K0[e, i, 3 * j], K0[e, i, 3 * j + 1], K0[e, i, 3 * j + 2]
                d0, d1, d2 = d[3 * j], d[3 * j + 1], d[3 * j + 2]
                s0 += k2 * d1 - k1 * d2
                s1 += k0 * d2 - k2 * d0
                s2 += k1 * d0 - k0 * d1
            KS[i, 0], KS[i, 1], KS[i, 2] = s0, s1, s2
        for a in range(3):
            for b in range(3):
                s = 0.0
                for i in range(k):
                    # rows of S^T: (S_i w) = w x d_i
                    i1, i2 = (a + 1) % 3, (a + 2) % 3
                    s += d[3 * i + i1] * KS[3 * i + i2, b] - d[3 * i + i2] * KS[3 * i + i1, b]
                B[a, b] = s
        # L = K0 S + ([p] + [f']) / 2 collects what multiplies G on the right; its transpose stands on the left.
        for i in range(k):
            q0, q1, q2 = (
                0.5 * (p[3 * i] + fl[3 * i]),
                0.5 * (p[3 * i + 1] + fl[3 * i + 1]),
                0.5 * (p[3 * i + 2] + fl[3 * i + 2]),
            )
            KS[3 * i, 1] -= q2
            KS[3 * i, 2] += q1
            KS[3 * i + 1, 0] += q2
            KS[3 * i + 1, 2] -= q0
            KS[3 * i + 2, 0] -= q1
            KS[3 * i + 2, 1] += q0
        # G^T [f']^T S G: the second-order part of P in the last term, symmetrised.
        for a in range(3):
            for b in range(3):
                s = 0.0
                for i in range(k):
                    dot = x[i, 0] * fl[3 * i] + x[i, 1] * fl[3 * i + 1] + x[i, 2] * fl[3 * i + 2]
                    s += 0.5 * (x[i, a] * fl[3 * i + b] + x[i, b] * fl[3 * i + a])
                    if a == b:
                        s -= dot
                scratch[a, b] = s
        for a in range(3):
            for b in range(3):
                B[a, b] += scratch[a, b]
        for i in range(n):
            b0 = G[0, i] * B[0, 0] + G[1, i] * B[1, 0] + G[2, i] * B[2, 0] - KS[i, 0]
            b1 = G[0, i] * B[0, 1] + G[1, i] * B[1, 1] + G[2, i] * B[2, 1] - KS[i, 1]
            b2 = G[0, i] * B[0, 2] + G[1, i] * B[1, 2] + G[2, i] * B[2, 2] - KS[i, 2]
            l0, l1, l2 = G[0, i], G[1, i], G[2, i]
            for j in range(3 * (i // 3) + 3):
                T[i, j] = (
                    K0[e, i, j]
                    + b0 * G[0, j]
                    + b1 * G[1, j]
                    + b2 * G[2, j]
                    - l0 * KS[j, 0]
                    - l1 * KS[j, 1]
                    - l2 * KS[j, 2]
                )
        for i in range(k):
            for j in range(i + 1):
                for a in range(3):
                    for b in range(3):
                        scratch[a, b] = (
                            R[a, 0] * T[3 * i, 3 * j + b]
                            + R[a, 1] * T[3 * i + 1, 3 * j + b]
                            + R[a, 2] * T[3 * i + 2, 3 * j + b]
                        )
                for a in range(3):
                    for b in range(3):
                        Ke[e, 3 * i + a, 3 * j + b] = (
                            scratch[a, 0] * R[b, 0] + scratch[a, 1] * R[b, 1] + scratch[a, 2] * R[b, 2]
                        )
    return energy, smallest
