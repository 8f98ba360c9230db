"""An extension of griffe: the examples of docstrings, lines after `>>>`, become blocks of code in the pages."""

import griffe


def fenced(text: str) -> str:
    """The text with every paragraph that begins with `>>>` between fences."""
    paragraphs = []
    for paragraph in text.split("\n\n"):
        example = paragraph.lstrip().startswith(">>>")
        paragraphs.append(f"```pycon\n{paragraph.strip()}\n```" if example else paragraph)
    return "\n\n".join(paragraphs)


class Fences(griffe.Extension):
    """Changes docstrings as they are read."""

    def on_instance(self, *, obj: griffe.Object, **_) -> None:
        if obj.docstring is not None:
            obj.docstring.value = fenced(obj.docstring.value)
