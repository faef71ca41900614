"""Readability of code and documents: ``make house`` writes ``reports/house.json``."""
