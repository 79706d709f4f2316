"""The gripper as a state machine: orders, replies, moves, stops."""
