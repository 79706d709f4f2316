"""The parameters of the player node."""

from __future__ import annotations

from dataclasses import dataclass

from finforce.settings import setting


@dataclass(frozen=True, kw_only=True)
class PlayerParameters:
    """What the player is told; units stand in the metadata."""

    bag: str = setting("", "recording to be played: rosbag2 folder, .mcap or .db3")
    rate: float = setting(1.0, "speed of playing, 1 as recorded", "", 0.01, 100.0)
    awaits_poses: bool = setting(False, "wait for listeners to the poses of the jaws, too")
    awaits_images: bool = setting(
        False, "wait for who finds key points in the images, and for those who use the key points"
    )
    patience: float = setting(120.0, "wait for listeners, which compile first", "s", 0.0, 3600.0)
