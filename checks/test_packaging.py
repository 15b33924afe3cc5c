"""What the files of the two distributions say agrees."""

import configparser
import re

import gymnasium as gym
import yaml

import sb3_lac  # noqa: F401  (registers all environments)
from checks.pages import ROOT


def read(file):
    config = configparser.ConfigParser()
    config.read(ROOT / file, encoding="utf-8")
    return config


DISTRIBUTIONS = ("battery_env/setup.cfg", "setup.cfg")


def test_logging_and_progress_bars_need_no_extra():
    required = read("setup.cfg")["options"]["install_requires"]
    assert all(f"\n{name}>=" in required for name in ("tensorboard", "tqdm", "rich"))


def test_both_distributions_ask_for_the_same_versions():
    requirements = [
        {re.split("[><=]", line)[0]: line for line in read(file)["options"]["install_requires"].split() if line[0].isalpha()}
        for file in DISTRIBUTIONS
    ]
    shared = set.intersection(*map(set, requirements))
    assert "gymnasium" in shared and all(requirements[0][name] == requirements[1][name] for name in shared)
    assert read("battery_env/setup.cfg")["options"]["python_requires"] == read("setup.cfg")["options"]["python_requires"]


def test_versions_agree():
    assert (ROOT / "sb3_lac/version.txt").read_text() == (ROOT / "battery_env/version.txt").read_text()
    version = (ROOT / "sb3_lac/version.txt").read_text().strip()
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    release = version.partition(".dev")[0]
    dates = dict(re.findall(r"^## (\S+) \((.*)\)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE))
    # what is released has a date, in the changelog and in the citation
    assert (version == release) == (dates[release] != "unreleased")
    # what has changed since then may stand above it
    above = list(dates.values())[: list(dates).index(release)]
    assert above in ([], ["unreleased"])
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    cited = [each for page in pages for each in re.findall(r"version\s*= \{(.*)\}", page.read_text(encoding="utf-8"))]
    assert cited and set(cited) <= {release, version}


def test_every_environment_has_tuned_hyperparameters():
    packages = ("battery_env.", "sb3_lac.envs.")
    ids = {env_id for env_id, spec in gym.registry.items() if str(spec.entry_point).startswith(packages)}
    for algo in ("lac", "sac", "td3"):
        config = yaml.safe_load((ROOT / "zoo_configs" / f"{algo}.yml").read_text(encoding="utf-8"))
        assert ids and ids | {"default"} <= set(config), algo
