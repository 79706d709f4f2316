"""A task of the engines' tests, in a module that a process of its own imports at once."""

import os
import signal


def square(number, fail=(), die=()):
    """The square of a number; some fail, and some end the process."""
    if number in fail:
        raise ValueError(f"no {number}")
    if number in die:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"square": number**2}
