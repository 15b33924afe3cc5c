"""Parts are made once and side by side, files say what made them, and numbers read well."""

import json
import operator
import os
import sys
from concurrent.futures import BrokenExecutor
from importlib.util import find_spec
from types import FunctionType, ModuleType

import numpy as np
import pandas as pd
import pytest

from benchmarks import calibrators, study
from benchmarks.study import Study, command_line, digits, with_spread
from tests.faults import squared_after_ends_of_its_process


def a_study(tmp_path, *arguments, jobs=1):
    parser = command_line("example", "An example.")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    return Study(parser, [*arguments, "--jobs", str(jobs), "--out", str(tmp_path)])


MADE = []


def part(seed, scale, place=None):
    MADE.append(seed)
    values = [scale / 3.0, np.nan, np.inf]
    table = {"seed": seed, "value": values, "text": ["None", "", "1e5"], "is": np.array([True, False, True])}
    return {"example": pd.DataFrame(table), "last": pd.DataFrame([{"seed": seed, "array": np.float32(0.1)}])}


@pytest.fixture(autouse=True)
def nothing_made():
    MADE.clear()


def test_parts_are_made_once_and_come_back_in_order_to_the_bit(tmp_path):
    parts = [{"seed": seed, "scale": 1.0} for seed in (3, 1)]
    first = a_study(tmp_path).run(part, parts)
    again = a_study(tmp_path).run(part, parts[::-1], place=tmp_path)
    assert MADE == [3, 1]
    assert list(first) == ["example", "last"] and first["last"]["seed"].tolist() == [3, 1]
    assert again["last"]["seed"].tolist() == [1, 3]
    pd.testing.assert_frame_equal(first["example"].iloc[:3], part(3, 1.0)["example"], check_exact=True)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"{}", b'{"tables": 3}', b"\xff", b"[" * 100_000])
def test_a_damaged_part_is_named_set_aside_and_made_again(content, tmp_path, capsys):
    parts = [{"seed": seed, "scale": 1.0} for seed in (0, 1)]
    first = a_study(tmp_path).run(part, parts)
    file, _ = sorted((tmp_path / "parts").iterdir())
    file.write_bytes(content)
    again = a_study(tmp_path).run(part, parts)
    assert len(MADE) == 3 and f"{file} is damaged" in capsys.readouterr().err
    pd.testing.assert_frame_equal(first["example"], again["example"], check_exact=True)
    (aside,) = (tmp_path / "parts").glob("*.damaged")
    assert aside.read_bytes() == content


def test_other_arguments_another_version_or_another_module_are_other_parts(tmp_path, monkeypatch):
    a_study(tmp_path).run(part, [{"seed": 0, "scale": 1.0}])
    a_study(tmp_path).run(part, [{"seed": 0, "scale": 2.0}])
    with monkeypatch.context() as patch:
        patch.setattr(study, "own_versions", lambda: {"sb3_lac": "99.0.0"})
        a_study(tmp_path).run(part, [{"seed": 0, "scale": 1.0}])
    changed = tmp_path / "changed.py"
    changed.write_text("# another one")
    monkeypatch.setattr(study.inspect, "getfile", lambda function: str(changed))
    a_study(tmp_path).run(part, [{"seed": 0, "scale": 1.0}])
    assert len(MADE) == 4 and len(list((tmp_path / "parts").iterdir())) == 4


def test_figures_are_drawn_once_more_from_what_is_written_and_nothing_is_made(tmp_path):
    first = a_study(tmp_path)
    tables = first.run(part, [{"seed": 0, "scale": 1.0}])
    first.write(tables | {"words": pd.DataFrame({"text": ["word", ""]})}, {}, "said\n")
    written = {path: path.read_bytes() for path in tmp_path.glob("*.*")}
    again = a_study(tmp_path, "--redraw")
    read = again.run(part, [{"seed": 1, "scale": 1.0}])
    again.write(read, {}, "said otherwise\n")
    assert MADE == [0] and set(read) == {"example", "last", "words"} and again.configuration == first.configuration
    pd.testing.assert_frame_equal(read["last"], tables["last"])
    assert read["words"]["text"].tolist() == ["word", ""]
    changed = [path.name for path, content in written.items() if path.read_bytes() != content]
    assert changed == ["example.md"]


def test_what_is_done_before_an_interruption_is_kept(tmp_path, monkeypatch):
    def interrupted(seed, scale):
        if seed == 1:
            raise KeyboardInterrupt
        return part(seed, scale)

    parts = [{"seed": seed, "scale": 1.0} for seed in (0, 1, 2)]
    with monkeypatch.context() as patch:
        patch.setattr(interrupted, "__name__", "part")
        with pytest.raises(SystemExit, match="the same command goes on from there"):
            a_study(tmp_path).run(interrupted, parts)
    a_study(tmp_path).run(part, parts)
    assert MADE == [0, 1, 2]


def test_one_job_stays_in_this_process(tmp_path):
    # what is defined here could not be pickled
    made = a_study(tmp_path).each(lambda *run: (os.getpid(), run), [(1, "a"), (2, "b")])
    assert made == [(os.getpid(), (1, "a")), (os.getpid(), (2, "b"))]


