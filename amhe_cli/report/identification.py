"""The files of `amhe identify`, written together."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from amhe_cli.core.belief_file import belief_text
from amhe_cli.estimation.offline.result import Identification
from amhe_cli.report.folder import filling
from amhe_cli.report.page import identification_page
from amhe_cli.system.export import identified_assets, identified_xml
from amhe_cli.system.system import System


def write_identification(
    folder: Path, system: System, result: Identification, record: Mapping[str, Any], origin: dict[str, object]
) -> None:
    """Write belief.yaml, identified.xml (its meshes in assets/), result.json and report.html, all or none.

    Args:
        folder: Where to; made if it does not exist.
        system: What was identified.
        result: What was found.
        record: Content of result.json.
        origin: Provenance of the belief.
    """
    belief = replace(result.belief, provenance=origin)
    contents = {
        "belief.yaml": belief_text(belief),
        "identified.xml": identified_xml(system, belief.estimate),
        "result.json": json.dumps(record, indent=2, allow_nan=False) + "\n",
        "report.html": identification_page(result, record, origin),
    }
    with filling(folder) as scratch:
        for name, text in contents.items():
            (scratch / name).write_text(text, encoding="utf-8")
        for name, source in identified_assets(system).items():
            (scratch / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, scratch / name)
