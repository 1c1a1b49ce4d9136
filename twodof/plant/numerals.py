"""Parse numbers in text by the rules that other programs apply."""


def number(word: str) -> float:
    """Parse a number without Python's underscores and non-ASCII digits, as other programs do; or raise ValueError."""
    if not word.isascii() or "_" in word:
        raise ValueError(word)
    return float(word)


def whole_number(word: str) -> int:
    """Parse a whole number by the same rules; or raise ValueError."""
    number(word)
    return int(word)
