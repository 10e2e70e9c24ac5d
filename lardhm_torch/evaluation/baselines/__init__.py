"""Other methods behind one call signature, for comparisons on the same rays.

Every baseline has ``fit(points, labels)``, which returns itself, and ``probability(points)``, (N, D)
world positions [m] -> (N,) probability of occupancy, 1/2 where it knows nothing; OctoMap alone is
given the rays, ``fit(scans)``, because it makes its own free space. Calling a baseline is the same as
``probability``, so that `metrics.evaluate` takes a baseline where it takes a map. The processes have
``variance(points)``, too.
"""
