"""What stands on a page: its blocks by kind, and its markup without the scripts that it brings along."""

from __future__ import annotations

import re
from typing import TypeVar

from reports.layout import Page, Section, every_block

B = TypeVar("B")


def blocks(part: Page | Section, kind: type[B]) -> list[B]:
    """Every block of a kind, in the page's order."""
    return [b for b in every_block(part) if isinstance(b, kind)]


def section(page: Page, anchor: str) -> Section:
    """The section of that anchor."""
    return next(s for s in page.sections if s.anchor == anchor)


def unscripted(html: str) -> str:
    """The page without style and scripts, whose text is no part of what it says."""
    return re.sub(r"<(script|style)[^>]*>.*?</\1>", "", html, flags=re.DOTALL)
