"""Evaluation of maps on held-out rays and true surfaces, and the baselines for comparison."""
