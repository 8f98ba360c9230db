"""Text for streams whose encoding lacks characters, such as cp437 or ASCII: missing characters are spelled out."""

import codecs
import contextlib
import sys
import unicodedata
from collections.abc import Iterator
from typing import TextIO

__all__ = ["readable_streams"]

_HANDLER = "dielectric_jax.spelled_out"
_SPELLED = {
    "\N{GREEK SMALL LETTER MU}": "u",
    "\N{MICRO SIGN}": "u",
    "\N{GREEK SMALL LETTER LAMDA}": "lambda",
    "\N{GREEK CAPITAL LETTER LAMDA}": "Lambda",
    "\N{HORIZONTAL ELLIPSIS}": "...",
    "\N{EN DASH}": "-",
    "\N{EM DASH}": "-",
    "\N{MINUS SIGN}": "-",
    "\N{MIDDLE DOT}": "*",
    "\N{MULTIPLICATION SIGN}": "x",
    "\N{SQUARE ROOT}": "sqrt",
    "\N{PARTIAL DIFFERENTIAL}": "d",
    "\N{INFINITY}": "inf",
    "\N{RIGHTWARDS ARROW}": "->",
    "\N{LESS-THAN OR EQUAL TO}": "<=",
    "\N{GREATER-THAN OR EQUAL TO}": ">=",
    "\N{DEGREE SIGN}": "deg",
    "\N{VULGAR FRACTION ONE HALF}": "1/2",
    "\N{LEFT SINGLE QUOTATION MARK}": "'",
    "\N{RIGHT SINGLE QUOTATION MARK}": "'",
    "\N{LEFT DOUBLE QUOTATION MARK}": '"',
    "\N{RIGHT DOUBLE QUOTATION MARK}": '"',
    "\N{SUPERSCRIPT MINUS}": "^-",
}


def spelled(character: str) -> str:
    """A character in ASCII: λ as lambda, µ as u, ² as ^2; characters without such a form as an escape.

    >>> "".join(map(spelled, "Φ²"))
    'Phi^2'
    """
    if character in _SPELLED:
        return _SPELLED[character]
    kind, _, name = unicodedata.name(character, "").rpartition(" LETTER ")
    if kind.startswith("GREEK ") and name.isalpha():
        return name.capitalize() if "CAPITAL" in kind else name.lower()
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    if "SUPERSCRIPT" in unicodedata.name(character, ""):
        return f"^{plain}"
    return plain or character.encode("ascii", "backslashreplace").decode()


def _spell_out(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(spelled, error.object[error.start : error.end])), error.end


codecs.register_error(_HANDLER, _spell_out)


@contextlib.contextmanager
def readable_streams() -> Iterator[None]:
    """Makes standard output and standard error spell out characters that their encodings lack, unless configured otherwise."""
    changed: list[tuple[TextIO, str]] = []
    for stream in (sys.stdout, sys.stderr):
        errors = getattr(stream, "errors", None)
        if errors in ("strict", "surrogateescape", "backslashreplace") and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors=_HANDLER)  # pyright: ignore[reportAttributeAccessIssue]
            changed.append((stream, errors))
    try:
        yield
    finally:
        for stream, errors in changed:
            with contextlib.suppress(ValueError, OSError):  # closed in the meantime, or its reader is gone
                stream.reconfigure(errors=errors)  # pyright: ignore[reportAttributeAccessIssue]
