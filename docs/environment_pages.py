"""
Write what the documentation takes from the code: the page of each environment without a battery, docs/environments/ID.md, from
the docstring of its class, and in other pages the tables of environments, data sets and estimators.

.. code-block:: bash

  python -m docs.environment_pages

The rest of these pages is written by hand. What is not stands between ``<!-- begin NAME -->`` and ``<!-- end NAME -->``.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

import battery_env.estimators
import sb3_lac
from battery_env.estimators import Estimator, OnlineEstimator
from battery_env.files import replacing
from battery_env.loads import constant
from battery_env.tasks.data import standard_dataset
from battery_env.tasks.env import CalibrationEnv, task_class
from battery_env.tasks.full_state.full_state_task import FullStateTask
from battery_env.tasks.registration import TASKS
from battery_env.trajectories import TrajectoryDataset
from docs.environment_pictures import EPISODES

DOCS = Path(__file__).parent

#: All environments that this project brings.
IDS = [
    env_id
    for env_id, spec in gym.registry.items()
    if str(spec.entry_point).startswith((f"{battery_env.__name__}.", f"{sb3_lac.__name__}."))
]
#: Those without a battery.
CONTROL_IDS = [env_id for env_id in IDS if env_id not in TASKS]


def page_of(env_id: str) -> str:
    """The page of an environment; tasks with the full state share one."""
    is_of_full_state = env_id in TASKS and issubclass(task_class(TASKS[env_id]), FullStateTask)
    return "BatteryQmax-v0" if is_of_full_state else env_id


def environment_page(env_id: str) -> str:
    """The page of an environment without a battery, with links to the pages of the others that it names."""
    page = inspect.getdoc(load_env_creator(str(gym.spec(env_id).entry_point))) or ""
    path, end = f"../pictures/{env_id}", "The end of the same episode of the reference controller, as `render()` draws it."
    picture = f"![{env_id} in motion]({path}.gif)\n\n*{EPISODES[env_id].caption}*\n\n"
    picture += f"![States and costs of {env_id}]({path}.png)\n\n*{end}*\n\n"
    made = f'Create this environment with `gym.make("sb3_lac:{env_id}")`; no import of `sb3_lac` is needed.\n\n'
    return f"# {env_id}\n\n{made}{picture}" + re.sub(rf"``((?!{env_id}\b)\w+-v\d+)``", r"[`\1`](\1.md)", page) + "\n"


def ids() -> str:
    """All environments in one table."""
    # spaces and episodes do not depend on the discharges; these are quickly made
    dataset = TrajectoryDataset.generate(("q_mobile", "r_o"), 4, [constant(8.0)], seed=0)
    rows = []
    for env_id in TASKS:
        task = CalibrationEnv(TASKS[env_id], dataset=dataset).task
        rows.append(
            {
                "id": f"[`{env_id}`](environments/{page_of(env_id)}.md)",
                "measured": "the full state" if isinstance(task, FullStateTask) else "current and voltage",
                "to be found": " and ".join(f"`{name}`" for name in task.parameters),
                "numbers in an observation": task.observation_size,
                "in an action": len(task.parameters),
                "decisions in an episode": task.episode_steps,
            }
        )
    return _markdown(rows)


def data_sets() -> str:
    """The standard data sets."""
    (table,) = tables_of(standard_dataset)
    return _markdown([dict(zip(table[0], row, strict=True)) for row in table[1:]])


def estimators() -> str:
    """All calibrators that need no learning in one table."""
    rows = []
    for _, calibrator in sorted(vars(battery_env.estimators).items()):
        if not (inspect.isclass(calibrator) and issubclass(calibrator, Estimator)) or inspect.isabstract(calibrator):
            continue
        # full states are what simulated discharges have and records in general have not
        needs_state = inspect.signature(calibrator.estimate).parameters["record"].annotation == "Trajectory"
        summary = " ".join((inspect.getdoc(calibrator) or "").split("\n\n")[0].split())
        rows.append(
            {
                "class": f"`{calibrator.__name__}`",
                "estimate": re.split(r"(?<=[a-z)])\. ", summary)[0].rstrip("."),
                "needs": "the full state" if needs_state else "current and voltage",
                "sample by sample": "yes, `update`" if issubclass(calibrator, OnlineEstimator) else "",
            }
        )
    return _markdown(rows)


#: What is not written by hand, by page.
PARTS: dict[str, dict[str, Callable[[], str]]] = {
    "battery_env": {"ids": ids, "data sets": data_sets},
    "compare_calibrators": {"estimators": estimators},
}


def _markdown(rows: Sequence[Mapping[str, object]]) -> str:
    names = list(rows[0])
    lines = [names, ["---"] * len(names), *([str(row[name]) for name in names] for row in rows)]
    # a bar within a cell would end it
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines)


def tables_of(documented: Callable[..., object]) -> list[list[list[str]]]:
    """The tables of a docstring, in reStructuredText's simple form."""
    tables: list[list[list[str]]] = []
    columns_of_text: list[slice] = []  # of the table that the present line belongs to, if any
    for line in (inspect.getdoc(documented) or "").splitlines():
        if re.fullmatch(r"=+( +=+)+", line):
            if not columns_of_text:
                tables.append([])
            starts = [match.start() for match in re.finditer("=+", line)]
            columns_of_text = [slice(*ends) for ends in zip(starts, [*starts[1:], None], strict=True)]
        elif not line.strip():
            columns_of_text = []
        elif columns_of_text:
            rows, row = tables[-1], [line[part].strip() for part in columns_of_text]
            if rows and (not row[0] or rows[-1][0].endswith(",")):
                rows[-1] = [" ".join(filter(None, cells)) for cells in zip(rows[-1], row, strict=True)]
            else:
                rows.append(row)
    return tables


def render(name_of_page: str, page: str) -> str:
    """The text of a page with its parts as the code has them now."""
    for name, write in PARTS[name_of_page].items():
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        if page.count(begin) != 1 or page.count(end) != 1:
            raise ValueError(f"the page must have {begin} and {end}, once each")
        before, rest = page.split(begin)
        page = f"{before}{begin}\n\n{write()}\n\n{end}{rest.split(end)[1]}"
    return page


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=Path, default=DOCS)
    docs = parser.parse_args(arguments).docs
    pages = {docs / "environments" / f"{env_id}.md": environment_page(env_id) for env_id in CONTROL_IDS}
    pages |= {docs / f"{name}.md": render(name, (docs / f"{name}.md").read_text(encoding="utf-8")) for name in PARTS}
    for page, text in pages.items():
        with replacing(page) as part:
            part.write_text(text, encoding="utf-8")
        sys.stdout.write(f"{page}\n")


if __name__ == "__main__":
    main()
