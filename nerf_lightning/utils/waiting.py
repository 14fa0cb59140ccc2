"""How long threads wait at work for one another before they give their core away."""

import os

SPINS = 2000
"""Rounds of GNU's OpenMP (some microseconds). Its own 300,000 (a millisecond) keep a core from whoever else has work for it:
two trainings side by side on two cores took 4 to 6 times as long as one alone, with this 1.8 times; alone nothing changes."""


def wait_briefly() -> None:
    """Before PyTorch is loaded, which reads it then. What the user's environment says of waiting stays as it is."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))
