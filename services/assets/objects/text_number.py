"""Numbers in the text of mesh files."""


def parse_number(word: bytes) -> float:
    """Returns the number that a word of a file stands for.

    Raises:
      ValueError: the word is not a number; the message quotes its beginning.
    """
    try:
        return float(word)
    except ValueError:
        quoted = ascii(word.decode(errors="replace"))[:30]
        raise ValueError(f"{quoted} is not a number") from None