def test_a_call_that_fails_stops_no_other(tmp_path, capsys):
    kept = {}
    with pytest.raises(ZeroDivisionError):
        a_study(tmp_path).each(operator.truediv, [(1, 0), (1, 1)], kept.__setitem__)
    assert kept == {1: 1.0} and "part 1 of 2 failed: ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.attacks
def test_a_lost_process_costs_a_study_nothing_and_one_that_is_lost_twice_its_part_alone(tmp_path, capsys):
    kept, chosen, calls = {}, a_study(tmp_path, jobs=2), [(n, tmp_path) for n in range(3)]
    with pytest.raises(BrokenExecutor):
        chosen.each(squared_after_ends_of_its_process, calls, kept.__setitem__)
    error = capsys.readouterr().err
    assert "part 3 of 3 failed" in error and "1 of 3 parts failed" in error and "the same command goes on from there" in error
    assert kept == {0: 0, 1: 1} and chosen.each(squared_after_ends_of_its_process, calls) == [0, 1, 4]


def fragile_part(seed, place):
    with (place / f"tries_{seed}").open("a") as tries:
        tries.write("x")
    if seed == 1 and (place / "tries_1").stat().st_size == 1:
        os._exit(1)
    if seed == 2 and not (place / "mended").exists():
        raise ValueError("not yet")
    return {"example": pd.DataFrame([{"seed": seed, "process": os.getpid()}])}


@pytest.mark.attacks
def test_on_a_cluster_a_lost_part_is_made_again_and_one_that_fails_stops_no_other(tmp_path, dask_cluster):
    def run():
        chosen = a_study(tmp_path / "out", "--scheduler", dask_cluster.scheduler_address)
        return chosen.run(fragile_part, [{"seed": seed} for seed in range(4)], place=tmp_path)["example"]

    with pytest.raises(ValueError, match="not yet"):
        run()
    kept = {path: path.read_text() for path in (tmp_path / "out" / "parts").iterdir()}
    assert len(kept) == 3 and (tmp_path / "tries_1").read_text() == "xx"
    (tmp_path / "mended").touch()
    table = run()
    assert table["seed"].tolist() == [0, 1, 2, 3] and os.getpid() not in table["process"].tolist()
    assert {path: path.read_text() for path in kept} == kept
    assert len(list((tmp_path / "out" / "parts").iterdir())) == 4


def test_parts_of_a_program_are_those_of_its_module(monkeypatch):
    program = ModuleType("__main__")
    program.__spec__ = find_spec("benchmarks.calibrators")
    monkeypatch.setitem(sys.modules, "__main__", program)
    copy = FunctionType(calibrators.part.__code__, {}, "part")
    copy.__module__ = "__main__"
    assert study.importable(copy) is calibrators.part and study.importable(part) is part


def test_a_scheduler_that_is_not_there_is_an_error_of_the_command_line(tmp_path, capsys):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    with pytest.raises(SystemExit):
        a_study(tmp_path, "--scheduler", "nonsense")
    assert "no Dask scheduler at 'nonsense'" in capsys.readouterr().err


def test_files_say_what_made_them(tmp_path, capsys):
    chosen = a_study(tmp_path, "--seeds", "4", "5")
    chosen.write({"example": pd.DataFrame({"value": [1.0 / 3.0]})}, {}, "text\n")
    assert (tmp_path / "example.csv").read_text() == "value\n0.333333\n"
    record = json.loads((tmp_path / "example.json").read_text())
    assert record["command"].startswith("python -m benchmarks.example --seeds 4 5 ")
    assert record["configuration"] == {"seeds": [4, 5]} and {"torch", "sb3_lac"} <= set(record["versions"])
    assert (tmp_path / "example.md").read_text() in capsys.readouterr().out


def test_a_large_table_is_packed_with_equal_bytes_for_equal_text_and_takes_the_place_of_the_plain_one(tmp_path):
    tables = [pd.DataFrame({"value": np.arange(float(rows))}) for rows in (3, 30_000)]
    for table in tables:
        study.write_csv(tmp_path, "example", table.to_csv(index=False))
        pd.testing.assert_frame_equal(study.read_tables(tmp_path)["example"], table)
    (file,) = tmp_path.iterdir()
    assert file.name == "example.csv.gz" and file == study.table_file(tmp_path, "example")
    packed = file.read_bytes()
    study.write_csv(tmp_path, "example", tables[1].to_csv(index=False))
    assert file.read_bytes() == packed and packed[4:8] == bytes(4)  # no time of writing
    study.write_csv(tmp_path, "example", tables[0].to_csv(index=False))
    assert [path.name for path in tmp_path.iterdir()] == ["example.csv"]


def test_numbers_read_well():
    values = [0.123, 1.26, 9.96, 99.4, 99.6, 12345.6, -0.00123, float("nan"), float("inf")]
    assert [digits(value) for value in values] == ["0.12", "1.3", "10", "99", "100", "12346", "-0.0012", "-", "never"]
    assert digits(123.4, 3) == "123" and digits(11.0, 1) == "11"
    assert with_spread(pd.Series([1.0, 2.0])) == "1.5 ± 0.7" and with_spread(pd.Series([2.0])) == "2"
