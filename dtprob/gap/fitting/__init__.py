"""Posterior modes, what they leave of the data, and data sets drawn at them."""
