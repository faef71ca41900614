"""Design choices, each measured against its alternatives in a validation city -> ``reports/choices.json``."""
