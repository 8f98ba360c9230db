"""Pages of the site that are made while it is built: the glossary, the options of every command, and tables of the benchmarks.

The benchmarks write their tables into `docs`; a line of a page that is a link to such a file becomes the tables of the file, folded.
"""

import argparse
import functools
import pathlib
import re
import textwrap

from mkdocs.structure.files import File

from dielectric_jax.apps.options import make_parser
from dielectric_jax.model import GLOSSARY

TABLES = ("hard_cases.md", "work_precision.md")
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


def folded(text: str) -> str:
    """The sections of a page of tables, each under a title that opens it; the first holds what precedes them."""
    about, *sections = text.split("\n## ")
    sections.insert(0, "About these tables\n" + about.split("\n", 1)[1])
    parts = (section.split("\n", 1) for section in sections)
    return "\n".join(f'??? note "{title}"\n\n{textwrap.indent(body.strip(), "    ")}\n' for title, body in parts)


def on_page_markdown(markdown, page, config, files):
    """Puts tables in place of the links to them."""

    def tables(link: re.Match) -> str:
        return folded(pathlib.Path(config["docs_dir"], link[1]).read_text(encoding="utf-8"))

    return re.sub(rf"^\[.*\]\(({'|'.join(TABLES)})\)$", tables, markdown, flags=re.MULTILINE)


def on_files(files, config):
    """Adds the pages to the site."""
    for name, content in (("glossary.md", glossary()), ("command_line.md", commands())):
        files.append(File.generated(config, name, content=content))
    return files
