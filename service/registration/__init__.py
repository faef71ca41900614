"""Register depth points on the map's surfels and adjust the pose along the pixels' rays. The C kernels are here.

Entry: ``register.register`` from coarse to fine, then ``rays.adjust`` for the best pose.
"""
