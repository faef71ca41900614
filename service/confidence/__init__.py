"""Compute confidence features of an answer, and decide its status with the calibration of the map.

Entry: ``features.evidence_of``, then ``decision.decision_of``, then ``decision.outcome_of``.
"""
