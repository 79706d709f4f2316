"""Layout of the filter's state vector x (n,) and of its covariance P (n, n).

    x = (d, s, h, dk, c_x, c_z, c_phi, c_s, e, o_1 ... o_K, r_1 ... r_K)

d is the depth of the object [m], s its shape (radius [m], or tilt [rad]) and h its height [m]; dk is the
traction ratio beyond what friction explains [-]; (c_x, c_z) [m] and c_phi [rad] are the shift and turn of the jaw in
the camera's view since the tare, and c_s [-] is its stretch along z; e is the traction ratio that errors of the
mechanics look like [-]. Each key point has, along x and z, an offset o [m] and an error r of the mechanics relative to
the point's displacement [-].
"""

from __future__ import annotations

DEPTH, SHAPE, HEIGHT, TRACTION, CAMERA_X, CAMERA_Z, CAMERA_TURN, CAMERA_STRETCH, APPARENT = range(9)
# Number of entries that no single key point owns.
SHARED = 9


def state_size(keypoints: int) -> int:
    """Return n for a number of key points."""
    return SHARED + 4 * keypoints
