"""Settings of Fast DDS for images, and a free domain."""

from __future__ import annotations

import os
import random
import socket
from collections import deque
from pathlib import Path

from finforce.camera_topics import ENDS

TRANSPORT = Path(__file__).with_name("fastdds.xml")
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
FROM_FILE = "RMW_FASTRTPS_USE_QOS_FROM_XML"  # by which rmw_fastrtps takes how memory is kept from the file, too
CHOICES = (PROFILES, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")
DOMAINS = range(1, 100)
LAST_DOMAIN = 232  # of a ROS_DOMAIN_ID: the ports of greater ones are none (DDSI-RTPS 2.3, 9.6.1.1)
RECEIVE_BUFFER = 2147483647  # bytes, net.core.rmem_max as the DDS tuning page of the ROS 2 documentation sets it


def provide_transport() -> None:
    """Have Fast DDS carry images, which its default loses, unless somebody has chosen how it works already."""
    if TRANSPORT.is_file() and not any(os.environ.get(name) for name in CHOICES):
        os.environ[PROFILES] = str(TRANSPORT)
        os.environ.setdefault(FROM_FILE, "1")


def remedy_for_losses(topic: str, is_here: bool) -> str:
    """Return what to do where images of a topic get lost on the way.

    Args:
        topic: of the images.
        is_here: True if they are published on this machine.
    """
    if is_here:
        return f"start the camera's process with {PROFILES}={TRANSPORT}"
    other = "" if topic.endswith(ENDS) else ", or use image_transport:=compressed"
    return f"raise the receive buffers of both machines (sudo sysctl -w net.core.rmem_max={RECEIVE_BUFFER}){other}"


def describe_domain(domain: str) -> str:
    """Return what is wrong with a ROS_DOMAIN_ID, "" for one that can be and for none."""
    can_be = not domain or (domain.isascii() and domain.isdigit() and int(domain) <= LAST_DOMAIN)
    return "" if can_be else f"ROS_DOMAIN_ID={domain}: expected 0 to {LAST_DOMAIN}"


_RESERVED = 8  # domains at a time, of one process
_reservations: deque[int] = deque()  # file descriptors


def free_domain() -> int:
    """Return a ROS_DOMAIN_ID of `DOMAINS` on which no participant of this machine is, by chance.

    It is reserved for this process until it ends or has drawn eight more.
    """
    domains = random.sample(DOMAINS, len(DOMAINS))
    return next(filter(_reserve, domains), domains[0])


def _reserve(domain: int) -> bool:
    """Reserve a domain, and return whether it was free.

    The first participant of a domain holds the UDP port 7410 + 250 times its number (DDSI-RTPS 2.3, 9.6.1.1), seconds
    after the domain was drawn; the last port of a domain, which no participant gets to, holds it until then.
    """
    first = 7400 + 250 * domain
    with socket.socket(type=socket.SOCK_DGRAM) as participant, socket.socket(type=socket.SOCK_DGRAM) as reservation:
        try:
            participant.bind(("", first + 10))
            reservation.bind(("", first + 249))
        except OSError:
            return False
        _reservations.append(reservation.detach())
    while len(_reservations) > _RESERVED:
        os.close(_reservations.popleft())
    return True
