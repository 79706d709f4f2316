"""`python -m finforce_sim.emulator`."""

import sys

from finforce_sim.emulator.pty_port import main

sys.exit(main())
