"""Cut the first loading cycle out of a bench recording: the short recording and the object of `finforce demo`."""

import argparse
import shutil
from dataclasses import replace

import numpy as np

from finforce_eval.recordings.objects import require_mesh
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording


def main() -> None:
    """Read a recording, keep what is before its second cycle, write it with compressed chunks and its mesh."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", help="bench recording")
    parser.add_argument("output", help="new folder, in finforce_eval/data")
    options = parser.parse_args()
    recording = read_recording(options.recording)
    if recording.phases is None or not (recording.phases.cycle == 1).any():
        parser.error("the recording has no second cycle")
    stop = int(recording.phases.stamps[np.argmax(recording.phases.cycle == 1)])
    mesh = require_mesh(recording)
    case = {"object": recording.case["object"], "mesh": f"objects/{mesh.name}"}
    output = write_recording(replace(recording.between(0, stop), case=case), options.output, compressed=True)
    objects = output.parent / "objects"
    objects.mkdir(exist_ok=True)
    shutil.copyfile(mesh, objects / mesh.name)


if __name__ == "__main__":
    main()
