"""O, the images behind observation ids: a frozen dataclass for each kind of set.

A user's own kind satisfies `ImageSet`, and yaml reaches it through ``_target_``.
"""

from ctgraph_rl.tasks.images.generated import GroupedImages, PaperImages
from ctgraph_rl.tasks.images.image_file import ImageFile
from ctgraph_rl.tasks.images.image_set import ImageSet, has_cue_element, white_level
from ctgraph_rl.tasks.images.one_hot import OneHot
from ctgraph_rl.tasks.images.reference_images import ReferenceImages, ReferenceOneHot

IMAGE_SETS = (PaperImages, GroupedImages, OneHot, ImageFile, ReferenceImages, ReferenceOneHot)

__all__ = [
    "IMAGE_SETS",
    "GroupedImages",
    "ImageFile",
    "ImageSet",
    "OneHot",
    "PaperImages",
    "ReferenceImages",
    "ReferenceOneHot",
    "has_cue_element",
    "white_level",
]
