"""What docs/go1.md says of trips and faults is what they are."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

from amhe_cli.robots.go1.emulator.ports import Faults
from amhe_cli.robots.go1.link.machine import TRIPS
from amhe_cli.robots.go1.link.mail import Phase
from amhe_cli.robots.go1.settings import TripSettings

PAGE = (Path(__file__).parents[4] / "docs" / "go1.md").read_text(encoding="utf-8")


def test_every_trip_and_every_threshold_is_explained() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \|.*\| ([^|]+) \|$", PAGE, re.MULTILINE))
    for name, (_, then) in TRIPS.items():
        assert rows[name].startswith("damp" if then == Phase.DAMP else "hold"), name
    for name in TripSettings.model_fields:
        assert f"`{name}`" in PAGE, name


def test_every_fault_is_explained() -> None:
    section = PAGE.split("## What can go wrong on the emulator")[1].split("\n## ")[0]
    documented = set(re.findall(r"`(\w+)`", section.split("| sort |")[1]))
    assert documented == {fault.name for fault in fields(Faults)}
