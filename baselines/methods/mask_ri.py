"""Mask RI: modulating masks, each task starts with random scores.

Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110), their Mask_RI.
"""

from baselines.methods.parts.masks import Masks


class MaskRI(Masks):
    """`Masks` with random scores for each new task, so that nothing is transferred between tasks."""
