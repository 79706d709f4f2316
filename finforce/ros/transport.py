"""How Fast DDS is to carry images, and which domain is free.

Memory that is kept for the next image instead of being given back.
"""

from __future__ import annotations

import ctypes
import os
import random
import socket
import sys
from pathlib import Path

TRANSPORT = Path(__file__).with_name("fastdds.xml")
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
CHOICES = (PROFILES, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")


def provide_transport() -> None:
    """Have Fast DDS carry images, which its default loses, unless somebody has chosen how it works already."""
    if TRANSPORT.is_file() and not any(os.environ.get(name) for name in CHOICES):
        os.environ[PROFILES] = str(TRANSPORT)


def free_domain() -> int:
    """Return a ROS_DOMAIN_ID from 1 to 99 on which no participant of this machine is, by chance.

    The first participant of a domain holds the UDP port 7410 + 250 times its number (DDSI-RTPS 2.3, 9.6.1.1).
    """
    domains = random.sample(range(1, 100), 99)
    return next((domain for domain in domains if _is_free(7410 + 250 * domain)), domains[0])


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
        return True


KEPT = 1 << 28  # [bytes] of free memory that stay with the process
LARGEST = 1 << 25  # [bytes] of a block, the most that glibc allows, up to which it comes from there
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's mallopt


def keep_heap() -> bool:
    """Have the C library keep freed memory, and return whether it does.

    It gives blocks of a megabyte back to the system, which clears their pages anew for every image: two thirds of what
    it costs to receive one.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries have none
    return mallopt is not None and all(
        [mallopt(name, size) for name, size in ((_TRIM_THRESHOLD, KEPT), (_MMAP_THRESHOLD, LARGEST))]
    )
