"""Measurements behind the reports. Make targets run them, apart from the tests."""
