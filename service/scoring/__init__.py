"""Score registered poses. Each scorer has its own file and implements ``scorer.Scorer``.

Entry: ``support.PoseScorer.candidates``, which adds up the scorers that ``support.scorers_of`` lists.
"""
