"""Nodes of one process, each with the arguments that it would have in a process of its own."""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from threading import Thread
from typing import NamedTuple

from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node

from finforce.processors import bind_caller
from finforce.ros import node as ros
from finforce.ros.start import CLASSES, NODES

APART = ("gripper_driver",)  # in a thread of its own: it waits for no image, and its topics are those between processes


class Part(NamedTuple):
    """One node: its executable, and the ROS arguments that it alone has."""

    executable: str
    words: Sequence[str]


def read_part(text: str) -> Part:
    """Return what a word of the command line asks for: a JSON list of the executable and its ROS arguments.

    Raises:
        ParameterError: it is none.
    """
    try:
        executable, *words = json.loads(text)
        if executable in CLASSES and all(isinstance(word, str) for word in words):
            return Part(executable, words)
    except (ValueError, TypeError):
        pass
    raise ros.ParameterError(
        f"{text!r} is not part of a pipeline; expected a JSON list: one of {', '.join(CLASSES)}, and its ROS arguments"
    )


def build_nodes(parts: Sequence[Part]) -> list[Node]:
    """Return the nodes, whose topics are connected.

    Raises:
        FinforceError: one of them cannot be built.
    """
    pipeline, nodes = ros.Pipeline(), []
    for part in parts:
        kind = getattr(import_module(NODES[part.executable]), CLASSES[part.executable])
        shared = {} if part.executable in APART else {"pipeline": pipeline}
        nodes.append(kind(**shared, cli_args=["--ros-args", *part.words]))
    pipeline.open()
    return nodes


def spin(parts: Sequence[Part], nodes: Sequence[Node], executor: Executor) -> None:
    """Let the nodes work until the process is told to end."""
    apart = [node for part, node in zip(parts, nodes, strict=True) if part.executable in APART]
    for node in apart:
        Thread(target=_spin_apart, args=(node,), daemon=True).start()
    together = [node for node in nodes if node not in apart]
    bind_caller(max((getattr(node.parameters, "threads", 1) for node in together), default=1))
    ros.spin(together, executor)


def _spin_apart(node: Node) -> None:
    """Let one node work in this thread; what nobody catches ends it alone."""
    try:
        ros.spin([node], ros.TolerantExecutor(context=node.context))
    except ExternalShutdownException:
        pass
    except Exception:
        if node.context.ok():
            node.get_logger().error(f"this node has stopped; the others continue\n{traceback.format_exc()}")


def main(args: Sequence[str] | None = None) -> int:
    """Run the nodes until Ctrl-C."""
    words = sys.argv[1:] if args is None else list(args)
    own = words[: words.index("--ros-args")] if "--ros-args" in words else words
    parts: list[Part] = []

    def build() -> list[Node]:
        parts.extend(map(read_part, own))
        return build_nodes(parts)

    return ros.run_nodes("pipeline", build, args, lambda nodes, executor: spin(parts, nodes, executor))
