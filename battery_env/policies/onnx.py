"""A trained policy from a file, without the package that it was trained with."""

from __future__ import annotations

import json
import re
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

# An entry ``sha256`` of the metadata at the very end of a file, that of all before it: its tag in the format of protobuf, its
# length, its name, its value.
_CHECKSUM = re.compile(rb"\x72\x4a\x0a\x06sha256\x12\x40([0-9a-f]{64})\Z")


class OnnxPolicy:
    """
    A policy as a graph of tensors, run by onnxruntime on one thread: no torch, and no pickle. ``PolicyEstimator`` takes it
    like any other policy.

    .. code-block:: python

      policy = OnnxPolicy("voltage_joint.onnx")
      estimator = PolicyEstimator(policy, policy.env_id)

    ``sb3_lac.onnx.export_onnx`` writes such files, of any algorithm of Stable-Baselines3, with a checksum, which is compared,
    as is ``sha256`` of the card of a policy, a JSON file of the same name beside it.
    Needs the extra ``battery_env[onnx]``.

    :param path: an ONNX file with one float32 input of shape (n, ...) and one output of actions of shape (n, ...)
    :raises FileNotFoundError: if there is no such file
    :raises ImportError: without the extra
    :raises ValueError: if it is no ONNX file, is damaged, or has other inputs and outputs
    """

    def __init__(self, path: str | Path) -> None:
        # not a dependency of the package
        try:
            from onnxruntime import InferenceSession, SessionOptions
        except ImportError as error:
            raise ImportError(f"{error}: OnnxPolicy needs pip install './battery_env[onnx]'") from error

        path = Path(path)
        options = SessionOptions()
        options.intra_op_num_threads = 1
        content = path.read_bytes()
        checksum = _CHECKSUM.search(content[-128:])
        if checksum and checksum[1].decode() != sha256(content[: -len(checksum[0])]).hexdigest():
            raise ValueError(f"{path} is damaged: its checksum is wrong")
        #: Of the file, which no other policy has
        self.sha256: str = sha256(content).hexdigest()
        card = path.with_suffix(".json")
        if self.sha256 != _stated_sha256(card, self.sha256):
            raise ValueError(f"{path} is damaged, or not the policy that {card} is of: its sha256 is {self.sha256}")
        try:
            self._session = InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises whatever the damage leads it to
            raise ValueError(f"{path} is no ONNX file: {error}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1:
            raise ValueError(f"{path} must have one input and one output, it has {len(inputs)} and {len(outputs)}")
        self._input = inputs[0].name
        #: What the file says of itself, e.g. ``algorithm`` and ``env_id``
        self.description: dict[str, str] = self._session.get_modelmeta().custom_metadata_map
        #: Shape of one observation
        self.observation_shape: tuple[int, ...] = tuple(inputs[0].shape[1:])

    @property
    def env_id(self) -> str:
        """Id of the environment that the policy was trained on; an error if the file does not say it."""
        try:
            return self.description["env_id"]
        except KeyError:
            raise ValueError("The file does not say which environment its policy is for: state the id yourself.") from None

    def predict(self, observation: Any, /, *, deterministic: bool = True) -> tuple[np.ndarray, None]:
        """
        Actions for a batch of observations.

        :param observation: shape (n, ...)
        :param deterministic: must be true, as the file holds no distribution
        :return: actions, shape (n, ...), and no state
        :raises ValueError: for observations of another shape, or if a sample is asked for
        """
        if not deterministic:
            raise ValueError("deterministic must be True: an ONNX file holds the deterministic policy only")
        observation = np.asarray(observation, dtype=np.float32)
        if observation.shape[1:] != self.observation_shape:
            shape = ", ".join(map(str, self.observation_shape))
            raise ValueError(f"observation must have shape (n, {shape}), got {observation.shape}")
        (action,) = self._session.run(None, {self._input: observation})
        return action, None


def _stated_sha256(card: Path, otherwise: str) -> str:
    """The digest of a policy by its card, if it has one that says it."""
    try:
        stated = json.loads(card.read_text(encoding="utf-8"))["sha256"]
    except (OSError, ValueError, TypeError, LookupError):  # there is none, or a file that has to do with something else
        return otherwise
    return str(stated)
