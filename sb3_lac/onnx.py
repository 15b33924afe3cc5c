"""Policies of Stable-Baselines3 as ONNX files, which run without torch."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_normalize
from torch.distributions import Distribution, Normal

from sb3_lac.files import replacing
from sb3_lac.vec_env import env_specs, in_processes, wrappers_of

if TYPE_CHECKING:
    from onnx import ModelProto

# Where methods of wrappers are defined that hand on observations and actions as they are, or whose work is part of the file
_HANDING_ON = (
    *(
        "gymnasium.core.Wrapper.",
        "gymnasium.core.RewardWrapper.",
        "rl_zoo3.gym_patches.",  # of the time limit
        "sb3_lac.envs.randomisation.",
        "stable_baselines3.common.monitor.",
    ),
    *("gymnasium.vector.vector_env.VectorWrapper.", "gymnasium.vector.vector_env.VectorRewardWrapper."),
    *(f"gymnasium.wrappers.{name}." for name in ("common", "rendering", "stateful_reward")),
    *(f"gymnasium.wrappers.vector.{name}." for name in ("common", "rendering", "stateful_reward", "array_conversion")),
    *(f"stable_baselines3.common.vec_env.vec_{name}." for name in ("check_nan", "monitor", "normalize", "transpose")),
    *("stable_baselines3.common.vec_env.vec_video_recorder.", "stable_baselines3.common.vec_env.base_vec_env."),
)
# And those that hand on one of the two
_HANDING_ON_ACTIONS = "gymnasium.core.ObservationWrapper.", "gymnasium.vector.vector_env.VectorObservationWrapper."
_HANDING_ON_OBSERVATIONS = "gymnasium.core.ActionWrapper.", "gymnasium.vector.vector_env.VectorActionWrapper."
#: What torch and onnxruntime may differ by in any action of the check, relative to the range of the actions
TOLERANCE = 1e-5
_N_CHECKED = 64
_N_TRACED = 2
_FAR = 1e6


class DeterministicPolicy(th.nn.Module):
    """
    ``predict(observation, deterministic=True)`` as one graph of tensors, from observations of the environment to its actions;
    of several policies it has the mean.
    """

    policies: Sequence[BasePolicy]
    low: th.Tensor
    high: th.Tensor
    mean: th.Tensor
    rest_of_mean: th.Tensor
    deviation: th.Tensor

    def __init__(self, policies: Sequence[BasePolicy], vec_normalize: VecNormalize | None = None) -> None:
        super().__init__()
        action_space = policies[0].action_space
        assert isinstance(action_space, spaces.Box)
        self.policies = th.nn.ModuleList(policies)  # type: ignore[assignment]
        self.register_buffer("low", th.as_tensor(action_space.low, dtype=th.float32))
        self.register_buffer("high", th.as_tensor(action_space.high, dtype=th.float32))
        self.clip_obs: float | None = None
        if vec_normalize is not None:
            assert isinstance(vec_normalize.obs_rms, RunningMeanStd)  # of a Box
            self.clip_obs = vec_normalize.clip_obs
            mean = th.as_tensor(vec_normalize.obs_rms.mean, dtype=th.float64)
            self.register_buffer("mean", mean.float())
            # ``VecNormalize`` subtracts in double precision, which matters where the mean is far larger than the deviation
            self.register_buffer("rest_of_mean", (mean - mean.float()).float())
            variance = vec_normalize.obs_rms.var + vec_normalize.epsilon
            self.register_buffer("deviation", th.as_tensor(np.sqrt(variance), dtype=th.float32))
        self.to(policies[0].device)

    def forward(self, observation: th.Tensor) -> th.Tensor:
        """Compute actions of the environment from its observations."""
        if self.clip_obs is not None:
            observation = (observation - self.mean - self.rest_of_mean) / self.deviation
            observation = observation.clamp(-self.clip_obs, self.clip_obs)
        actions = []
        for policy in self.policies:
            action = policy._predict(observation, deterministic=True).reshape(-1, *self.low.shape)
            if policy.squash_output:
                action = self.low + 0.5 * (action + 1.0) * (self.high - self.low)
            actions.append(action.clamp(self.low, self.high))
        return th.stack(actions).mean(dim=0)


def export_onnx(
    model: BaseAlgorithm | BasePolicy | Sequence[BaseAlgorithm],
    path: str | Path,
    env_id: str | None = None,
    vec_normalize: VecNormalize | None = None,
) -> Path:
    """
    Write the deterministic policy of a model as an ONNX file, which runs without torch and without pickle.

    .. code-block:: python

      from sb3_lac import LAC
      from sb3_lac.onnx import export_onnx

      model = LAC("MlpPolicy", "LinearCost-v0").learn(5_000)
      export_onnx(model, "policy.onnx")

    The input is ``observation`` and the output ``action``, both float32. The file includes the normalization of the
    observations by ``VecNormalize`` and the scaling of the actions. Images are those of the policy, with the channels first.
    The file does not include other wrappers of observations and actions. A warning and the metadata name these wrappers; input
    and output are then ``observation_of_NormalizeObservation`` or ``action_of_RescaleAction``, and the file names no
    environment. onnxruntime checks the file before it takes its name. The file ends with a checksum for ``OnnxPolicy`` of
    battery_env. Needs the extra ``sb3_lac[onnx]``.

    :param model: LAC, SAC, TD3, TQC, PPO, ... or a policy; or several models, of several seeds: the file has the mean of their
        actions
    :param path: Path of the file; a missing ``.onnx`` is added. An earlier file of this function is replaced.
    :param env_id: Id of the environment that the policy is for, kept in the file; by default that of the model's environment,
        where it is known
    :param vec_normalize: Normalization of the observations; by default the wrapper of the model's environment, if any. Without
        an environment, as for a policy or a model loaded without one, a warning says so.
    :return: Path of the file
    :raises ValueError: If the spaces are not ``Box``, if the policy is recurrent, if the file differs from the policy or takes
        only one batch size, or for models of several spaces
    :raises FileExistsError: If there is another file
    :raises ImportError: Without the extra
    """
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401  (torch's exporter needs it)
    except ImportError as missing:
        raise ImportError(f"{missing}: export_onnx needs pip install 'sb3_lac[onnx]'.") from missing

    path = Path(path)
    if path.suffix != ".onnx":
        path = path.with_name(path.name + ".onnx")
    if path.exists() and not _is_ours(path):
        raise FileExistsError(f"{path} exists, and is not of export_onnx: move it away, or give another path.")
    models = list(model) if isinstance(model, Sequence) else [model]
    policies = [each if isinstance(each, BasePolicy) else each.policy for each in models]
    model, policy = models[0], policies[0]
    for member in policies[1:]:
        if (member.observation_space, member.action_space) != (policy.observation_space, policy.action_space):
            raise ValueError("The models must have the same spaces of observations and actions.")
    for name, space in (("observation", policy.observation_space), ("action", policy.action_space)):
        if not isinstance(space, spaces.Box):
            raise ValueError(f"The {name} space {space} must be a Box: other spaces have no ONNX export.")
    if "lstm_states" in inspect.signature(policy.forward).parameters:
        raise ValueError(f"{type(policy).__name__} has a memory: only policies of the observation alone have an ONNX export.")
    env = model.env if isinstance(model, BaseAlgorithm) else None
    description, names = {"algorithm": type(model).__name__}, ["observation", "action"]
    if env is not None:
        vec_normalize = vec_normalize or unwrap_vec_normalize(env)
        wrapped = [wrapper for wrapper in wrappers_of(env) if not _hands_on(wrapper, _HANDING_ON)]
        left_out = ", ".join(type(wrapper).__name__ for wrapper in wrapped)
        if wrapped:
            description["wrappers"] = left_out
            names = [_name("observation", wrapped, _HANDING_ON_OBSERVATIONS), _name("action", wrapped, _HANDING_ON_ACTIONS)]
        else:
            env_id = env_id or getattr(env_specs(env)[0], "id", None)
            left_out = "those in its processes, if there are any" if in_processes(env) else ""
        if left_out:
            warnings.warn(
                f"The file leaves out what wrappers of the environment do: {left_out}. Its input is {names[0]} and its output "
                f"{names[1]}. Apply them around it, or train with VecNormalize, which becomes part of the file, and with the "
                "actions of the plant.",
                stacklevel=2,
            )
    elif vec_normalize is None:
        warnings.warn(
            f"{type(model).__name__} has no environment that says whether observations were normalized, and is exported "
            "without. If they were, pass vec_normalize=VecNormalize.load(...), or load the model with its environment.",
            stacklevel=2,
        )
    if env_id is not None:
        description["env_id"] = env_id
    content = _checked_file(policies, vec_normalize, description, names)
    with replacing(path) as part:
        part.write_bytes(content)
    return path


def _hands_on(wrapper: Any, places: tuple[str, ...]) -> bool:
    """Tell whether all methods of a wrapper that observations and actions go through are defined in some of these places."""
    names = ("reset", "step", "step_async", "step_wait")
    methods = [getattr(type(wrapper), name) for name in names if hasattr(type(wrapper), name)]
    return all(f"{method.__module__}.{method.__qualname__}".startswith(places) for method in methods)


def _name(name: str, wrapped: Sequence[Any], places: tuple[str, ...]) -> str:
    """The name of an input or output, which is that of the outermost wrapper that changes it."""
    changing = [wrapper for wrapper in wrapped if not _hands_on(wrapper, _HANDING_ON + places)]
    return f"{name}_of_{type(changing[0]).__name__}" if changing else name


def _is_ours(path: Path) -> bool:
    """Tell from the metadata of a file whether this package has written it."""
    import onnx

    try:
        return "sb3_lac" in {entry.key for entry in onnx.load(path, load_external_data=False).metadata_props}
    except Exception:  # protobuf has one for each kind of damage
        return False


def _checked_file(
    policies: Sequence[BasePolicy], vec_normalize: VecNormalize | None, description: dict[str, str], names: Sequence[str]
) -> bytes:
    """Return the content of a file that does what the policies do, in the mean."""
    import onnxruntime

    policy = policies[0]
    if vec_normalize is not None and not vec_normalize.norm_obs:
        vec_normalize = None
    if vec_normalize is not None and vec_normalize.observation_space.shape != policy.observation_space.shape:
        raise ValueError(
            f"VecNormalize normalizes observations of shape {vec_normalize.observation_space.shape}, and those of the policy "
            f"have {policy.observation_space.shape}: a wrapper around it, like VecFrameStack, has no ONNX export."
        )
    was_training = [each.training for each in policies]
    for each in policies:
        each.set_training_mode(False)
    try:
        module = DeterministicPolicy(policies, vec_normalize).eval()
        observations = observations_to_check(policy.observation_space, vec_normalize)
        inputs = observations if vec_normalize is None else vec_normalize.normalize_obs(observations)
        expected = np.mean([each.predict(inputs, deterministic=True)[0] for each in policies], axis=0)
        content = with_checksum(graph_of(module, observations[:_N_TRACED], description, names).SerializeToString())
    finally:
        for each, mode in zip(policies, was_training, strict=True):
            each.set_training_mode(mode)
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    ranges = (module.high - module.low).cpu().numpy()
    for rows in (_N_CHECKED, 1):
        try:
            (action,) = session.run(None, {names[0]: observations[:rows]})
        except Exception as error:  # onnxruntime has one for each of its codes
            raise ValueError(
                f"The exported policy was traced with {_N_TRACED} observations and does not take {rows}. Where a network has "
                f"the size of the batch as len(x), write x.shape[0], which a graph can leave open. onnxruntime says: {error}"
            ) from error
        difference = float(np.max(np.abs(action - expected[:rows]) / np.where(ranges > 0, ranges, 1.0)))
        if not difference <= TOLERANCE:
            raise ValueError(f"The exported policy differs from the original by {difference:g} of the range of its actions.")
    return content


def observations_to_check(space: spaces.Space, vec_normalize: VecNormalize | None) -> np.ndarray:
    """Draw observations that fill the space, or what ``VecNormalize`` has seen."""
    assert isinstance(space, spaces.Box)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if vec_normalize is None:
        # Bounds like 3e38 are none: no observation comes near
        nearest = np.clip(0.0, low, high)
        low, high = np.where(low < -_FAR, nearest - 10.0, low), np.where(high > _FAR, nearest + 10.0, high)
    else:
        assert isinstance(vec_normalize.obs_rms, RunningMeanStd)  # of a Box
        mean, spread = vec_normalize.obs_rms.mean, 3.0 * np.sqrt(vec_normalize.obs_rms.var)
        low, high = np.maximum(low, mean - spread), np.minimum(high, mean + spread)
    rng = np.random.default_rng(0)
    return rng.uniform(low, np.maximum(low, high), (_N_CHECKED, *space.shape)).astype(np.float32)


@contextmanager
def _unchecked_distributions() -> Iterator[None]:
    """Let distributions take any arguments: checks depend on values, which a graph does not know."""
    try:
        Normal(0.0, -1.0)
        checked = False
    except ValueError:
        checked = True
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(checked)


def with_checksum(content: bytes) -> bytes:
    """Append the entry ``sha256`` of the metadata: messages of protobuf one behind the other are one message."""
    from onnx import ModelProto, StringStringEntryProto

    entry = StringStringEntryProto(key="sha256", value=sha256(content).hexdigest())
    return content + ModelProto(metadata_props=[entry]).SerializeToString()


def graph_of(
    module: DeterministicPolicy, observations: np.ndarray, description: dict[str, str], names: Sequence[str]
) -> ModelProto:
    """Export a module, with names of its input and its output, and describe it."""
    import onnx

    import sb3_lac

    with _unchecked_distributions(), th.no_grad():
        program = th.onnx.export(
            module,
            (th.as_tensor(observations, device=module.low.device),),
            input_names=[names[0]],
            output_names=[names[1]],
            dynamic_shapes=({0: th.export.Dim("n")},),
            # That of the exporter's own operators: a newer one is converted to, and needs a newer onnxruntime
            opset_version=18,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    graph = program.model_proto
    # Where the code lies on this machine, for whoever gets the file
    for part in (graph.graph, *graph.graph.node, *(node for function in graph.functions for node in function.node)):
        part.ClearField("metadata_props")
    # The oldest that knows the operators: an older onnxruntime loads the file
    graph.ir_version = onnx.helper.find_min_ir_version_for(graph.opset_import, ignore_unknown=True)
    onnx.helper.set_model_props(graph, {**description, "sb3_lac": sb3_lac.__version__})
    return graph
