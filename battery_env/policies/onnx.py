"""Trained policies in ONNX files, which need no training package."""

from __future__ import annotations

import json
import re
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

# The metadata entry ``sha256`` at the end of a file, the digest of all bytes before the entry, in the format of protobuf: tag,
# length, name, value.
_CHECKSUM = re.compile(rb"\x72\x4a\x0a\x06sha256\x12\x40([0-9a-f]{64})\Z")


class OnnxPolicy:
    """
    A policy as a graph of tensors, which onnxruntime runs on one thread, without torch or pickle. ``PolicyEstimator`` accepts
    it like any other policy.

    .. code-block:: python

      policy = OnnxPolicy("voltage_joint.onnx")
      estimator = PolicyEstimator(policy, policy.env_id)

    ``sb3_lac.onnx.export_onnx`` writes such files, of any algorithm of Stable-Baselines3, with a checksum. Loading checks this
    checksum, and the ``sha256`` of the policy's card, a JSON file of the same name.
    Needs the extra ``battery_env[onnx]``.

    :param path: an ONNX file with one float32 input of shape (n, ...) and one output of actions of shape (n, ...)
    :raises FileNotFoundError: if there is no such file
    :raises ImportError: without the extra
    :raises ValueError: if the file is no ONNX file, is damaged, or has other inputs and outputs
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
        #: Digest of the file
        self.sha256: str = sha256(content).hexdigest()
        card = path.with_suffix(".json")
        if self.sha256 != _sha256_of_card(card, self.sha256):
            raise ValueError(f"{path} is damaged, or not the policy that {card} is of: its sha256 is {self.sha256}")
        try:
            self._session = InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises errors of many types
            raise ValueError(f"{path} is no ONNX file: {error}") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1:
            raise ValueError(f"{path} must have one input and one output, it has {len(inputs)} and {len(outputs)}")
        self._input = inputs[0].name
        #: Metadata of the file, e.g. ``algorithm`` and ``env_id``
        self.description: dict[str, str] = self._session.get_modelmeta().custom_metadata_map
        #: Shape of one observation
        self.observation_shape: tuple[int, ...] = tuple(inputs[0].shape[1:])

    @property
    def env_id(self) -> str:
        """Id of the training environment; an error if the file does not have it."""
        try:
            return self.description["env_id"]
        except KeyError:
            raise ValueError("The file does not say which environment its policy is for: state the id yourself.") from None

    def predict(self, observation: Any, /, *, deterministic: bool = True) -> tuple[np.ndarray, None]:
        """
        Return the actions for a batch of observations.

        :param observation: shape (n, ...)
        :param deterministic: must be true, because the file holds no distribution
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


def _sha256_of_card(card: Path, default: str) -> str:
    """Return the digest of a policy in its card, or ``default`` without such a card."""
    try:
        sha256_of_card = json.loads(card.read_text(encoding="utf-8"))["sha256"]
    except (OSError, ValueError, TypeError, LookupError):  # no card, or a JSON file that is no card
        return default
    return str(sha256_of_card)
