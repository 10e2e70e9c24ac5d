"""Other methods behind one call signature, for comparisons on the same rays.

Every baseline has ``fit(scans)``, which returns itself, and ``probability(points)``, (N, D) world
positions [m] -> (N,) probability of occupancy, 1/2 where it knows nothing. Calling it is the same
as ``probability``, so that `metrics.evaluate` takes a baseline where it takes a map.
"""
