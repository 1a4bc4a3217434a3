"""Every kind of reason that a verdict may have is explained in docs/troubleshooting.md."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text()


def test_every_kind_of_reason_has_an_anchor() -> None:
    code = (ROOT / "amhe_cli" / "estimation" / "uncertainty" / "verdicts.py").read_text()
    kinds = set(re.findall(r'Reason\(\s*"(\w+)"', code)) | {"assumed", "parts", "minimum"}
    texts = re.search(r"_TEXTS = \{(.*?)\n\}", code, re.DOTALL)
    assert texts is not None
    kinds |= set(re.findall(r'^    "(\w+)":', texts[1], re.MULTILINE))
    assert kinds >= {"bound", "misfit", "idle", "open", "together", "search"}
    assert {kind for kind in kinds if f'<a id="{kind}"></a>' not in PAGE} == set()
