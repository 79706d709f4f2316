"""Close until 2 N by what the wrist camera sees, say how it is, let go; with `robot.launch.py` running."""

from finforce import GripperClient

with GripperClient() as gripper:
    print(gripper.calibrate())
    print(gripper.release())
    print(gripper.grasp(2.0))
    print(f"{gripper.force:.2f} N at {1e3 * gripper.opening:.1f} mm")
    print(gripper.release())
