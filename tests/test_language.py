"""Plain technical English: words that pages, messages and docstrings do without, and what to write instead."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
INSTEAD: Mapping[str, str] = {  # regular expression, in lower case -> preferred
    r"utili[sz](e|es|ed|ing|ation)": "use",
    r"leverag(e|es|ed|ing)": "use",
    r"facilitat(e|es|ed|ing)": "help, or the verb itself",
    r"in order to": "to",
    r"due to the fact that": "because",
    r"prior to": "before",
    r"it should be noted that": "the statement itself",
    r"simply|obviously|of course|trivially": "nothing: leave it out",
    r"really|basically": "nothing: leave it out",
    r"please": "nothing: state what to do",
    r"robustly|seamless(ly)?|powerful|cutting.edge|state.of.the.art|blazing(ly)?": "the measured property",
    r"previously|used to be": "the present state; history belongs in the changelog",
    r"and so on|etc\.": "the whole list, or what the members share",
    r"tells?|told|said": "reports, states, shows; distinguish",
    r"beside": "next to",
    r"mend(s|ed|ing)?": "correct, repair",
    r"owes?|owed|debts?": "limited by; shortfall",
    r"honest(ly|y)?": "calibrated, out-of-sample, valid",
    r"mates|voices|sceptics?": "the term of the field",
    r"by lot|dealt anew": "at random; permuted",
    r"kept back|keeps back|shut in": "withheld; isolated",
    r"blind to": "independent of, does not use",
    r"under each other's names?": "exchanged, swapped",
    r"(is|are|was|were) not so": "is false",
    r"overlook(s|ed)?": "missed, not detected",
    r"in no list|not known to us": "unlisted; unknown",
    r"asleep|awake|waking|sleeping|ghosts?": "disabled, enabled; null value",
    r"foretold|foretells?": "predicted; log predictive density",
    r"unharmed|worsened": "degraded",
    r"alike": "the same, equal, similar; indistinguishable",
    r"such a one|of which none": "one, none",
    r"is not asked": "nuisance",
}
WORDS = {re.compile(rf"\b(?:{pattern})(?!\w)", re.IGNORECASE): instead for pattern, instead in INSTEAD.items()}
PAGES = [*(ROOT / n for n in ("README.md", "CONTRIBUTING.md", "SECURITY.md")), *sorted((ROOT / "docs").rglob("*.md"))]
ROOMS = (
    "compensation", "data", "diagnosis", "features", "models", "pipelines", "plants", "reports",
    "thermodrift", "twin",
)  # fmt: skip


def found(text: str) -> Iterator[tuple[int, str, str]]:
    """Line, word and what to write instead, of each word to avoid; code is left out."""
    prose = re.sub(r"^( *)```.*?^\1```|`[^`\n]+`|\]\([^)]*\)", _blank, text, flags=re.MULTILINE | re.DOTALL)
    for pattern, instead in WORDS.items():
        for m in pattern.finditer(prose):
            yield prose.count("\n", 0, m.start()) + 1, m[0], instead


def _blank(m: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", m[0])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_pages_use_plain_words(page) -> None:
    wrong = [f"{page.name}:{line}: {word!r}: write {instead}" for line, word, instead in found(page.read_text())]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("room", ROOMS)
def test_messages_and_docstrings_use_plain_words(room) -> None:
    wrong = []
    for path in sorted((ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
                place = f"{path.relative_to(ROOT)}:{node.lineno}"
                wrong += [f"{place}: {word!r}: write {instead}" for _, word, instead in found(node.value)]
    assert not wrong, "\n".join(wrong)


def test_words_to_avoid_are_found_in_prose_alone() -> None:
    assert [w for _, w, _ in found("First line.\nPlease utilise it, simply.")] == ["utilise", "simply", "Please"]
    assert [line for line, *_ in found("a\n```\nplease\n```\nplease")] == [5]
    assert not list(found("`please` is code, [a link](please.md) an address"))
