"""Where the gap lies: over the model's sites and the data's coordinates."""
