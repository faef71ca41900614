"""Datasets, maps and answers for viewers of other people: one stream of events, a writer for each format."""
