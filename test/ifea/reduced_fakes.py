"""Objects pressed into the bench finger by any mechanics, step by step, as a tracker would do."""

import numpy as np

from finforce_ifea.contact_mechanics.pressed_jaw import limit_step

STEP = 0.5e-3


def settle(contact, q, place):
    """The equilibrium of a place by Newton's method, and its linearisation; None when there is none."""
    for _ in range(40):
        state = contact.linearize(q, place)
        if not state.touches:
            q = q + contact.approach(q, state.correction, place)
            continue
        q = q + state.correction
        if state.size < 1e-6:
            return q, contact.linearize(q, place)
    return None


def press(contact, indenter, shape, height, depths):
    """Unknowns and linearisations at rising depths [m] below first touch."""
    contact.indenter = indenter
    touch = indenter.find_touch(np.array([0.0, shape, height]), *contact.surface.heights[[0, -1]])
    q, state, reached, results = contact.begin(height), None, 0.0, []
    for depth in depths:
        for deeper in np.linspace(reached, depth, max(1, round((depth - reached) / STEP)) + 1)[1:]:
            if state is not None:
                q = q + limit_step(contact.model, state.modes[:, 0] * (deeper - reached))
            q, state = settle(contact, q, np.array([touch + deeper, shape, height]))
            reached = deeper
        results.append((q, state))
    return results


def box(size, edge=1e-3):
    """The outline (n, 2) [m] of a square with rounded edges."""
    middle = 0.5 * size - edge
    turns = np.arange(4) * 0.5 * np.pi
    arcs = turns[:, None] + np.linspace(0.0, 0.5 * np.pi, 6)
    centres = middle * np.sign(np.stack([np.cos(turns + 0.25 * np.pi), np.sin(turns + 0.25 * np.pi)], axis=1))
    return (centres[:, None] + edge * np.stack([np.cos(arcs), np.sin(arcs)], axis=2)).reshape(-1, 2)
