"""The grasp force in images, one after the other, as a program with a camera of its own gets it.

finforce twin record grasp_cylinder -o BAG
python examples/images_to_forces.py BAG
"""

import sys

import finforce as ff

recording = ff.read_recording(sys.argv[1])  # in place of a camera
sensor = ff.ForceSensor(
    "bench", camera=recording.images.camera, extrinsics="robot", contact_height=0.040, calibration="twin"
)
for _, image in recording.images:
    forces = sensor.update(image.color, image.depth, image.stamp)
    told = f"{forces.grasp:.2f} ± {forces.grasp_stddev:.2f} N" if forces.status == "ok" else forces.status
    print(f"{image.stamp:.2f} s  {told}")
