"""Moved to tests/helpers/train_models.py."""

from tests.helpers.train_models import SCENE as SCENE, PICTURE as PICTURE, MODELS as MODELS, ANOTHER as ANOTHER, STEPS as STEPS, Stop as Stop, fingerprints as fingerprints, fingerprint as fingerprint  # noqa: E501, F401, I001, PLC0414

if __name__ == "__main__":
    import runpy

    runpy.run_module("tests.helpers.train_models", run_name="__main__")
