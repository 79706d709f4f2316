"""The forces in recordings as a pandas table, and the largest of each: `python examples/evaluate_recordings.py BAG...`

Without an argument, those of the recording that comes with finforce.
"""

import sys

import numpy as np

import finforce as ff

forces = ff.evaluate(sys.argv[1:] or ff.DEMO, calibration="bench")
forces["magnitude"] = np.linalg.norm(forces[["force_x", "force_y", "force_z"]], axis=1)
print(forces.groupby(["case", "side"])[["magnitude", "magnitude_stddev"]].max().round(2))
forces.to_csv("forces.csv", index=False)
