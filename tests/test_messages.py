"""Error messages are in plain words."""

import ast
import re

from tests.helpers import ROOT

# Phrases that readers had to read twice, and what to write instead.
INSTEAD = {
    r"means nothing": "has no effect, or needs X",
    r"goes with": "needs",
    r"says? the same": "must not both be given",
    r"\bstands? (at|for|in|where)\b": "is at, replaces, is in",
    r"(?<!there )\bis no (?!longer)": "is not a",
    r"\bthere are none\b": "got none",
    r"\bmust be of (?!type\b)": "must have, must be one of",
    r"\b(is|are|be) told\b": "is given, assumes",
}


def messages():
    """File, line and text of all strings in raise statements of the package."""
    for folder in ("rbl_gym", "estimators", "wrappers"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Raise):
                    for part in ast.walk(node):
                        if isinstance(part, ast.Constant) and isinstance(part.value, str):
                            yield f"{path.relative_to(ROOT)}:{part.lineno}", part.value


def test_error_messages_are_in_plain_words():
    found = list(messages())
    assert len(found) > 1000
    for place, text in found:
        for phrase, better in INSTEAD.items():
            assert not re.search(phrase, text), f"{place}: {text!r}; write {better!r}"
