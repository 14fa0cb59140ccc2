"""From the command line to objects: conf/ composed, checked and built. Only here and in the verbs is Hydra known."""
