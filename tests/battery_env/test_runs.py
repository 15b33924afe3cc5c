"""A run is what is on disk: whatever ends a command, a worker or a file, the same command goes on to the same rows."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import battery_env
from battery_env import Settings, load_nasa_discharges
from battery_env.files import locked
from battery_env.lab import batch, command_line
from battery_env.lab.batch import attempt, workers
from battery_env.lab.command_line import calibrate as command
from battery_env.lab.sources import find_sources
from tests.faults import a_full_disk, squared_after_a_while, squared_unless_it_ends_its_process, until
from tests.sweeps import sweep
from tests.terminal import write

ROWS = 8
# of a discharge, without its rows
VOLTAGES = {"csv": b"time_s,voltage_V,current_A,model_V\n", "png": b"picture"}


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab")
    for number, record in enumerate(load_nasa_discharges("B0005")[:ROWS]):
        write(record, folder / f"c{number}.csv")
    return folder


def started(*arguments, **more):
    command = [sys.executable, "-m", "battery_env", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **more)


def rows_in(out):
    run = out / "estimate.jsonl"
    return sum(b'"row"' in line for line in run.read_bytes().splitlines()) if run.exists() else 0


def children_of(pid):
    return [int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()]


def workers_of(pid):
    """Those that calibrate, without the one that keeps count of semaphores."""
    return [child for child in children_of(pid) if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture(scope="module")
def undisturbed(lab, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed")
    assert command([str(lab), "--out", str(out), "--table-only"]) == 0
    return (out / "estimate.csv").read_bytes()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="it looks for processes as Linux has them")
@pytest.mark.parametrize("end", sweep(signal.SIGTERM, signal.SIGKILL, "worker"))
@pytest.mark.attacks
def test_the_same_command_goes_on_and_nothing_outlives_it(end, lab, undisturbed, tmp_path, capsys):
    arguments = (lab, "--out", tmp_path, "--table-only", "--jobs", 2)
    process = started(*arguments)
    until(lambda: rows_in(tmp_path) >= 3, 300.0)
    others = workers_of(process.pid)
    assert len(others) == 2
    os.kill(others[0] if end == "worker" else process.pid, signal.SIGKILL if end == "worker" else end)
    _, error = process.communicate(timeout=300)
    until(lambda: not any(map(is_alive, others)), 300.0)
    if end == "worker":  # one takes its place
        assert process.returncode == 0, error
    else:
        assert process.returncode == (-9 if end == signal.SIGKILL else 130)
        done = rows_in(tmp_path)
        assert 3 <= done < ROWS
        if end == signal.SIGTERM:
            assert b"the same command goes on" in error and len(pd.read_csv(tmp_path / "estimate.csv")) == done
        assert command([*map(str, arguments[:-2])]) == 0
        shown = capsys.readouterr()
        assert f"going on: {done} discharges are done" in shown.err
        assert shown.out.count("\nc") == ROWS - 1 and f"{ROWS} discharges: {ROWS} settled" in shown.out
    assert (tmp_path / "estimate.csv").read_bytes() == undisturbed


def test_a_call_that_its_process_does_not_survive_is_an_error_and_takes_no_other_call_with_it(tmp_path):
    log = tmp_path / "begun"
    with workers(2) as pool:
        slow = pool.submit(squared_after_a_while, 3, log)
        until(log.exists, 300.0)
        made = [pool.submit(squared_unless_it_ends_its_process, n, (1,)) for n in range(5)]
        assert [isinstance(each.exception(), BrokenExecutor) for each in made] == [n == 1 for n in range(5)]
        assert [each.result() for n, each in enumerate(made) if n != 1] == [0, 4, 9, 16]
        assert slow.result() == 9 and log.read_bytes() == b"x"


@pytest.fixture(scope="module")
def said():
    """What a discharge says, and a fit to it."""
    record = load_nasa_discharges("B0005")[0]
    return battery_env.calibrate(record), battery_env.fit_cell([record])


@pytest.fixture
def quick(said, monkeypatch):
    """Calibration without its work: a discharge says what another one said, in files of a few bytes."""
    of_discharge, fit = said
    monkeypatch.setattr(batch, "calibrate", lambda discharge, settings: of_discharge)
    monkeypatch.setattr(batch, "_voltages_of", lambda name, found: VOLTAGES)
    monkeypatch.setattr(batch, "_draw_life", lambda whole, path: path.write_bytes(b"life"))
    monkeypatch.setattr(command_line, "fit_cell", lambda *given, **more: fit)
    monkeypatch.setattr("battery_env.plotting.plot_cell_fit", lambda *given: Figure((1.0, 1.0)))


@pytest.fixture(scope="module")
def written_pair(tmp_path_factory):
    """Two folders of records, of the same names, and one in progress beside them."""
    whole = tmp_path_factory.mktemp("pair")
    for folder, cell in (("lab", "B0005"), ("other", "B0006")):
        (whole / folder).mkdir()
        for number, record in enumerate(load_nasa_discharges(cell)[:2]):
            write(record, whole / folder / f"c{number}.csv")
    write(load_nasa_discharges("B0006")[9].until(1500.0), whole / "c1.csv")
    return whole


@pytest.fixture
def pair(written_pair, tmp_path, monkeypatch):
    """The same for one test, and where all results go."""
    shutil.copytree(written_pair, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


COMMANDS = {
    "a folder": "lab --out out",
    "its table": "lab --out out --table-only",
    "a file of it": "lab/c1.csv --out out",
    "some of it": "lab/c0.csv lab/c1.csv --out out",
    "another folder": "other --out out",
    "a file of the same name": "other/c1.csv --out out",
    "other settings": "lab --out out --nominal 2",
    "a forecast": "forecast c1.csv --prior 7000 70 --out out",
    "a fit": "fit lab/c1.csv --out out/life.json",
    "another fit": "fit lab/c1.csv --out out/c1_voltage.json",
}


def contents(out):
    return {path.name: path.read_bytes() for path in out.iterdir() if not path.name.startswith(".")} if out.exists() else {}


@pytest.mark.parametrize("ends", ["whole", "before its tables"])
@pytest.mark.parametrize("first", sweep(*COMMANDS))
def test_no_command_touches_what_another_one_wrote_to_the_same_folder(first, ends, quick, pair, capsys, monkeypatch):
    if ends != "whole" and not COMMANDS[first].startswith("lab "):
        pytest.skip("others end whole or not at all")
    with monkeypatch.context() as patch:
        if ends != "whole":
            patch.setattr(batch.Results, "write_tables", lambda results: [])
        assert command(COMMANDS[first].split()) in (0, 3)
    owners = dict.fromkeys(contents(pair / "out"), first)
    for name in (*(each for each in COMMANDS if each != first), first):
        before = contents(pair / "out")
        capsys.readouterr()
        status, error = command(COMMANDS[name].split()), capsys.readouterr().err
        after = contents(pair / "out")
        assert {file: after[file] for file in before if owners[file] != name or status == 2} == {
            file: content for file, content in before.items() if owners[file] != name or status == 2
        }, name
        assert status in (0, 3) or ("out/" in error and "--out" in error and after.keys() == before.keys()), name
        owners |= {file: name for file in after if file not in owners}


def test_another_command_is_told_what_is_there_and_may_replace_it(quick, pair, capsys, terminal):
    assert command("lab --out out".split()) == 0
    for second, said in (
        ("other", f"estimate.jsonl is of a command that reads {pair}/lab; choose another --out, or give --force"),
        ("lab --nominal 2", "estimate.jsonl is of a command with another nominal_Ah; choose"),
        ("other --ignore x", f"that reads {pair}/lab with another ignore; choose"),
    ):
        assert said in terminal.refuses(*f"{second} --out out".split())
    assert command("other --out out --force".split()) == 0
    assert pd.read_csv("out/estimate.csv")["source"].str.startswith("other").all()
    assert command(f"./other --out ../{pair.name}/out".split()) == 0
    assert "going on: 2 discharges are done" in capsys.readouterr().err


def test_a_run_that_has_nothing_to_lose_gives_way_and_what_has_the_name_of_a_result_does_not(quick, pair, terminal):
    assert command("lba --out out".split()) == 2 and set(contents(pair / "out")) == {"estimate.jsonl"}
    Path("out/c1_voltage.csv").write_text("precious")
    refused = terminal.refuses("lab", "--out", "out")
    assert "c1_voltage.csv would be replaced; choose another --out, or give --force" in refused
    assert Path("out/c1_voltage.csv").read_text() == "precious"
    assert command("lab --out out --force".split()) == 0 and Path("out/c1_voltage.csv").read_text() != "precious"
    # a record among the results
    shutil.copy("lab/c0.csv", "lab/c5.csv")
    shutil.copy("lab/c0.csv", "out/c5_voltage.csv")
    assert "c5_voltage.csv would be" in terminal.refuses("lab", "--out", "out")
    assert "is a file" in terminal.refuses("lab", "--out", "out/c1_voltage.csv")


@pytest.mark.parametrize("left", [1, 0])
def test_rows_of_files_that_are_not_there_are_kept(left, quick, pair, capsys):
    assert command("lab --out out".split()) == 0
    before = contents(pair / "out")
    for number in range(left, 2):
        Path(f"lab/c{number}.csv").rename(f"c{number}.away")
    capsys.readouterr()
    assert command("lab --out out".split()) == (0 if left else 2)  # nothing is there to be read
    assert f"{2 - left} of them of files that are not there now" in capsys.readouterr().err
    assert list(pd.read_csv("out/estimate.csv")["record"])[-2:] == ["c0", "c1"]
    write(load_nasa_discharges("B0006")[3], Path("lab/c5.csv"))
    assert command("lab --out out".split()) == 0
    assert set(pd.read_csv("out/estimate.csv")["record"]) == {"c0", "c1", "c5"}
    Path("lab/c5.csv").unlink()
    for number in range(left, 2):
        Path(f"c{number}.away").rename(f"lab/c{number}.csv")
    assert command("lab --out out".split()) == 0
    after = contents(pair / "out")
    assert {name for name in before if after[name] != before[name]} == {"estimate.csv", "estimate.jsonl"}
    assert set(pd.read_csv("out/estimate.csv")["record"]) == {"c0", "c1", "c5"}


STRANGERS = [b"Dear all", b"", b"{}", b"[]\n", bytes(100), b"\xff\n", b'{"format": "another"}\n{"row": 1}\n']


@pytest.mark.parametrize("content", sweep(*STRANGERS))
def test_a_file_of_somebody_else_is_left_alone(content, quick, pair, terminal):
    (pair / "out").mkdir()
    run = pair / "out" / "estimate.jsonl"
    run.write_bytes(content)
    for more in ([], ["--force"]):
        refused = terminal.refuses("lab", "--out", "out", *more)
        assert "is no run of battery-calibrate: choose another --out, or move it" in refused
        assert contents(pair / "out") == {"estimate.jsonl": content}
    run.unlink()
    assert command("lab --out out".split()) == 0
    (pair / "out" / "c1_voltage.csv").unlink()
    (pair / "out" / "life.png").write_bytes(content)
    assert command("lab --out out".split()) == 0  # its own, whoever changed it


def test_one_command_at_a_time_writes_to_a_folder(quick, pair, terminal):
    with locked(Path("out/estimate.jsonl")):
        refused = terminal.refuses("lab", "--out", "out")
        assert "is being written by another command: wait for it, or choose another --out" in refused
    assert not contents(pair / "out") and command("lab/c1.csv --out out".split()) == 0


@pytest.mark.parametrize("left", sweep(b'{"source": "', b"", bytes(100), b"\xff\n", b"[]\n", b'{"source": 3}\n'))
def test_what_a_power_cut_left_of_a_run_is_gone_on_from(left, quick, pair, monkeypatch):
    arguments = "lab/c0.csv lab/c1.csv --out out --table-only".split()
    assert command(arguments) == 0
    whole, run = Path("out/estimate.csv").read_bytes(), Path("out/estimate.jsonl")
    lines = run.read_bytes().splitlines(keepends=True)
    run.write_bytes(b"".join([*lines[:2], *lines[3:]]) + left)
    Path("out/estimate.csv").write_bytes(b"")
    calls = []
    monkeypatch.setattr(batch, "calibrate", lambda *call, made=batch.calibrate: calls.append(call) or made(*call))
    assert command(arguments) == 0
    assert len(calls) == 1 and sorted(run.read_bytes().splitlines(keepends=True)) == sorted(lines)
    assert Path("out/estimate.csv").read_bytes() == whole


@pytest.mark.parametrize("dates", [("2011-01-10", "2010-12-13"), ("2011-01-10", None)])
def test_the_table_of_a_folder_is_in_the_order_of_its_dates_and_names_another_one(dates, quick, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    table = pd.read_csv(write(load_nasa_discharges("B0006")[1], "table.csv"))
    Path("lab").mkdir()
    for name, date in zip(("cell_1_10_11.csv", "cell_12_13_10.csv"), dates, strict=True):
        clock = {} if date is None else {"Date": pd.Timestamp(date) + pd.to_timedelta(table["time_s"], unit="s")}
        table.assign(**clock).to_csv(Path("lab", name), index=False)
    for _ in range(2):  # the second goes on from the first
        assert command("lab --out out".split()) == 0
    rows = pd.read_csv("out/estimate.csv", dtype={"start_time": str})
    names = ["cell_12_13_10", "cell_1_10_11"]
    assert rows["record"].tolist() == (names if dates[1] else names[::-1])
    assert rows["start_time"].str[:10].fillna("").tolist() == (sorted(dates) if dates[1] else [dates[0], ""])
    said = "cell_12_13_10: starts on 2010-12-13, and a file before it on 2011-01-10: records are printed by their names"
    assert (said in capsys.readouterr().err) == (dates[1] is not None)


def test_a_file_that_has_changed_is_read_again(pair, capsys):
    arguments = "lab --out out --table-only".split()
    assert command(arguments) == 0
    before = pd.read_csv("out/estimate.csv")
    write(load_nasa_discharges("B0006")[72], Path("lab/c1.csv"))
    assert command(arguments) == 0
    assert "going on: 1 discharges are done" in capsys.readouterr().err
    again = pd.read_csv("out/estimate.csv")
    assert list(again["record"]) == ["c0", "c1"] and again["q_mobile_C"][0] == before["q_mobile_C"][0]
    assert again["q_mobile_C"][1] < before["q_mobile_C"][1] - 500.0


def test_a_record_that_changed_under_its_old_size_and_time_is_read_again(quick, pair, capsys):
    arguments = "lab --out out --table-only".split()
    assert command(arguments) == 0
    path = Path("lab/c1.csv")
    before, text = path.stat(), path.read_text()
    path.write_text(text[:-2] + str((int(text[-2]) + 1) % 10) + text[-1])
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (path.stat().st_size, path.stat().st_mtime_ns) == (before.st_size, before.st_mtime_ns)
    assert command(arguments) == 0
    assert "going on: 1 discharges are done" in capsys.readouterr().err
    os.utime(path)  # what it holds is as it was
    assert command(arguments) == 0
    assert "going on: 2 discharges are done" in capsys.readouterr().err


@pytest.mark.parametrize(
    "change",
    [
        lambda line: re.sub(rb'("q_mobile_C": \d)', rb"\g<1>1", line),
        lambda line: line.replace(b'"number": 0, ', b""),
        lambda line: line.replace(b'"whole": true', b'"whole": 1'),
        lambda line: line[: line.index(b', "row"')] + b"}",
    ],
    ids=["a digit", "no number", "no truth value", "no row"],
)
def test_a_line_that_was_changed_by_hand_is_made_again_and_said(change, quick, pair, capsys, terminal):
    arguments = "lab --out out --table-only".split()
    assert command(arguments) == 0
    whole, run = Path("out/estimate.csv").read_bytes(), Path("out/estimate.jsonl")
    header, first, second = run.read_bytes().splitlines()
    changed = change(first)
    assert changed != first
    run.write_bytes(b"\n".join([header, changed, second, b""]))
    assert "is of a command with another nominal_Ah" in terminal.refuses(*arguments, "--nominal", "2")
    assert command(arguments) == 0
    said = capsys.readouterr().err
    assert "estimate.jsonl: 1 lines are not as they were written, and are left out" in said
    assert "going on: 1 discharges are done" in said and Path("out/estimate.csv").read_bytes() == whole


def test_a_pipe_in_the_place_of_a_run_is_a_sentence(quick, pair, terminal):
    Path("out").mkdir()
    os.mkfifo("out/estimate.jsonl")
    assert "estimate.jsonl is no run of battery-calibrate: choose another --out" in terminal.refuses("lab", "--out", "out")


def test_no_text_of_a_table_is_a_formula(quick, pair):
    record = load_nasa_discharges("B0005")[0]
    for name in ("=1+1.csv", "+1.csv", "@SUM(A1).csv", "=HYPERLINK(0).csv.gz"):
        write(record, pair / name)
    cells = pd.concat([pd.read_csv("lab/c0.csv").assign(cell=cell) for cell in ("=1+2", "-3", "@x")])
    cells.to_csv("=cells.csv", index=False)
    Path("=broken.csv").write_text("nothing")
    records = ["=1+1.csv", "+1.csv", "@SUM(A1).csv", "=HYPERLINK(0).csv.gz", "=cells.csv", "=broken.csv"]
    assert command([*records, "--out", "out"]) == 2
    table = pd.read_csv("out/estimate.csv")
    texts = table.select_dtypes(exclude=["number", "bool"]).stack()
    assert len(table) == 6 and not texts[[isinstance(each, str) for each in texts]].str.match(r"[=+@-]").any()
    assert all(Path(source).exists() for source in table["source"])
    assert not any(name.startswith(("=", "+", "-", "@")) for name in contents(pair / "out"))


HOSTILE = ["caf\udce9 a$b$^{c", "=cmd|x", "\x1b[31mred_ü two\nlines"]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_no_name_costs_a_row_or_a_picture_not_even_on_an_ascii_console(tmp_path):
    record, folder, out = load_nasa_discharges("B0006")[99], tmp_path / "lab", tmp_path / "out"
    folder.mkdir()
    for name in HOSTILE:
        write(record, folder / f"{name}.csv")
    ascii_console = {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    process = started(folder, "--out", out, env={**os.environ, **ascii_console})
    printed, error = process.communicate(timeout=120)
    assert process.returncode == 0, error
    assert error == b"" and b"\x1b" not in printed and f"{len(HOSTILE)} discharges: {len(HOSTILE)} settled".encode() in printed
    table = pd.read_csv(out / "estimate.csv")
    assert table["notes"].isna().all() and table["record"].nunique() == len(HOSTILE) and (out / "life.png").exists()
    assert not table["record"].str.match(r"[=+@-]").any() and not table["source"].str.contains("\x1b").any()
    for name in table["record"]:
        assert (out / f"{name}_voltage.png").read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_written_beside_costs_no_row_and_is_made_by_the_same_command(lab, tmp_path, capsys):
    arguments = [f"{lab}/c1.csv", f"{lab}/c2.csv", "--out", str(tmp_path)]
    with a_full_disk(after_bytes=20_000):  # enough for the numbers
        assert command(arguments) == 0
    table = pd.read_csv(tmp_path / "estimate.csv")
    assert table["settled"].all() and table["notes"].str.contains("voltage is not written: .*File too large").all()
    assert "life.png is not written: OSError" in capsys.readouterr().err
    assert command(arguments) == 0
    assert pd.read_csv(tmp_path / "estimate.csv")["notes"].isna().all()
    assert {path.suffix for path in tmp_path.glob("*_voltage.*")} == {".csv", ".png"} and (tmp_path / "life.png").exists()


def test_a_disk_that_is_full_is_said_and_the_same_command_goes_on(lab, quick, tmp_path, capsys):
    disturbed, undisturbed = ([str(lab), "--out", str(tmp_path / name), "--table-only"] for name in ("a", "b"))
    with a_full_disk(after_bytes=6_000):
        assert command(disturbed) == 2
    assert "File too large" in capsys.readouterr().err and ROWS > rows_in(tmp_path / "a") > 2
    assert command(disturbed) == command(undisturbed) == 0
    assert (tmp_path / "a/estimate.csv").read_bytes() == (tmp_path / "b/estimate.csv").read_bytes()


def test_what_cannot_be_looked_into_is_named_and_the_exit_status_says_so(lab, tmp_path, monkeypatch, capsys):
    record = load_nasa_discharges("B0006")[99]
    write(record, tmp_path / "good.csv")
    write(record, tmp_path / "own_estimate.csv")  # a record of a name that results have
    (tmp_path / "closed").mkdir()
    (tmp_path / "gone.csv").symlink_to(tmp_path / "nowhere.csv")
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "elsewhere").symlink_to(lab)
    scandir = os.scandir

    def closed(path="."):
        if Path(path).name == "closed":
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", closed)
    assert command([str(tmp_path), "--json"]) == 2
    shown = capsys.readouterr()
    rows = {row["record"]: row["error"] for row in map(json.loads, shown.out.splitlines())}
    assert rows.keys() == {"closed", "gone", "good", "own_estimate", "pipe"}
    assert [name for name, error in rows.items() if not error] == ["good", "own_estimate"]
    assert "Permission denied" in rows["closed"] and "no file" in rows["gone"] and "save it to one" in rows["pipe"]
    assert "elsewhere left out" in shown.err


def warned(number):
    for step in range(3):
        warnings.warn(f"{number}.{step}", stacklevel=1)
        time.sleep(1e-3)
    return number


def test_threads_do_not_take_each_others_warnings():
    with ThreadPoolExecutor(8) as pool:
        made = [pool.submit(attempt, warned, n) for n in range(64)]
        for number, each in enumerate(made):
            assert each.result() == (number, [f"{number}.{step}" for step in range(3)], "")
    assert attempt(attempt, warned, 1).result == attempt(warned, 1)


def test_any_executor_does(lab):
    sources = find_sources([f"{lab}/c1.csv", f"{lab}/c2.csv", f"{lab}/../{lab.name}/c1.csv"])
    with ThreadPoolExecutor(2) as pool:
        found = list(batch.calibrate_all(sources, batch.FileFormat(), Settings(), executor=pool))
    assert [each.record for each in found] == ["c1", "c2"] and np.ptp([each.found.q_mobile_C for each in found]) > 0.0
