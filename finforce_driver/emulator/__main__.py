"""`python -m finforce_driver.emulator`."""

import sys

from finforce_driver.emulator.server import main

sys.exit(main())
