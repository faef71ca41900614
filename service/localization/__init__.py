"""Answer a query: retrieval, registration, confidence, decision, answer.

Entry: ``localizer.Localizer.localize``.
"""
