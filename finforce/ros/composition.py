"""Nodes of one process, each with the arguments that it would have in a process of its own."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import NamedTuple

from rclpy.node import Node

from finforce.processors import bind_caller
from finforce.ros import node as ros
from finforce.ros.pipeline import Pipeline, Stage
from finforce.ros.start import NODES

CLASSES = {
    "keypoint_detector": "KeypointDetectorNode",
    "contact_estimator": "ContactEstimatorNode",
    "ifea_solver": "IfeaSolverNode",
}


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
        f"{text!r} is no part of a pipeline; expected a JSON list: one of {', '.join(CLASSES)}, and its ROS arguments"
    )


def build_nodes(parts: Sequence[Part]) -> list[Node]:
    """Return the nodes, whose topics are connected.

    Raises:
        FinforceError: one of them cannot be built.
    """
    pipeline, nodes = Pipeline(), []
    for part in parts:
        kind = getattr(import_module(NODES[part.executable]), CLASSES[part.executable])
        nodes.append(kind(stage=Stage(pipeline), cli_args=["--ros-args", *part.words]))
    pipeline.open()
    bind_caller(max(getattr(node.parameters, "threads", 1) for node in nodes))
    return nodes


def main(args: Sequence[str] | None = None) -> int:
    """Run the nodes until Ctrl-C."""
    words = sys.argv[1:] if args is None else list(args)
    own = words[: words.index("--ros-args")] if "--ros-args" in words else words
    return ros.run_nodes("pipeline", lambda: build_nodes([read_part(word) for word in own]), args)


if __name__ == "__main__":
    sys.exit(main())
