"""The parameters of the player node."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class PlayerParameters:
    """What the player is told; units stand in the metadata."""

    bag: str = field(default="", metadata={"description": "recording to be played: rosbag2 folder, .mcap or .db3"})
    rate: float = field(
        default=1.0,
        metadata={"description": "speed of playing, 1 as recorded", "unit": "", "min": 0.01, "max": 100.0},
    )
    awaits_poses: bool = field(
        default=False, metadata={"description": "wait for listeners to the poses of the jaws, too"}
    )
    awaits_images: bool = field(
        default=False,
        metadata={"description": "wait for who finds key points in the images, and for those who use the key points"},
    )
    patience: float = field(
        default=120.0,
        metadata={
            "description": "wait for listeners, which compile first",
            "unit": "s",
            "min": 0.0,
            "max": 3600.0,
        },
    )
