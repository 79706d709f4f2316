"""The gripper's CAN link: buses, SLCAN, messages to the bit."""
