"""How contact and force look in RViz and Foxglove, live and in recordings."""

CONTACT = (1.0, 0.8, 0.0, 1.0)
FORCE = (0.9, 0.1, 0.6, 1.0)
NEWTONS_PER_METRE = 200.0  # 5 N are drawn 25 mm long, a third of a bench finger
CONTACT_DIAMETER = 0.005
ARROW = (0.002, 0.004, 0.005)  # shaft, head, head length
