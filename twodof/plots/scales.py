"""Colours, and the sizes below which nothing is shown; of figures and pages alike."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of Okabe & Ito, "Color universal design", 2008, without their yellow, too pale on paper."""
INK, GREY, PALE, HAIR = "#1f2933", "#5b6570", "#b4bcc4", "#e6e9ec"

SMALLEST_RANGE = 1e-3  # rad, m, rad/s, m/s: what moves less is shown at rest
SMALLEST_EFFORT = 1e-6  # N·m, N
SMALLEST_PART = 1e-4  # of a value: ticks, of six digits, differ
SMALLEST_ERROR = 1e-12  # m: what is below is rounding
