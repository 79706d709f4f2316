"""The SSG-48 gripper: link, protocol, state, force-controlled grasp, and an emulated gripper."""
