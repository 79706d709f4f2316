"""Nodes as processes of their own, on a DDS domain of their own."""

import os
import subprocess
import sys
import threading

from finforce.ros.transport import free_domain

PATIENCE = 240.0  # s; a first start compiles


def command_of(name, *parameters):
    """The command line of a node with parameters `name:=value`."""
    given = [word for parameter in parameters for word in ("-p", parameter)]
    return [sys.executable, "-m", "finforce.ros.start", name, "--ros-args", *given]


def environment():
    own = {"ROS_DOMAIN_ID": str(free_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {**os.environ, **own}


def run_node(command):
    """What came of a node that ends by itself."""
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=environment())


def stop_when_ready(command, number):
    """The exit status of a node that is sent a signal once it is ready, and all that it said."""
    node = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment())
    guard = threading.Timer(PATIENCE, node.kill)
    guard.start()
    said = []
    for line in node.stderr:
        said.append(line)
        if " ready" in line:
            node.send_signal(number)
    guard.cancel()
    return node.wait(10), "".join(said)
