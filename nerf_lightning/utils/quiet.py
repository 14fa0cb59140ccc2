"""Warnings of libraries that say nothing to users."""

import logging
import warnings


def quiet() -> None:
    """Silences what Lightning says about hardware and habits that this package decides for itself."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (".*does not have many workers.*", ".*GPU available but not used.*", ".*isinstance.treespec.*"):
        warnings.filterwarnings("ignore", message)
