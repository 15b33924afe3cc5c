"""A run is what is on disk: whatever ends a command, a worker or a file, the same command goes on to the same rows."""

import bz2
import gzip
import json
import lzma
import os
import signal
import subprocess
import sys
import time
import warnings
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from battery_env import Settings, files, load_nasa_discharges, read_discharges
from battery_env.files import locked
from battery_env.lab import many
from battery_env.lab.command_line import main
from battery_env.lab.workers import attempt, in_order, workers
from tests.faults import a_full_disk, squared_unless_it_ends_its_process

ROWS = 12


def write(record, path):
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
    pd.DataFrame(columns).to_csv(path, index=False)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab")
    for number, record in enumerate(load_nasa_discharges("B0005")[:ROWS]):
        write(record, folder / f"c{number}.csv")
    return folder


def started(*arguments, **more):
    command = [sys.executable, "-m", "battery_env", "calibrate", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **more)


def wait_for(condition):
    end = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def rows_in(out):
    return max(len((out / "estimate.jsonl").read_bytes().splitlines()) - 1, 0) if (out / "estimate.jsonl").exists() else 0


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
    assert main(["calibrate", str(lab), "--out", str(out), "--table-only"]) == 0
    return (out / "estimate.csv").read_bytes()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="it looks for processes as Linux has them")
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, "worker"])
def test_the_same_command_goes_on_and_nothing_outlives_it(end, lab, undisturbed, tmp_path, capsys):
    arguments = (lab, "--out", tmp_path, "--table-only", "--jobs", 2)
    process = started(*arguments)
    wait_for(lambda: rows_in(tmp_path) >= 3)
    others = workers_of(process.pid)
    assert len(others) == 2
    os.kill(others[0] if end == "worker" else process.pid, signal.SIGKILL if end == "worker" else end)
    _, error = process.communicate(timeout=120)
    wait_for(lambda: not any(map(is_alive, others)))
    if end == "worker":  # one takes its place
        assert process.returncode == 0, error
    else:
        assert process.returncode == (-9 if end == signal.SIGKILL else 143)
        done = rows_in(tmp_path)
        assert 3 <= done < ROWS
        if end == signal.SIGTERM:
            assert b"the same command goes on" in error and len(pd.read_csv(tmp_path / "estimate.csv")) == done
        assert main(["calibrate", *map(str, arguments[:-2])]) == 0
        shown = capsys.readouterr()
        assert f"going on: {done} discharges are done" in shown.err
        assert shown.out.count("\nc") == ROWS - 1 and "12 discharges: 12 settled" in shown.out
    assert (tmp_path / "estimate.csv").read_bytes() == undisturbed


def test_a_call_that_its_process_does_not_survive_is_an_error_and_all_others_are_made():
    with workers(2) as pool:
        made = list(in_order(pool, 4, squared_unless_it_ends_its_process, [(n, (2, 3)) for n in range(8)]))
        assert [call[0] for call, _ in made] == list(range(8))
        assert [each.result for _, each in made] == [0, 1, None, None, 16, 25, 36, 49]
        assert [bool(each.error) for _, each in made] == [n in (2, 3) for n in range(8)]
        assert list(in_order(pool, 4, squared_unless_it_ends_its_process, [(3, ())])) == [((3, ()), (9, [], ""))]


def test_of_two_commands_on_one_folder_one_is_refused_and_no_row_is_lost(lab, undisturbed, tmp_path, capsys):
    first = started(lab, "--out", tmp_path, "--table-only")
    wait_for(lambda: rows_in(tmp_path))
    first.send_signal(signal.SIGSTOP)  # as slow as it takes
    assert main(["calibrate", str(lab), "--out", str(tmp_path), "--table-only"]) == 2
    assert "is being written by another command: wait for it, or choose another --out" in capsys.readouterr().err
    first.send_signal(signal.SIGCONT)
    first.communicate(timeout=120)
    assert first.returncode == 0
    assert (tmp_path / "estimate.csv").read_bytes() == undisturbed
    with locked(tmp_path / "c1_estimate.jsonl"):  # of another file
        assert main(["calibrate", f"{lab}/c2.csv", "--out", str(tmp_path), "--table-only"]) == 0


@pytest.mark.parametrize("left", [b"", b'{"source": "', bytes(100), b"\xff\n", b"[]\n", b'{"source": 3}\n'])
def test_what_a_power_cut_left_of_a_run_is_gone_on_from(left, lab, undisturbed, tmp_path, monkeypatch, capsys):
    arguments = ["calibrate", *map(str, sorted(lab.iterdir())[:3]), "--out", str(tmp_path), "--table-only"]
    assert main(arguments) == 0
    whole, run = (tmp_path / "estimate.csv").read_bytes(), tmp_path / "estimate.jsonl"
    lines = run.read_bytes().splitlines(keepends=True)
    run.write_bytes(b"".join(lines[:3]) + left)
    (tmp_path / "estimate.csv").write_bytes(b"")
    calls = []
    monkeypatch.setattr(many, "calibrate", lambda *call, made=many.calibrate: calls.append(call) or made(*call))
    assert main(arguments) == 0
    assert len(calls) == 1 and run.read_bytes().splitlines(keepends=True) == lines
    assert (tmp_path / "estimate.csv").read_bytes() == whole


