"""Cameras, rigid transforms and Earth coordinates.

Entry: ``camera.PinholeCamera`` and ``rigid.transform_from``.
"""
