"""The probability that an object touches, by its pose and by how deep the key points have the jaw pressed."""

from math import erf, exp, pi, sqrt

from finforce_ifea.observation import Contact
from finforce_ifea.tracking.contact_state import ContactState

_NEGLIGIBLE = 1e-300
_LEAST_STDDEV = 0.02e-3  # [m] of a depth


def contact_probability(depth: float, depth_stddev: float, bend: float, bend_stddev: float) -> float:
    """Return the probability that an object is in the jaw, by its pose and by how far the jaw is bent.

    The true depth u of the object beyond the undeformed surface has the density N(u; depth, depth_stddev), and the
    surface gives way by max(u, 0), seen as `bend` with a normal error. With s = depth_stddev, t = bend_stddev and the
    mean m of u that both ask for:

        P(u > 0) ~ N(bend; depth, s^2 + t^2) Phi(m (s^2 + t^2)^0.5 / (s t)),
        P(u <= 0) ~ N(bend; 0, t^2) Phi(-depth / s).

    Args:
        depth: of the object beyond the undeformed surface as the pose has it, negative before contact [m].
        depth_stddev: its standard deviation [m].
        bend: of the surface as the key points have it [m].
        bend_stddev: its standard deviation [m].
    """
    s, t = depth_stddev**2, bend_stddev**2
    mean, spread = (depth * t + bend * s) / (s + t), sqrt(s * t / (s + t))
    touches = _normal(bend - depth, sqrt(s + t)) * _below(mean / spread)
    apart = _normal(bend, bend_stddev) * _below(-depth / depth_stddev)
    total = touches + apart
    if total > _NEGLIGIBLE:
        return touches / total
    return 1.0 if bend > 0.5 * abs(depth) or depth > 0.0 else 0.0


def find_touch_probability(state: ContactState, contact: Contact, face_x: float) -> float:
    """Return the probability that the object of a contact touches.

    Args:
        state: of the image.
        contact: with the object's outline, without which its pose tells nothing.
        face_x: of the undeformed inner surface [m].
    """
    stddev = max(sqrt(state["depth_variance"]), _LEAST_STDDEV)
    if not state["depth_variance"] > 0.0:  # a given contact: its force alone
        return _below(float(state["magnitude"] / max(state["stddev"], _NEGLIGIBLE)))
    depth, outline = float(state["depth"]), contact.outline
    if outline is None:
        return _below(depth / stddev)
    return contact_probability(face_x - outline.nearest, float(outline.stddev[0]), depth, stddev)


def _normal(value: float, stddev: float) -> float:
    """Return the density of a normal distribution about zero."""
    return exp(-0.5 * (value / stddev) ** 2) / (sqrt(2.0 * pi) * stddev)


def _below(value: float) -> float:
    """Return the standard normal distribution function."""
    return 0.5 * (1.0 + erf(value / sqrt(2.0)))
