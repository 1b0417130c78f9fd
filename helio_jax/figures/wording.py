"""Numbers with units as a person writes them: plain text for the terminal, typeset for pictures and pages."""

import math
import re

_LENGTHS = ((1e-3, "nm"), (1.0, "um"), (1e3, "mm"))
UNITS = ("counts", "A")
"""Units that are written behind each number."""
_PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "u", -3: "m", 0: ""}


def length_unit(um: float) -> tuple[float, str]:
    """Choose the unit in which a length is read most easily: its size [um] and its name."""
    if um == 0.0:
        return 1.0, "um"
    return next((unit for unit in reversed(_LENGTHS) if um >= 0.99995 * unit[0]), _LENGTHS[0])


def length(um: float) -> str:
    """Write a length, e.g. 4.72 mm."""
    size, unit = length_unit(abs(um))
    return f"{um / size:.4g} {unit}"


def lengths(a: float, b: float) -> str:
    """Write two lengths in one unit, e.g. 4.16 x 3.6 mm."""
    size, unit = length_unit(max(abs(a), abs(b)))
    return f"{a / size:.4g} x {b / size:.4g} {unit}"


def angle(rad: float) -> str:
    """Write an angle, e.g. 23.4 deg; never -0."""
    return f"{round(math.degrees(rad), 1) + 0.0:g} deg"


def amount(value: float, unit: str) -> str:
    """Write counts (480.4 counts) or a current (150.3 pA)."""
    if unit != "A":
        return (f"{value:,.0f} {unit}" if abs(value) >= 1e4 else f"{value:.4g} {unit}").strip()
    size, name = count_unit(value, unit)
    return f"{value / size:.4g} {name}"


def count_unit(value: float, unit: str) -> tuple[float, str]:
    """Choose the unit for counts or currents about as large as `value`: its size in `unit`, and its name (pA)."""
    if unit != "A" or not value:
        return 1.0, unit
    power = min(0, max(-15, 3 * math.floor(math.log10(abs(value)) / 3)))
    return 10.0**power, f"{_PREFIXES[power]}A"


def share(fraction: float) -> str:
    """Write a fraction in per cent, with two digits where it is small."""
    return f"{100 * fraction:.{1 if abs(fraction) >= 0.01 or fraction == 0 else 2}f} %"


def plural(n: float, noun: str) -> str:
    """Write a number of things, e.g. 1 image, 3 images."""
    return f"{n:,.0f} {noun}{'s' * (n != 1)}"


def short(name: str, n: int) -> str:
    """Cut a name to n letters, the last one an ellipsis."""
    return name if len(name) <= n else name[: n - 1].rstrip() + "…"


def duration(seconds: float) -> str:
    """Write a time, e.g. 5 h 14 min."""
    if seconds < 60:
        return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def typeset(text: str) -> str:
    """Replace um, deg, +-, minus and x between numbers by their signs."""
    text = re.sub(r"\bum\b", "µm", text)
    text = re.sub(r"(?<=\d) deg\b", "°", text).replace("+-", "±")
    text = re.sub(r"(?<![\w.])-(?=\d)", "−", text)
    return re.sub(r"(?<=\d) x (?=\d)", " × ", text)
