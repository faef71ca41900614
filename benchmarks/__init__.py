"""Measurements behind the reports; run by make targets, apart from the tests."""
