"""Tasks of the engines' tests, in a module that a process of its own imports at once."""

import os
import signal
import time

from finforce_eval.tasks import Task


def square(number, fail=(), die=(), seconds=0.0):
    """The square of a number, after some time; some fail, and some end the process."""
    time.sleep(seconds)
    if number in fail:
        raise ValueError(f"no {number}")
    if number in die:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"square": number**2}


def squares(count, **given):
    return [Task(name=str(n), key=f"k{n}", work=square, given={"number": n, **given}) for n in range(count)]
