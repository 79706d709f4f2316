"""What averaged residuals tell of the state of a contact, where neighbouring key points err alike."""

import numpy as np
import pytest

from finforce_ifea.tracking.contact_filter import link_neighbours, sum_averages
from finforce_ifea.tracking.contact_state import AVERAGE, KEYPOINT

# two sides of a finger that meet at the tip, out of order [m]
HEIGHTS, WAYS = [20, 12, 13, 30, 24, 35, 44, 38], [10, 10, -9, 10, -6, -2, 8, 10]
REST = 1e-3 * np.column_stack((WAYS, np.zeros(8), HEIGHTS))
SIDES = [[1, 0, 3, 7, 6], [2, 4, 5]]  # from the base to the tip
PATCH = 15e-3


def draw(seed, sight):
    random = np.random.default_rng(seed)
    points, average = np.zeros(len(REST), KEYPOINT), np.zeros(len(REST), AVERAGE)
    link_neighbours(points, REST)
    for point, mean in zip(points, average, strict=True):
        root = random.normal(size=(2, 2)) * 1e-4
        point["noise"] = root @ root.T + 1e-9 * np.eye(2)
        point["sight"] = sight * random.uniform(0.5, 2.0)
        point["bias"] = point["sight"] + random.uniform(1e-9, 1e-8)
        mean["modes"] = random.normal(size=(2, 4))
        mean["residual"], mean["count"] = 1e-4 * random.normal(size=2), random.uniform(0.6, 40.0)
    average["count"][3] = 0.2  # hidden
    return points, average


def solve(points, average):
    """Return the normal equations by the covariance of all averaged residuals."""
    count = len(points)
    covariance, rows, right = np.zeros((count, 2, count, 2)), np.zeros((count, 2, 4)), average["residual"].copy()
    for k, (point, mean) in enumerate(zip(points, average, strict=True)):
        own = point["noise"] / max(mean["count"], 1.0) + (point["bias"] - 0.95 * point["sight"]) * np.eye(2)
        covariance[k, :, k] += own
        rows[k] = mean["modes"]
    for side in SIDES:
        for a, i in enumerate(side):
            for b, j in enumerate(side):
                path = REST[side[min(a, b) : max(a, b) + 1]]
                way = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
                alike = 0.2 * np.sqrt(points["sight"][i] * points["sight"][j]) * np.exp(-way / PATCH)
                covariance[i, :, j] += alike * np.eye(2)
    seen = average["count"] > 0.5
    C = covariance[seen][:, :, seen].reshape(2 * seen.sum(), -1)
    H, r = rows[seen].reshape(-1, 4), right[seen].ravel()
    return H.T @ np.linalg.solve(C, H), H.T @ np.linalg.solve(C, r)


@pytest.mark.parametrize("sight", [0.0, 1e-8, 4e-7])
def test_neighbours_that_err_alike_count_by_the_covariance_of_all(sight):
    for seed in range(5):
        points, average = draw(seed, sight)
        for found, expected in zip(sum_averages(points, average), solve(points, average), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_each_side_of_a_finger_is_a_chain_of_its_own():
    points = np.zeros(len(REST), KEYPOINT)
    link_neighbours(points, REST)
    for side in SIDES:
        assert [points["above"][k] for k in side] == [*(k + 1 for k in side[1:]), 0]
        assert points["likeness"][side[0]] == 0.0
        assert (points["likeness"][side[1:]] > 0.3).all()
