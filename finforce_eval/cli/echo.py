"""The subcommand `echo`: the messages of a topic as text, without the `ros2` command."""

from __future__ import annotations

import argparse
import sys
from itertools import islice

import yaml

from finforce.optional import import_ros
from finforce_eval.cli.parser import CommandResult, whole_number

EXAMPLES = """examples:
  finforce echo grasp_wrench
  finforce echo /left/keypoints --count 1
  finforce echo joint_states --line              # one line per message"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("topic", metavar="TOPIC", help="name of the topic, such as /grasp_wrench")
    parser.add_argument("--line", action="store_true", help="print one line per message instead of a YAML document")
    text = "stop after N messages (until Ctrl-C)"
    parser.add_argument("--count", type=whole_number(1, 10**9), metavar="N", help=text)


def run(options: argparse.Namespace) -> CommandResult:
    """Print messages until there were enough, or Ctrl-C."""
    monitor = import_ros("finforce.ros.monitor", "echo")
    messages = monitor.iter_messages(options.topic, lambda text: print(f"note: {text}", file=sys.stderr, flush=True))
    for message in islice(messages, options.count):
        style = {"default_flow_style": True if options.line else None, "width": sys.maxsize}
        text = yaml.safe_dump(monitor.describe_message(message), sort_keys=False, allow_unicode=True, **style)
        print(text if options.line else f"{text}---\n", end="", flush=True)
    return CommandResult()
