"""`python -m finforce_driver.emulator`."""

import sys

from finforce_driver.emulator.pty_port import main

sys.exit(main())
