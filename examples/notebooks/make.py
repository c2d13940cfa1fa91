"""Write the tutorials of the documentation as notebooks.

    python examples/notebooks/make.py

The pages in `docs/tutorials/` are the source; a test compares.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

HERE = Path(__file__).parent
PAGES = HERE.parents[1] / "docs" / "tutorials"
FIRST = "# The tutorials run in the folder of the checkout.\nimport os\n\nos.chdir('../..')"


def cell(kind: str, text: str, number: int) -> dict:
    lines = text.strip("\n").splitlines(keepends=True)
    common = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": lines}
    return common if kind == "markdown" else {**common, "execution_count": None, "outputs": []}


def notebook(page: Path) -> str:
    """The page as a notebook without outputs, JSON."""
    text = page.read_text(encoding="utf-8")
    text = re.sub(r"\]\(\.\./images/", "](../../docs/images/", text)
    # Links of a page are relative to it: those without ../ are other tutorials.
    text = re.sub(r"\]\(\.\./([\w/]+\.md)", r"](../../docs/\1", text)
    text = re.sub(r"\]\((\w+)\.md\)", r"](\1.ipynb)", text)
    parts = re.split(r"```python\n(.*?)```\n", text, flags=re.DOTALL)
    pieces = [("markdown" if k % 2 == 0 else "code", part) for k, part in enumerate(parts)]
    pieces.insert(1, ("code", FIRST))
    cells = [cell(kind, part, k) for k, (kind, part) in enumerate(pieces) if part.strip()]
    book = {
        "cells": cells,
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(book, indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    for page in sorted(PAGES.glob("*.md")):
        (HERE / f"{page.stem}.ipynb").write_text(notebook(page), encoding="utf-8")


if __name__ == "__main__":
    main()
