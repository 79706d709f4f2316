"""An executor of rclpy that survives bytes that are no message."""

from __future__ import annotations

from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import get_logger


class TolerantExecutor(SingleThreadedExecutor):
    """Drops bytes that are no message of their topic's type; rclpy's own executor would end with the node."""

    def _take_subscription(self, sub: Any) -> Any:
        """Return what calls back with a message; nothing for one that the middleware cannot read."""
        try:
            return super()._take_subscription(sub)
        except RuntimeError as error:
            get_logger("finforce").warning(f"dropped a message on {sub.topic_name}: {error}", throttle_duration_sec=2.0)
            return None
