"""The pages of the environments: what they take from the code is what the code says now."""

import ast
import re

import gymnasium as gym
import pytest

from battery_env import ClosedForm, TrajectoryDataset, evaluate, plotting
from battery_env.loads import constant
from battery_env.tasks.env import CalibrationEnv, task_class
from battery_env.tasks.full_state.full_state_task import BatteryQmax
from battery_env.tasks.registration import TASKS
from benchmarks.control import DISTURBANCES
from docs import environment_pages

TEXTS = {name: (environment_pages.DOCS / f"{name}.md").read_text(encoding="utf-8") for name in environment_pages.PARTS}
PAGES = {path.stem: path.read_text(encoding="utf-8") for path in (environment_pages.DOCS / "environments").glob("*.md")}


def first_cells(page, section):
    """The first column of the tables of one section, without its code marks."""
    part = re.search(rf"^#+ {section}\n(.*?)(?=^#)", TEXTS[page] + "\n#", flags=re.MULTILINE | re.DOTALL)[1]
    cells = [line.split("|")[1].strip() for line in part.splitlines() if re.match(r"\| `", line)]
    return [name for cell in cells for name in re.findall(r"`+(.*?)`+", cell)]


@pytest.fixture(scope="module")
def dataset():
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 20, [constant(8.0)], seed=0)


def test_the_pages_say_what_the_code_says():
    for name, text in TEXTS.items():
        assert environment_pages.render(name, text) == text, "run python -m docs.environment_pages"
    for env_id in environment_pages.CONTROL_IDS:
        assert PAGES[env_id] == environment_pages.environment_page(env_id)


def test_the_tables_of_physical_parameters_are_those_of_the_classes():
    for env_id in environment_pages.CONTROL_IDS:
        env = gym.make(env_id).unwrapped
        table = type(env).__doc__.split("## Arguments")[1].split("##")[0]
        written = {
            name: float(default) for name, default in re.findall(r"^ +\| `(\w+)` \| ([\d.]+) \|", table, flags=re.MULTILINE)
        }
        noise = {name: getattr(env, name) for name in written.keys() & {"noise_std"}}
        assert written == {**env.nominal_parameters, **noise}, env_id


def test_every_environment_has_a_page():
    assert {*TASKS, *DISTURBANCES} == set(environment_pages.IDS)
    assert {environment_pages.page_of(env_id) for env_id in environment_pages.IDS} == set(PAGES)


def test_every_task_has_all_sections_on_its_page_and_a_link_to_it():
    wanted = ["Description", "Observation space", "Action space", "Reward", "Starting state", "Episode end", "Arguments"]
    for env_id in TASKS:
        page = environment_pages.page_of(env_id)
        headings = re.findall(r"^## (.*)", PAGES[page], flags=re.MULTILINE)
        assert [heading for heading in headings if heading in wanted] == wanted, env_id
        assert env_id in PAGES[page] and f"[`{env_id}`](environments/{page}.md)" in TEXTS["battery_env"]


def test_boxes_in_the_pages_are_the_spaces(dataset):
    for env_id in TASKS:
        env, page = CalibrationEnv(TASKS[env_id], dataset=dataset), PAGES[environment_pages.page_of(env_id)]
        boxes = re.findall(r"Box\(-?\d+, \d+, \((\d+),\), float32\)", page)
        rows = re.findall(rf"^\| `{env_id}` \| \((\d+),\) \| \((\d+),\) \|", page, flags=re.MULTILINE)
        assert [*(rows[0] if rows else boxes)] == [str(each.shape[0]) for each in (env.observation_space, env.action_space)]


def test_the_table_of_arguments_is_that_of_the_options():
    # what the class decides
    decided = {"episode_steps": BatteryQmax.episode_steps}
    for env_id in ("BatteryQmax-v0", "BatteryVoltageJoint-v0"):
        rows = re.findall(r"^\| ``(\w+)`` \| (.*?) \|", PAGES[env_id], flags=re.MULTILINE)
        written = {name: None if default == "none" else ast.literal_eval(default.strip("`")) for name, default in rows}
        expected = {
            name: decided[name] if default is None and name in decided else default
            for name, default in task_class(TASKS[env_id]).options().items()
        }
        assert written == {**expected, "render_mode": None}, env_id


def test_common_options_are_options_of_all(dataset):
    names = first_cells("battery_env", "Common options")
    options = {"split": "test", "render_mode": "rgb_array", "episode_steps": 4}
    assert set(names) == {*options, "dataset"}
    for env_id in TASKS:
        for name, value in options.items():
            try:
                CalibrationEnv(TASKS[env_id], dataset=dataset, **{name: value})
            except ValueError as error:
                # known, but not beside a data set of one's own
                assert "dataset stands in place of" in str(error), (env_id, name)


def test_columns_of_the_evaluation_are_those_that_its_docstring_names(dataset):
    cells = [cell for table in environment_pages.tables_of(evaluate) for cell, _ in table]
    names = {name for cell in cells for name in re.findall(r"`+(.*?)`+", cell)}
    shown = {name.replace("p_", f"{p}_", 1) if name.startswith("p_") else name for name in names for p in ("q_mobile", "r_o")}
    shown |= {p if name == "p" else name for name in names for p in ("q_mobile", "r_o")}
    shown |= {name.replace("25", share) for name in names for share in ("50", "75") if "at_25" in name}
    assert set(evaluate(ClosedForm(), dataset[:1]).columns) - {"trajectory"} <= shown


def test_all_plots_are_in_the_reference():
    listed = re.findall(r"battery_env\.plotting\.(plot_\w+)", (environment_pages.DOCS / "api.md").read_text(encoding="utf-8"))
    assert {name for name in vars(plotting) if name.startswith("plot_")} == set(listed)


def test_only_what_stands_between_markers_is_written(tmp_path, capsys):
    for name, text in TEXTS.items():
        stale = re.sub(r"(<!-- begin (\w[\w ]*) -->).*?(<!-- end \2 -->)", r"\1 old \3", text, flags=re.DOTALL)
        assert stale != text
        (tmp_path / f"{name}.md").write_text(stale, encoding="utf-8")
    (tmp_path / "environments").mkdir()
    environment_pages.main(["--docs", str(tmp_path)])
    assert {name: (tmp_path / f"{name}.md").read_text(encoding="utf-8") for name in TEXTS} == TEXTS
    assert str(tmp_path / "battery_env.md") in capsys.readouterr().out
    assert len(list((tmp_path / "environments").iterdir())) == len(environment_pages.CONTROL_IDS)


def test_a_page_without_its_markers_is_refused():
    with pytest.raises(ValueError, match="begin ids"):
        environment_pages.render("battery_env", TEXTS["battery_env"].replace("<!-- begin ids -->", ""))
