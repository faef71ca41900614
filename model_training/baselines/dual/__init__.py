"""Dual encoders: a tower for each sensor, one space (CLIP, LIP-Loc), and the same behind a field of view (ModaLink).

Written from what their publications describe: Radford et al., ICML 2021; Shubodh et al., WACV workshops 2024; Xie et al.,
2024. Neither levels the camera's pictures, fuses colour with depth before a tower or registers an answer.
"""

from model_training.baselines.dual.answer import DualResult, run

__all__ = ["DualResult", "run"]
