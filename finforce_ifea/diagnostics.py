"""What a solution says about itself, in words for the diagnostics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from finforce.health import Level, Outcome

if TYPE_CHECKING:
    from finforce_ifea.observation import Solution

LEVELS = {"ok": Level.OK, "unloaded": Level.OK, "diverged": Level.ERROR}  # any other status: WARN


def outcome_of_solution(solution: Solution) -> Outcome:
    """Return the level of a solution's status and its sentence."""
    level = LEVELS.get(solution.status, Level.WARN)
    return Outcome(level=level, reason=solution.status, text=solution.message or solution.status)


def describe_solution(solution: Solution | None) -> dict[str, str]:
    """Return the figures of the last solution as text, nothing before the first."""
    if solution is None:
        return {}
    used = np.asarray(solution.keypoints_used)
    return {
        "status": solution.status,
        "key points used": f"{int(used.sum())} of {used.size}",
        "force [N]": f"{np.linalg.norm(solution.force):.3f}",
        "force standard deviation [N]": f"{solution.magnitude_stddev:.3f}",
        "residual [mm]": f"{1e3 * solution.residual:.3f}",
        "kkt": f"{solution.kkt:.2e}",
        "iterations": str(solution.iterations),
    }


def peer_alarms(peer: str, silence: float, limit: float) -> list[Outcome]:
    """Return the alarm of a jaw `peer` that has not been heard of for longer than `limit` [s]."""
    if not peer or silence <= limit:
        return []
    text = f"no wrench of the {peer} jaw, therefore no grasp_wrench"
    return [Outcome(level=Level.WARN, reason="peer", text=text)]
