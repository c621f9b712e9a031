"""What a sentence asks for, and which of the things in view it means: words, household knowledge, grounding.

Planners and segmenters both build on this; it knows no stage and no network.
"""

COLOR_NAMES = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "grey")
"""The colour names of `Proposal.colors`."""

SHAPE_NAMES = ("round", "cylindrical", "box-like", "flat", "elongated", "hollow")
"""The descriptors of `Proposal.shapes`."""
