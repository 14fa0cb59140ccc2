"""Stability suite: methods trained on small synthetic scenes under adverse conditions."""
