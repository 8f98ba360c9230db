"""Bad input of the command line: argparse's complaints as one sentence that names the option, the value and what is allowed."""

import argparse
import re
from collections.abc import Sequence
from typing import Any, NoReturn

from ..numerics import shown

__all__ = ["BadInput", "Parser", "one_of"]


class BadInput(Exception):
    """Input that is refused; the message is the sentence to print."""


class Parser(argparse.ArgumentParser):
    """An argparse parser whose errors are `BadInput`, and that reads -1e-3 and -inf as numbers."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(*args, allow_abbrev=False, **kwargs)
        self._negative_number_matcher = re.compile(r"^-(\d|\.\d|inf|nan)", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        raise BadInput(_sentence_of(message, self.prog))


def _sentence_of(message: str, prog: str) -> str:
    """Argparse's message as one sentence that names the option, the value and what is allowed."""
    found = re.match(r"argument (\S+): (.*)", message, re.DOTALL)
    if found is None:
        unknown = re.match(r"unrecognized arguments: (.*)", message, re.DOTALL)
        if unknown:
            return f"{shown(unknown[1])} is not known here; `{prog} --help` lists what is allowed."
        missing = re.match(r"the following arguments are required: (.*)", message)
        if missing:
            return f"{missing[1]} must be given; `{prog} --help` lists what is allowed."
        missing = re.match(r"one of the arguments (.*) is required", message)
        if missing:
            return f"One of {', '.join(missing[1].split())} must be given, but none is."
        return message[0].upper() + message[1:].rstrip(".") + "."
    option, said = found.groups()
    other = re.match(r"not allowed with argument (\S+)", said)
    if other:
        return f"{option} must not be given together with {other[1]}."
    choice = re.match(r"invalid choice: (.*) \(choose from (.*)\)", said, re.DOTALL)
    if choice:
        allowed = [c.strip().strip("'") for c in choice[2].split(",")]
        return f"{option} must be {one_of(allowed)}, but is {_cut(choice[1])}."
    expected = re.match(r"expected (.*?) arguments?$", said)
    if expected:
        return f"{option} must be followed by {expected[1]} value{'' if 'one' in expected[1] else 's'}."
    ignored = re.match(r"ignored explicit argument (.*)", said, re.DOTALL)
    if ignored:
        return f"{option} must be given without a value, but is followed by {_cut(ignored[1])}."
    return f"{option} {said}"


def _cut(text: str) -> str:
    """A quoted value, shortened where it is long, as `codes.shown` does."""
    return text if len(text) <= 100 else f"{text[:40]} ... {text[-40:]}"


def one_of(words: Sequence[str]) -> str:
    """Words with commas and an "or" between them."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"
