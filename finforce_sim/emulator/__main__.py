"""The program that emulates a gripper behind a port of its own: `python -m finforce_sim.emulator`."""

from __future__ import annotations

import os
import signal

if __name__ == "__main__":  # while the rest is loaded, a signal has nothing to clean up
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))

import argparse
import sys
from collections.abc import Sequence

from finforce.errors import FinforceError
from finforce.signals import StopSignals
from finforce_sim.emulator.adapter import ACK_MODES, EmulatedAdapter
from finforce_sim.emulator.control import VARIANTS
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.pty_port import PtyPort


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m finforce_sim.emulator",
        description="Emulate an SSG-48 behind a pseudo-terminal (SLCAN).",
    )
    parser.add_argument("--link", help="path of a symbolic link to the port")
    parser.add_argument("--variant", choices=tuple(VARIANTS), default="new", help="firmware variant (new)")
    parser.add_argument("--node", type=int, default=0, help="CAN node of the gripper, 0 to 15 (0)")
    parser.add_argument("--object-mm", type=float, help="width of the object between the jaws [mm] (no object)")
    parser.add_argument("--stiffness", type=float, help="stiffness of the object [N per mm of opening] (rigid)")
    parser.add_argument("--ack", choices=ACK_MODES, default="none", help="acknowledgements of the adapter (none)")
    parser.add_argument("--latency-ms", type=float, default=0.0, help="latency from the bus to the host [ms] (0)")
    return parser


def build_adapter(options: argparse.Namespace) -> EmulatedAdapter:
    """Return the adapter with the gripper that a command line describes.

    Raises:
        TargetError: a value is out of bounds.
    """
    width = None if options.object_mm is None else 1e-3 * options.object_mm
    soft = width is not None and options.stiffness is not None
    gripper = EmulatedGripper(
        options.variant,
        options.node,
        object_opening=None if soft else width,
        load=(lambda opening: 1e3 * options.stiffness * max(width - opening, 0.0)) if soft else None,
    )
    return EmulatedAdapter(gripper, ack_mode=options.ack, latency=1e-3 * options.latency_ms)


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve an emulated gripper until Ctrl-C or a request to end; return the exit status."""
    options = build_parser().parse_args(arguments)
    try:
        with StopSignals() as stop, PtyPort(build_adapter(options), options.link) as port:
            print(port.path, flush=True)
            while not stop.wait():  # another handled signal wakes it, too
                pass
    except FinforceError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
