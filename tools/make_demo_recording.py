"""Cut the first loading cycle out of a bench recording: the short recording that `finforce demo` plays."""

import argparse
from dataclasses import replace

import numpy as np

from finforce_eval.recording import read_recording
from finforce_eval.writer import write_recording


def main() -> None:
    """Read a recording, keep everything before its second cycle, write it with compressed chunks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", help="bench recording")
    parser.add_argument("output", help="new folder, in finforce_eval/data")
    options = parser.parse_args()
    recording = read_recording(options.recording)
    if recording.phases is None or not (recording.phases.cycle == 1).any():
        parser.error("the recording has no second cycle")
    stop = int(recording.phases.stamps[np.argmax(recording.phases.cycle == 1)])
    case = {"object": recording.case["object"]}
    write_recording(replace(recording.between(0, stop), case=case), options.output, compressed=True)


if __name__ == "__main__":
    main()
