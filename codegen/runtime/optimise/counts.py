"""Whether a number that was given can be a count of something."""


def checked_count(name, number):
    """A positive integer, which may be written as a float; ValueError names what is not."""
    try:
        is_count = number == int(number) and number >= 1 and not isinstance(number, bool)
    except (TypeError, ValueError, OverflowError):
        is_count = False
    if not is_count:
        raise ValueError(f"{name} is {number!r}, expected a positive integer")
    return int(number)
