"""Encode query views and find similar places of the map: descriptors, K-NN search, clusters, street vote, starts of registration.

Entry: ``retrieve.encode_and_search`` for each image pair, then ``retrieve.retrieve`` for the reference.
"""
