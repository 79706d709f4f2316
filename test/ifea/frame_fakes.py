"""A cylinder pressed on a frame, for tests."""

import numpy as np

PENALTY = 1.5e5  # N/m per contact point, one every 0.5 mm


class Press:
    """A rigid cylinder pressed into the inner face by a penalty, step by step."""

    def __init__(self, model, jaw, radius, height):
        self.model, self.radius, self.height, self.face = model, radius, height, jaw.inner_face_x
        z = np.arange(0.5e-3, jaw.drawing.length - 0.4e-3, 0.5e-3)
        self.probe = model.attach(np.stack([np.full_like(z, self.face), 0 * z, z], axis=1), 1e-3)
        self.q, self.depth, self.force = np.zeros(model.size), 0.0, np.zeros(3)

    def to(self, depth, step=1e-3):
        for current in np.linspace(self.depth, depth, int(np.ceil((depth - self.depth) / step)) + 1)[1:]:
            self._settle(np.array([self.face + self.radius - current, 0.0, self.height]))
        self.depth = depth
        return self

    def _settle(self, axis):
        model = self.model
        for _ in range(100):
            away = model.positions(self.probe, self.q) - axis
            distance = np.linalg.norm(away, axis=1)
            normal, inside = away / distance[:, None], np.maximum(self.radius - distance, 0.0)
            forces, across = PENALTY * inside[:, None] * normal, normal[:, [2, 1, 0]] * [1, 0, -1]
            springs = np.einsum("pi,pj->pij", normal, normal) * (PENALTY * (inside > 0))[:, None, None]
            springs -= np.einsum("pi,pj->pij", across, across) * (PENALTY * inside / distance)[:, None, None]
            state = model.linearize(self.q)
            model.stiffen(state.tangent, self.probe, self.q, springs)
            load = model.load(self.probe, self.q, forces) - state.force
            step = model.factorise(state.tangent).solve(load)
            largest = np.abs(np.where(model.rotations, 7e-3 * step, step)).max()
            self.q = self.q + step * min(1.0, 2e-3 / max(largest, 1e-12))
            if largest < 1e-8:
                self.force = forces.sum(axis=0)
                return
        raise AssertionError(f"no equilibrium at {axis}")


def line_stiffness(model, height):
    """N/m of the unloaded finger under a force along -x on its inner face."""
    probe = model.attach(np.array([[model.drawing.inner_face_x, 0.0, height]]), 1e-3)
    q = np.zeros(model.size)
    load = model.load(probe, q, np.array([[-1.0, 0.0, 0.0]]))
    step = model.factorise(model.linearize(q).tangent).solve(load)
    return -1.0 / model.project(probe, q, step[:, None])[0, 0, 0]
