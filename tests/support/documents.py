"""README and docs/ as tests read them: pages, code blocks, and their commands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
_PATHS = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
PAGES = {path.relative_to(ROOT).as_posix(): path for path in _PATHS}
"""README and the pages of docs/, by their paths from the root."""


class Block(NamedTuple):
    """A fenced block of a page. line: number of its first line, from 1."""

    page: str
    line: int
    language: str
    text: str

    @property
    def name(self) -> str:
        """Return a name for the ids of tests."""
        return f"{Path(self.page).stem}-{self.line}"


def text_of(page: str) -> str:
    """Return the text of a page, such as "docs/trust.md"."""
    return PAGES[page].read_text()


def blocks(language: str, page: str | None = None) -> list[Block]:
    """Return the fenced blocks of a language, of all pages or of one."""
    found: list[Block] = []
    for name in PAGES if page is None else (page,):
        text = text_of(name)
        fenced = re.finditer(
            rf"^```{re.escape(language)}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL
        )
        found += (
            Block(name, text.count("\n", 0, one.start(1)) + 1, language, one[1]) for one in fenced
        )
    return found


def shell_lines(page: str | None = None) -> list[tuple[str, list[str]]]:
    """Return (page and line, words) of every command in bash blocks, without comments and leading
    variable assignments."""
    found = []
    for block in blocks("bash", page):
        line = block.line
        for command in re.sub(r"\\\n", lambda _: "\0", block.text).splitlines():
            words = shlex.split(command.replace("\0", " "), comments=True)
            while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
                words.pop(0)
            found += [(f"{block.page}:{line}", words)] if words else []
            line += 1 + command.count("\0")
    return found
