from .explorer import Explorer, explore
from .paper import reproduce
from .paper_statements import Statement

__all__ = ["Explorer", "Statement", "explore", "reproduce"]
