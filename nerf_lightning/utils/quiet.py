"""Turns off library warnings that tell users nothing."""

import logging
import warnings

NOISY = ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero")
"""Loggers that report hardware and advice."""


def quiet() -> None:
    """Silences Lightning's remarks on hardware and settings that this package chooses itself."""
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (".*does not have many workers.*", ".*GPU available but not used.*", ".*isinstance.treespec.*"):
        warnings.filterwarnings("ignore", message)
