"""What a robot is commanded: the speed, as people name it."""

FACTORS = "a factor from 0x to 4x, such as 2x or 1.5x"


def speed_factor(speed: str) -> float:
    """The factor that a speed such as "2x" or "1.5" names.

    Raises:
        ValueError: it is not a number from 0 to 4, with or without an x.
    """
    return _factor(speed, FACTORS)


def speed_factors(speed: str) -> tuple[float, tuple[float, float]]:
    """What a training's speed asks for: a factor on the motion, and the range of those commanded on top.

    "2x" is 2 and (1, 1); "any" is 1 and (0, 4).

    Raises:
        ValueError: it is neither "any" nor a factor from 0 to 4.
    """
    if speed == "any":
        return 1.0, (0.0, 4.0)
    return _factor(speed, f"{FACTORS}, or any for all of them"), (1.0, 1.0)


def _factor(speed: str, valid: str) -> float:
    try:
        factor = float(speed.removesuffix("x"))
    except ValueError:
        factor = -1.0
    # The paper's range: beyond 4 the legs cannot follow the stretched stride.
    if not 0 <= factor <= 4:
        raise ValueError(f"speed={speed} is not a speed; give {valid}.")
    return factor
