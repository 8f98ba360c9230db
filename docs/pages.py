"""Pages of the site that are made from the program: the glossary, and the options of every command."""

import argparse
import functools

from mkdocs.structure.files import File

from dielectric_jax.apps.options import make_parser
from dielectric_jax.model import GLOSSARY

_GLOSSARY = """# Glossary

The words of reports, tables, figures and datasets. `dielectric-jax explain WORD` prints the same.

| word | meaning |
| --- | --- |
"""
_COMMANDS = """# The command line

Every command with its options, as `dielectric-jax COMMAND --help` prints them. [Getting started](getting_started.md) shows them at work.
"""


def glossary() -> str:
    """The words of results with their meanings, as a table."""
    return _GLOSSARY + "".join(f"| {word} | {text.replace('|', '&#124;')} |\n" for word, text in GLOSSARY.items())


def commands() -> str:
    """The help of every command, each under its own heading."""
    parser = make_parser()
    (choices,) = (a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    page = _COMMANDS
    for name, command in choices.items():
        command.formatter_class = functools.partial(argparse.RawDescriptionHelpFormatter, width=100)
        page += f"\n## {name}\n\n```text\n{command.format_help()}```\n"
    return page


def on_files(files, config):
    """Adds the pages to the site."""
    for name, content in (("glossary.md", glossary()), ("command_line.md", commands())):
        files.append(File.generated(config, name, content=content))
    return files
