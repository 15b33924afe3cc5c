"""What readers see of a study is what its report says of the tables that are published beside it."""

import json
from functools import partial

from benchmarks import calibrators, direct_mapping, other_cells, published, speed, stabilisation
from benchmarks.study import read_tables
from checks.pages import DOCS

PUBLISHED = DOCS / "results"


def of_one(report, name, tables):
    """A report of one table."""
    return report(tables[name])


def of_comparison(name, tables):
    comparison, results = calibrators.COMPARISONS[name], tables[name]
    if not comparison.by_parameter:
        results = calibrators.by_parameter(results, comparison.conditions[0].labels)
    return calibrators.report(name, results)


def of_mapping(tables):
    made_by = json.loads((PUBLISHED / "direct_mapping" / "direct_mapping.json").read_text())["configuration"]
    return direct_mapping.report(tables["direct_mapping"], made_by)


REPORTS = {
    "direct_mapping/direct_mapping": of_mapping,
    "other_cells/other_cells": partial(of_one, other_cells.report, "other_cells"),
    "published/published": partial(of_one, published.report, "published"),
    "published_horizons/published": partial(of_one, published.report, "published"),
    "stabilisation/stabilisation": stabilisation.report,
    "stabilisation_long/stabilisation": stabilisation.report,
    "throughput/filters": partial(of_one, speed.report_filters, "filters"),
    **{f"{name}/{name}": partial(of_comparison, name) for name in ("faults", "mismatch", "peers")},
}


def test_what_is_shown_is_what_the_reports_say_of_the_published_tables():
    for name, report in REPORTS.items():
        tables = read_tables((PUBLISHED / name).parent)
        shown = (PUBLISHED / f"{name}.md").read_text(encoding="utf-8")
        assert report(tables) == shown, f"{name}: run the study with --redraw"
