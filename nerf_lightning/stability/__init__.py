"""Methods tried where they are known to fail: small scenes of known truth, conditions, the suite, and what it found."""
