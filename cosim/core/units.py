"""Format times and sizes with units."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Return a time in rounded units: 45 s, 90 s, 12 min, 2 h 10 min."""
    if seconds < 115.0:
        return f"{round(seconds, -1) if seconds >= 60.0 else seconds:.0f} s"
    minutes = round(seconds / 60.0)
    if minutes < 60:
        return f"{minutes} min"
    hours, rest = divmod(round(minutes, -1) if minutes >= 120 else minutes, 60)
    return f"{hours} h {rest} min" if rest else f"{hours} h"


def milliseconds(ms: float) -> str:
    """Return a short time with three digits: 0.43 ms, 70.3 ms, 1,235 ms.

    >>> milliseconds(70.345), milliseconds(1234.6)
    ('70.3 ms', '1,235 ms')
    """
    return f"{ms:.3g} ms" if abs(ms) < 999.5 else f"{ms:,.0f} ms"


def bytes_in_words(count: float) -> str:
    """Return a size with three digits in decimal units: 812 B, 4.2 MB, 1.62 GB.

    >>> bytes_in_words(812), bytes_in_words(4_200_000), bytes_in_words(1_618_000_000)
    ('812 B', '4.2 MB', '1.62 GB')
    """
    for unit in ("B", "kB", "MB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000.0
    return f"{count:.3g} GB" if count < 999.5 else f"{count:,.0f} GB"
