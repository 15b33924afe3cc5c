"""The page for the bench, as two visitors see it in Chromium. ``PICTURES=FOLDER make test-browser`` keeps what they saw."""

import os
import shutil
import signal
from pathlib import Path

import pandas as pd
import pytest

from battery_env import calibrate, load_nasa_discharges

pytestmark = pytest.mark.browser

WHOLE, WAIT_MS = load_nasa_discharges("B0005")[99], 600_000


@pytest.fixture(scope="module")
def chromium():
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def visitor(chromium):
    """A visitor of a page, apart from all others, and which other hosts were asked for anything."""

    def visit(page):
        tab = chromium.new_context(viewport={"width": 1400, "height": 1300}, locale="en-US").new_page()
        tab.set_default_timeout(WAIT_MS)
        tab.others = []
        tab.on("request", lambda request: page.address[:-1] in request.url or tab.others.append(request.url))
        tab.goto(page.address)
        tab.get_by_text("Give discharges at the left").wait_for()
        return tab

    yield visit
    for context in chromium.contexts:
        context.close()


def picture(tab, name):
    tab.get_by_test_id("stSkeleton").first.wait_for(state="detached")
    if folder := os.environ.get("PICTURES"):
        tab.screenshot(path=Path(folder, f"{name}.png"), full_page=True)


def drop(tab, **files):
    """Files by name, ``__`` for the dot."""
    of_page = [{"name": name.replace("__", "."), "mimeType": "text/csv", "buffer": text} for name, text in files.items()]
    tab.locator("input[type=file]").set_input_files(of_page)


def csv(discharge, names=("time_s", "voltage_V", "current_A"), time=1.0, current=1.0):
    columns = (time * discharge.time_s, discharge.voltage_V, current * discharge.current_A)
    return pd.DataFrame(dict(zip(names, columns, strict=True))).to_csv(index=False).encode()


def choose(tab, label, text, nth=0):
    tab.get_by_label(label, exact=True).nth(nth).fill(text)
    tab.keyboard.press("Enter")


def test_two_visitors_drop_files_state_how_they_are_read_and_leave_nothing(start_page, visitor):
    page = start_page()
    first, second = visitor(page), visitor(page)
    assert not first.get_by_text("Deploy").count()
    picture(first, "1_empty")

    # one whole discharge: its numbers, the forecast on asking, and no life
    drop(first, whole__csv=csv(WHOLE))
    first.get_by_text("the table with all columns").wait_for()
    picture(first, "2_one_discharge")
    says = calibrate(WHOLE)
    assert first.get_by_text(f"{says.q_mobile_C / 3600.0:.3f} Ah").count()
    assert first.locator(".js-plotly-plot").count() == 0
    first.get_by_text("Forecast its end").click()
    first.get_by_text("Empty at").wait_for()
    first.locator(".js-plotly-plot").wait_for()
    picture(first, "2_with_its_end")

    # names that nobody knows, minutes and milliamperes, a charge that is known, and what is no record
    drop(first, odd__csv=csv(WHOLE, ("alpha", "beta", "gamma"), 1.0 / 60.0, -1e3), photo__png=b"\x89PNG\0\0")
    first.get_by_text("photo.png").first.wait_for()
    first.get_by_text("odd.csv").first.wait_for()
    picture(first, "3_read_wrongly")
    assert not first.get_by_text(str(page.temporary)).count()
    for quantity, column, unit in (("time", "alpha", "min"), ("voltage", "beta", "V"), ("current", "gamma", "mA")):
        choose(first, f"{quantity}: column", column)
        choose(first, "unit", unit, ("time", "voltage", "current").index(quantity))
    first.get_by_text("Read again").click()
    first.get_by_text("odd.csv: no column").wait_for(state="detached")
    picture(first, "4_read_as_stated")

    # the other one sees none of it, and has a folder of this machine
    assert second.get_by_text("Give discharges at the left").count()
    second.get_by_text("Or show me a cell").click()
    second.get_by_text("the table with all columns").wait_for()
    picture(second, "5_life")
    assert second.locator(".js-plotly-plot").count() == 2 and not second.get_by_text("odd").count()
    assert first.others == second.others == []
    page.ends_by(signal.SIGINT)
    assert page.left() == []


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL], ids=lambda end: end.name)
def test_whatever_ends_the_command_while_it_computes_nothing_is_left(end, start_page, visitor):
    page = start_page()
    tab = visitor(page)
    tab.get_by_label("or name a folder").fill("B0005")
    tab.keyboard.press("Enter")
    tab.get_by_text("of 168").wait_for()
    page.leave_a_file()
    page.ends_by(end)
    assert page.left() == []
