"""What several tests share: scenes, runs and devices, and how results are compared."""
