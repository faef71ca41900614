"""Dual encoders: one tower per sensor and a common space (CLIP, LIP-Loc), also restricted to a field of view (ModaLink).

The code follows the publications: Radford et al., ICML 2021; Shubodh et al., WACV workshops 2024; Xie et al., 2024.
These methods do not level the camera's images, do not fuse colour with depth before a tower, and do not register an
answer.
"""

from research.baselines.dual.answer import DualResult, run

__all__ = ["DualResult", "run"]
