"""Whether a number that was given can be a tolerance."""


def checked_tolerance(tolerance, most):
    """A number above zero and up to `most`; ValueError says what is not."""
    try:
        is_tolerance = 0.0 < tolerance <= most
    except TypeError:
        is_tolerance = False
    if not is_tolerance:
        raise ValueError(f"tolerance is {tolerance!r}, expected a number between 0 and {most:g}")
    return float(tolerance)
