"""Datasets, maps and answers for external viewers: one stream of events, and a writer for each format."""
