"""The page and the table that all reports share."""

import io

from markupsafe import Markup
from rich.console import Console

from amhe_cli.report.page import Fold, Key, Origin, Page, Section, Statement
from amhe_cli.report.tables import NUMBER, Table, rich_table

TABLE = Table(("name", "mass", "goal"), ("name", NUMBER, ""), [("a<b", "4.0", "NO"), ("c", "5.0", "yes")])


def page(*sections: Section, warnings: tuple[str, ...] = ()) -> str:
    origin = Origin(("amhe identify <log>",), {"seed": 3}, {"log.mcap": "ab" * 32})
    statements = [Statement("bad", "The robot fell.")]
    return Page("run", "T1 & more", ("1 log",), "Failed.", statements, sections, warnings, origin).html()


def test_texts_are_escaped_and_figures_are_not() -> None:
    html = page(Section("Motion", figure=Markup("<svg></svg>"), table=TABLE, items=["<li>"]))
    assert "<h1>T1 &amp; more</h1>" in html
    assert "a&lt;b" in html
    assert "<li>&lt;li&gt;</li>" in html
    assert "amhe identify &lt;log&gt;" in html
    assert "<figure><svg></svg></figure>" in html


def test_warnings_are_listed_and_linked_from_the_summary() -> None:
    assert "warning" not in page()
    html = page(warnings=("a gap", "a jump"))
    assert '<a href="#warnings">2 warnings</a>' in html
    assert html.index("a gap") > html.index('id="warnings"')


def test_what_a_section_lacks_leaves_nothing_behind() -> None:
    html = page(Section("Empty")).partition("<h2>Empty</h2>")[2].partition("</section>")[0]
    assert html.strip() == ""


def test_missed_goals_stand_out() -> None:
    html = page(Section("Goals", table=TABLE, name="goals"))
    assert '<section id="goals">' in html
    assert html.count(' missed">NO') == html.count(' reached">yes') == 1
    assert '<td class="number">4.0</td>' in html


def test_a_legend_shows_lines_dots_and_plain_words() -> None:
    keys = (
        Key("box", "red"),
        Key("path", "blue", "dashed"),
        Key("measured", "grey", "dot"),
        Key("n", shape=""),
    )
    html = page(Section("Motion", legend=keys, folds=[Fold("clip", Markup("<b>x</b>"), open=False)]))
    assert 'style="border-top:2px solid red"' in html
    assert 'style="border-top:2px dashed blue"' in html
    assert '<i class="dot" style="background:grey">' in html
    assert "<span>n</span>" in html
    assert "<details>" in html


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
