"""The trained policies that come with the package."""

from __future__ import annotations

import json
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from battery_env.electrochemistry import CellParameters
from battery_env.electrochemistry.aging_path import AgingPath
from battery_env.policies.onnx import OnnxPolicy

_PACKAGE = "battery_env.policies.pretrained_policies"
_RECORDED = "_recorded"


def pretrained_ids() -> tuple[str, ...]:
    """Which environments a policy comes with the package for."""
    names = (entry.name for entry in files(_PACKAGE).iterdir() if entry.name.endswith(".onnx"))
    return tuple(sorted({name.removesuffix(".onnx").removesuffix(_RECORDED) for name in names}))


def file_stem(env_id: str, recorded: bool) -> str:
    """What the files of a policy are called."""
    return env_id + (_RECORDED if recorded else "")


def pretrained_card(env_id: str, recorded: bool = False) -> dict[str, Any]:
    """
    What made a policy, and what it is worth: ``command``, ``recipe`` (seed, hyperparameters, data), ``options`` (of the task,
    which it needs when it is used), ``scores`` and ``versions``.

    :param env_id: id of an environment
    :param recorded: as of :func:`pretrained_policy`
    :return: the JSON file beside the policy
    :raises ValueError: if none comes with the package
    """
    _check(env_id)
    card: dict[str, Any] = json.loads(
        files(_PACKAGE).joinpath(f"{file_stem(env_id, recorded)}.json").read_text(encoding="utf-8")
    )
    return card


def pretrained_policy(env_id: str, recorded: bool = False) -> tuple[OnnxPolicy, dict[str, Any]]:
    """A policy that comes with the package, run by onnxruntime: no torch, and no pickle."""
    _check(env_id)
    with as_file(files(_PACKAGE)) as folder:
        return policy_of_file(folder / f"{file_stem(env_id, recorded)}.onnx")


def policy_of_file(path: Path) -> tuple[OnnxPolicy, dict[str, Any]]:
    """
    A policy from a file, with the options of its task from ``options`` of a JSON file of the same name beside it, if there is
    one. The constants of a cell (``cell``) and a path of aging cells (``path``) are written there by name, and ``sha256`` of
    the policy, where it is known.

    :raises ValueError: if the policy is damaged, or not that of the other file
    """
    policy, card = OnnxPolicy(path), path.with_suffix(".json")
    if not card.exists():
        return policy, {}
    try:
        content = json.loads(card.read_text(encoding="utf-8"))
        options, sha256 = dict(content["options"]), content.get("sha256", policy.sha256)
        if "cell" in options:
            options["cell"] = CellParameters.of_mapping(options["cell"])
        if "path" in options:
            options["path"] = AgingPath.of_mapping(options["path"])
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{card} has to be an object in JSON with the options of the task as 'options': {error!r}") from error
    if policy.sha256 != sha256:
        raise ValueError(f"{path} is damaged, or not the policy that {card} is of: its sha256 is {policy.sha256}")
    return policy, options


def _check(env_id: str) -> None:
    if env_id not in pretrained_ids():
        raise ValueError(f"no policy for {env_id!r} comes with the package: there are {', '.join(pretrained_ids()) or 'none'}")
