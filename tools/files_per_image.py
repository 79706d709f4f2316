"""Files of the packages in which a function runs for one image, in each node of the pipeline.

    python -m tools.files_per_image RECORDING

The nodes of one process take a recording's images, and every node's files are printed, each with the share of the
images of the second half that touch it. Compiled functions are not seen.
"""

import json
import sys
from collections import Counter, defaultdict
from pathlib import Path
from statistics import median
from time import time_ns

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from finforce.ros.composition import Part, build_nodes
from finforce_eval.cli.pipeline import pipeline_process
from finforce_eval.replay.playback import read_playback

ROOT = f"{Path(__file__).parents[1]}/"
OPTIONS = ("-p", "max_age:=60.0", "-p", "skip_off:=[idle image]")  # Python is slow while it is watched


def count_files(bag: Path) -> dict[str, list[set[str]]]:
    """Return the files that each node touches, a set for each colour image."""
    rclpy.init()
    parts = [json.loads(part) for part in pipeline_process([f"object_mesh:={bag / 'object.stl'}"]).arguments]
    nodes = build_nodes([Part(name, (*words, *OPTIONS)) for name, *words in parts])
    listener = Node("listener")
    for side in ("left", "right"):
        listener.create_subscription(WrenchStamped, f"{side}/wrench", print, 10)
    images: dict[str, list[set[str]]] = defaultdict(list)
    running = [""]

    def watch(frame, event, _):
        if event == "call":
            owner = frame.f_locals.get("self")
            running.append(owner.get_name() if isinstance(owner, Node) else running[-1])
            if running[-1] and frame.f_code.co_filename.startswith(f"{ROOT}finforce"):
                images[running[-1]][-1].add(frame.f_code.co_filename.removeprefix(ROOT))
        elif event == "return" and len(running) > 1:
            running.pop()

    playback, start = read_playback(bag), time_ns()
    for message in playback:
        if message.topic.endswith("/color/image_raw"):
            for node in nodes:
                images[node.get_name()].append(set())
        for end in (end for node in nodes for end in node.subscriptions if end.topic_name == message.topic and images):
            taken = deserialize_message(message.restamped(message.stamp - playback.begin + start), end.msg_type)
            sys.setprofile(watch)
            end.callback(taken)
            sys.setprofile(None)
    return images


if __name__ == "__main__":
    for name, touched in count_files(Path(sys.argv[1])).items():
        late = touched[len(touched) // 2 :]
        print(f"{name}: {median(map(len, late)):g} files per image")
        for file, count in Counter(file for files in late for file in files).most_common():
            print(f"  {100 * count / len(late):3.0f} % {file}")
