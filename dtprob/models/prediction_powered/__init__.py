"""Prediction-powered inference: few labels, many predictions, and no trust in the predictor."""
