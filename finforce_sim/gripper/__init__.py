"""The synthetic gripper over time, alone or coupled to the emulated one."""
