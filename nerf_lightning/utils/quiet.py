"""Warnings of libraries that say nothing to users."""

import logging
import warnings

NOISY = ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero")
"""Loggers of hardware and habits."""


def quiet() -> None:
    """Silences what Lightning says about hardware and habits that this package decides for itself."""
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (".*does not have many workers.*", ".*GPU available but not used.*", ".*isinstance.treespec.*"):
        warnings.filterwarnings("ignore", message)
