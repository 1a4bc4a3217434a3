"""The page and the table that all reports share."""

import io

from rich.console import Console

from amhe_cli.report.page import Section, Statement, page, result_page
from amhe_cli.report.tables import NUMBER, Table, rich_table

TABLE = Table(("name", "mass", "goal"), ("name", NUMBER, ""), [("a<b", "4.0", "NO"), ("c", "5.0", "yes")])
PROVENANCE = {
    "created": "2030-01-02T03:04:05+00:00", "command": "amhe run <t4>", "seed": 3,
    "versions": {"amhe": "0.1.0", "mujoco": "4.0.0"}, "logs": {"log.mcap": "ab" * 32},
}  # fmt: skip


def made(*sections: Section, warnings: tuple[str, ...] = ()) -> str:
    return page(
        "run", title="T1 & more", facts=("1 log",), headline="Failed.",
        statements=[Statement("bad", "The robot fell.")], sections=sections, warnings=warnings,
    )  # fmt: skip


def test_texts_are_escaped() -> None:
    html = made(Section("Motion", table=TABLE, items=["<li>"]))
    assert "<h1>T1 &amp; more</h1>" in html and "a&lt;b" in html and "<li>&lt;li&gt;</li>" in html


def test_warnings_are_listed_and_linked_from_the_summary() -> None:
    assert "warning" not in made(Section("Motion"))
    html = made(Section("Motion"), warnings=("a gap", "a jump"))
    assert '<a href="#warnings">2 warnings</a>' in html and html.index("a gap") > html.index('id="warnings"')


def test_contents_name_every_part_of_a_long_page() -> None:
    html = made(*(Section(name) for name in ("Held out", "Data", "What is missing", "Next")))
    for name, anchor in (("Held out", "held-out"), ("What is missing", "what-is-missing")):
        assert f'<a href="#{anchor}">{name}</a>' in html and f'id="{anchor}"' in html


def test_how_it_was_made_is_said_last() -> None:
    record = {"command": "run", "version": "0.1.0", "warnings": ["a gap"]}
    html = result_page(
        record, PROVENANCE, title="T", facts=(), headline="Done.", statements=(), sections=[Section("Motion")]
    )
    parts = ("Motion", "Warnings", "amhe run &lt;t4&gt;", "SHA-256 of log.mcap", "ab" * 32)
    assert sorted(parts, key=html.rindex) == list(parts)
    assert "2030-01-02 03:04:05 UTC" in html


def test_missed_goals_stand_out() -> None:
    html = made(Section("Goals", table=TABLE))
    assert html.count(' missed">NO') == html.count(' reached">yes') == 1


def test_a_table_for_a_terminal_has_its_numbers_flush_right() -> None:
    out = io.StringIO()
    Console(file=out, width=60).print(rich_table(Table(("", "m"), ("", NUMBER), [("a", "4"), ("b", "10.5")])))
    lines = [line.rstrip() for line in out.getvalue().splitlines()]
    assert lines[-2].endswith("   4")
    assert lines[-1].endswith("10.5")


def test_columns_can_be_left_out() -> None:
    less = TABLE.without("mass")
    assert (less.head, less.looks, less.rows) == (
        ["name", "goal"],
        ["name", ""],
        [["a<b", "NO"], ["c", "yes"]],
    )
