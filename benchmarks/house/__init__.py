"""How readable the code and the documents are: ``make house`` writes ``reports/house.json``."""
