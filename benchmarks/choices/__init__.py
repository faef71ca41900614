"""Design choices, each measured against its alternatives in a watch city -> ``reports/choices.json``."""
