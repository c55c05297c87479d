"""Diagnosing the sim-to-real gap: where it lies, which effect causes it, how far that effect closes it."""
