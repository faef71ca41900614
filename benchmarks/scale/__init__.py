"""``make bench-scale``: how search grows with the map, up to as many simulated views as the memory holds."""
