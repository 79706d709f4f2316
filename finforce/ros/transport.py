"""How Fast DDS is to carry images."""

from __future__ import annotations

import os
from pathlib import Path

TRANSPORT = Path(__file__).with_name("fastdds.xml")
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
CHOICES = (PROFILES, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")


def provide_transport() -> None:
    """Have Fast DDS carry images, which its default loses, unless somebody has chosen how it works already."""
    if TRANSPORT.is_file() and not any(os.environ.get(name) for name in CHOICES):
        os.environ[PROFILES] = str(TRANSPORT)
