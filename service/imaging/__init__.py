"""Decode an image pair, level it, resample it to the view grid, and fuse colour and depth.

Entry: ``query_view.query_views`` for a query, ``view_grid`` for a survey scan. ``decode`` reads the image files.
"""
