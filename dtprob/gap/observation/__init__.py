"""Scores of observed distributions as whitened regression rows."""