def test_a_run_is_gone_on_from_by_the_same_command_on_the_same_files_alone(lab, tmp_path, capsys):
    records = [tmp_path / name for name in ("a.csv", "b.csv")]
    for record, path in zip(load_nasa_discharges("B0006"), records, strict=False):
        write(record, path)
    out = tmp_path / "out"
    arguments = ["calibrate", *map(str, records), "--out", str(out), "--table-only"]
    assert main(arguments) == 0
    for more, named in ((["--nominal", "2"], "nominal_Ah"), (["--isothermal"], "thermal"), (["--ignore", "x"], "ignore")):
        capsys.readouterr()
        assert main([*arguments, *more]) == 2
        assert f"is of a command with another {named}; choose another --out, or give --force" in capsys.readouterr().err
    write(load_nasa_discharges("B0006")[50], records[1])
    assert main(arguments) == 0
    shown = capsys.readouterr()
    assert "going on: 1 discharges are done" in shown.err
    again = pd.read_csv(out / "estimate.csv")
    assert list(again["record"]) == ["a", "b"] and again["q_mobile_C"][1] < again["q_mobile_C"][0] - 500.0
    assert main([*arguments, "--isothermal", "--force"]) == 0
    (out / "estimate.jsonl").write_bytes(b"")
    assert main(arguments) == 2 and "would be replaced" in capsys.readouterr().err


HOSTILE = ["caf\udce9", "a$b$c", "$^{", "=cmd|x", "\x1b[31mred", "zelle_ü", "two\nlines"]


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
    assert pd.read_parquet(out / "estimate.parquet")["source"].tolist() == table["source"].tolist()
    assert not table["record"].str.match(r"[=+@-]").any() and not table["source"].str.contains("\x1b").any()
    for name in table["record"]:
        assert (out / f"{name}_voltage.png").read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_drawn_or_written_beside_costs_no_row_and_is_made_by_the_same_command(lab, tmp_path, capsys):
    arguments = ["calibrate", f"{lab}/c1.csv", f"{lab}/c2.csv", "--out", str(tmp_path)]
    with a_full_disk(after_bytes=20_000):  # enough for the numbers
        assert main(arguments) == 0
    table = pd.read_csv(tmp_path / "estimate.csv")
    assert table["settled"].all() and table["notes"].str.contains("voltage.png is not written: .*File too large").all()
    assert "life.png is not written: OSError" in capsys.readouterr().err
    assert main(arguments) == 0
    assert pd.read_csv(tmp_path / "estimate.csv")["notes"].isna().all()
    assert {path.suffix for path in tmp_path.glob("*_voltage.*")} == {".csv", ".png"} and (tmp_path / "life.png").exists()


def test_a_disk_that_is_full_is_said_and_the_same_command_goes_on(lab, undisturbed, tmp_path, capsys):
    arguments = ["calibrate", str(lab), "--out", str(tmp_path), "--table-only"]
    with a_full_disk(after_bytes=6_000):
        assert main(arguments) == 2
    assert "File too large" in capsys.readouterr().err and rows_in(tmp_path) > 2
    assert main(arguments) == 0
    assert (tmp_path / "estimate.csv").read_bytes() == undisturbed


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
    assert main(["calibrate", str(tmp_path), "--json"]) == 2
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
        for (number,), made in in_order(pool, 16, warned, [(n,) for n in range(64)]):
            assert made == (number, [f"{number}.{step}" for step in range(3)], "")
    assert attempt(attempt, warned, 1).result == attempt(warned, 1)


def test_any_executor_does(lab):
    sources = many.find_sources([f"{lab}/c1.csv", f"{lab}/c2.csv", f"{lab}/c1.csv"])
    with ThreadPoolExecutor(2) as pool:
        found = list(many.calibrate_all(sources, many.FileFormat(), Settings(), executor=pool))
    assert [each.record for each in found] == ["c1", "c2"] and np.ptp([each.found.q_mobile_C for each in found]) > 0.0


def a_bomb(path):
    """A small file that becomes a large one: a record of one row, so many times."""
    header, row = b"time_s,voltage_V,current_A\n", b"1.0,4.0,2.0\n" * (1 << 16)
    packed = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
    if path.suffix == ".parquet":
        batch = pa.table({name: np.ones(1 << 18) for name in ("time_s", "voltage_V", "current_A")})
        with parquet.ParquetWriter(path, batch.schema, compression="zstd") as writer:
            for _ in range(4):
                writer.write_table(batch)
        return
    if path.suffix in packed:
        opened = packed[path.suffix](path, "wb")
    else:
        archive = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        opened = archive.open("xl/record.csv" if path.suffix == ".xlsx" else "record.csv", "w", force_zip64=True)
    with opened as stream:
        stream.write(header)
        for _ in range(6):
            stream.write(row)
    if path.suffix in (".zip", ".xlsx"):
        archive.close()


@pytest.mark.parametrize("name", ["a.csv.gz", "a.csv.bz2", "a.csv.xz", "a.csv.zip", "a.xlsx", "a.parquet"])
def test_a_small_file_does_not_become_a_large_one(name, tmp_path, monkeypatch):
    a_bomb(tmp_path / name)
    monkeypatch.setattr(files, "LARGEST_UNPACKED_BYTES", 1 << 22)
    with pytest.raises(ValueError, match=r"bytes would become more than \d+ MiB: unpack it by hand"):
        read_discharges(tmp_path / name)
