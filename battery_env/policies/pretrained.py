"""The trained policies that come with the package."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from battery_env.electrochemistry.aging_path import AgingPath
from battery_env.files import replacing
from battery_env.policies.onnx import OnnxPolicy

_PACKAGE = "battery_env.policies.pretrained_policies"
_RECORDED = "_recorded"


def pretrained_ids() -> tuple[str, ...]:
    """Return the ids of the environments that have a policy in the package."""
    names = (entry.name for entry in files(_PACKAGE).iterdir() if entry.name.endswith(".onnx"))
    return tuple(sorted({name.removesuffix(".onnx").removesuffix(_RECORDED) for name in names}))


def file_stem(env_id: str, recorded: bool) -> str:
    """Return the name of the files of a policy, without their suffix."""
    return env_id + (_RECORDED if recorded else "")


def pretrained_card(env_id: str, recorded: bool = False) -> dict[str, Any]:
    """
    Return the card of a policy: ``command``, ``recipe`` (seed, hyperparameters, data), ``options`` (of the task, which every
    use of the policy needs), ``scores`` and ``versions``.

    :param env_id: id of an environment
    :param recorded: as of :func:`pretrained_policy`
    :return: the content of its JSON file
    :raises ValueError: if the package has no such policy
    """
    with _file(env_id, recorded) as file:
        return _read_card(file)


def pretrained_policy(env_id: str, recorded: bool = False) -> tuple[OnnxPolicy, dict[str, Any]]:
    """Load a policy of the package, which onnxruntime runs, without torch or pickle, and the options of its task."""
    with _file(env_id, recorded) as file:
        return policy_of_file(file)


def policy_of_file(file: Path) -> tuple[OnnxPolicy, dict[str, Any]]:
    """Load a policy from a file, and the options of its task from its card."""
    policy, options = OnnxPolicy(file), dict(_read_card(file)["options"])
    if "path" in options:
        options["path"] = AgingPath.of_mapping(options["path"])
    return policy, options


def write_card(file: Path, content: Mapping[str, Any]) -> None:
    """Write the card of a policy, a JSON file of the same name, with the checksums of both files."""
    card = {**content, "sha256": sha256(file.read_bytes()).hexdigest()}
    with replacing(file.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps({**card, "card_sha256": _digest(card)}, indent=2) + "\n", encoding="utf-8")


def _read_card(file: Path) -> dict[str, Any]:
    path = file.with_suffix(".json")
    try:
        card: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        is_intact = card.pop("card_sha256") == _digest(card)
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise ValueError(f"{path} is damaged, or no card of a policy: {error!r}") from error
    if not is_intact:
        raise ValueError(f"{path} is damaged: its checksum is wrong")
    return card


def _digest(card: Mapping[str, Any]) -> str:
    return sha256(json.dumps(card, sort_keys=True).encode()).hexdigest()


@contextmanager
def _file(env_id: str, recorded: bool) -> Iterator[Path]:
    """Return the file of a policy of the package, in one folder with its card."""
    if env_id not in pretrained_ids():
        raise ValueError(f"no policy for {env_id!r} comes with the package: there are {', '.join(pretrained_ids()) or 'none'}")
    with as_file(files(_PACKAGE)) as folder:
        yield folder / f"{file_stem(env_id, recorded)}.onnx"
