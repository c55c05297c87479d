"""The declared generative models, and what they share."""
