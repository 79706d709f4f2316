"""What contacts say about themselves, in words for the diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from finforce.health import Level, Outcome
from finforce_contact.mesh.object_mesh import describe_mesh

if TYPE_CHECKING:
    from finforce_contact.estimator import ContactEstimate
    from finforce_contact.jaw_contact import JawContact
    from finforce_contact.localization.slip import Slip
    from finforce_contact.mesh.triangles import ObjectMesh
    from finforce_contact.pose.source import ObjectPose
    from finforce_contact.session import ContactSession

LEVELS = {"touching": Level.OK, "apart": Level.OK}  # any other status: WARN


def outcome_of_estimate(estimate: ContactEstimate) -> Outcome:
    """Return the level of an estimate's status and its sentence."""
    if estimate.slip is not None and estimate.slip.sliding:
        return Outcome(level=Level.WARN, reason="slip", text=f"the object slides: {describe_slip(estimate.slip)}")
    level = LEVELS.get(estimate.status, Level.WARN)
    return Outcome(level=level, reason=estimate.status, text=estimate.message or estimate.status)


def object_alarms(session: ContactSession) -> list[Outcome]:
    """Return the alarm of an object mesh that cannot be used."""
    return [Outcome(level=Level.ERROR, reason="object", text=session.trouble)] if session.trouble else []


def describe(session: ContactSession, side: str) -> dict[str, str]:
    """Return what is known of the object and of its contact with one jaw, as text."""
    return _describe_object(session.mesh, session.pose) | _describe_contact(session.jaws[side])


def _describe_contact(jaw: JawContact) -> dict[str, str]:
    """Return the figures of a jaw's last contact, and the work done and skipped since the start."""
    counts = ", ".join(f"{count} {reason}" for reason, count in jaw.estimator.counts.items() if count) or "none"
    last = jaw.last
    if last is None:
        return {"work": counts}
    return {
        "status": last.estimate.status,
        "contacts": str(len(last.estimate.points)),
        "pose age [ms]": f"{1e3 * jaw.pose_age():.0f}",
        "jaw surface": "deformed" if jaw.has_surface() else "undeformed: no fresh surface",
        "slip": describe_slip(last.estimate.slip),
        "last skipped": last.estimate.skipped or "nothing",
        "work": counts,
    }


def describe_slip(slip: Slip | None) -> str:
    """Return how an object moves over a jaw, in words."""
    if slip is None or not np.isfinite(slip.stddev):
        return "unknown"
    speed = 1e3 * float(np.linalg.norm(slip.velocity))
    return f"{speed:.1f} ± {1e3 * slip.stddev:.1f} mm/s{', slides' if slip.sliding else ''}"


def _describe_object(mesh: ObjectMesh | None, pose: ObjectPose | None) -> dict[str, str]:
    if mesh is None:
        return {"object": "unknown"}
    known = {"object": describe_mesh(mesh)}
    return known if pose is None else known | {"pose source": pose.source, "pose fitness": f"{pose.fitness:.2f}"}
