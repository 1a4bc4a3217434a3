"""What the figures of a page show."""

import json
import re
from typing import Any


def panels(html: str) -> list[dict[str, Any]]:
    """The panels of all figures of a page, in order."""
    figures = re.findall(r'<figure class="plots"><script type="application/json">(.*?)</script>', html)
    return [panel for figure in figures for panel in json.loads(figure)["panels"]]
