"""Baselines with a common interface, for comparisons on the same rays.

Every baseline has ``fit(points, labels)``, which returns the baseline, and ``probability(points)``,
(N, D) world positions [m] -> (N,) probability of occupancy, 1/2 where unknown. OctoMap has
``fit(scans)`` instead, because it samples free space itself. Calling a baseline is the same as
``probability``, so `evaluate` accepts baselines as well as maps. The Gaussian processes also have
``variance(points)``.
"""
