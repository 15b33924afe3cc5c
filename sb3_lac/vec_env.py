import inspect
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn


class GymnasiumVecEnv(VecEnv):
    """
    Train Stable-Baselines3 on a vector environment of Gymnasium: one call steps all environments.

    .. code-block:: python

      import gymnasium as gym
      from sb3_lac import LAC, GymnasiumVecEnv
      from stable_baselines3.common.vec_env import VecMonitor

      env = gym.make_vec("BatteryQmax-v0", num_envs=64, autoreset_mode="SameStep")
      model = LAC("MlpPolicy", VecMonitor(GymnasiumVecEnv(env))).learn(100_000)

    ``autoreset_mode`` is ``"SameStep"``, as Stable-Baselines3 expects, or ``"Disabled"``. Gymnasium's default starts a new
    episode one step late, so that the replay buffer would contain transitions from the end of an episode to the start of the
    next.

    :param env: The vector environment, wrapped or not
    :raises ValueError: If the environment starts new episodes one step late, or does not state when
    """

    actions: np.ndarray

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        self.autoreset_mode = env.metadata.get("autoreset_mode")
        if self.autoreset_mode not in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
            raise ValueError(
                f"{env} has autoreset mode {self.autoreset_mode}; Stable-Baselines3 needs AutoresetMode.SAME_STEP or "
                "DISABLED. Pass autoreset_mode='SameStep' to gymnasium.make_vec if the environment has a vector entry point, "
                "vector_kwargs={'autoreset_mode': 'SameStep'} if not."
            )
        self.env = env
        self._all = np.arange(env.num_envs)
        base = env.unwrapped
        # Gymnasium's own vector environments hold single ones; others compute all of them at once
        self._single_envs = base if isinstance(base, (gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv)) else None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        if any(options != self._options[0] for options in self._options):
            raise ValueError(
                f"A vector environment takes the same options for all its environments, not {self._options}: use make_vec_env."
            )
        observations, infos = self.env.reset(seed=self._seeds[0], options=self._options[0] or None)
        self.reset_infos = _unbatched(infos, self._all)
        # Seeds and options are only used once
        self._reset_seeds()
        self._reset_options()
        return _copied(observations)

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, terminated, truncated, batch = self.env.step(self.actions)
        rewards, terminated, truncated = _copied(rewards), _copied(terminated), _copied(truncated)
        dones = np.logical_or(terminated, truncated)
        time_limits = np.logical_and(truncated, ~terminated)
        infos = _unbatched({**batch, "TimeLimit.truncated": time_limits}, self._all)
        if dones.any():
            ended = np.flatnonzero(dones)
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                last_observations, last_infos = _copied(batch["final_obs"]), _unbatched(batch.get("final_info", {}), ended)
                started = [infos[n] for n in ended]
            else:
                last_observations, last_infos = _copied(observations), [infos[n] for n in ended]
                observations, batch = self.env.reset(options={"reset_mask": dones.copy()})
                started = _unbatched(batch, ended)
            for n, last, start in zip(ended.tolist(), last_infos, started, strict=True):
                if "episode" in start:  # of Gymnasium's RecordEpisodeStatistics
                    last["episode"] = start.pop("episode")
                self.reset_infos[n] = {key: value for key, value in start.items() if key != "TimeLimit.truncated"}
                last["TimeLimit.truncated"] = bool(time_limits[n])
                last["terminal_observation"] = _of_one(last_observations, n)
                infos[n] = last
        return _copied(observations), rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        frames: Any = self.env.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Get an attribute of the environments, or of the vector environment if it is not made of single ones."""
        chosen = self._get_indices(indices)
        if isinstance(self._single_envs, gym.vector.SyncVectorEnv):
            return [self._single_envs.envs[n].get_wrapper_attr(attr_name) for n in chosen]
        if self._single_envs is not None:
            self._check_attr(attr_name)
            values = self._single_envs.get_attr(attr_name)
        else:
            values = (getattr(self.env.unwrapped, attr_name),) * self.num_envs
        return [values[n] for n in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the environments, or of the vector environment if it is not made of single ones."""
        chosen = set(self._get_indices(indices))
        if self._single_envs is not None:
            old = self.get_attr(attr_name) if len(chosen) < self.num_envs else [value] * self.num_envs
            self._single_envs.set_attr(attr_name, [value if n in chosen else old[n] for n in range(self.num_envs)])
        elif len(chosen) < self.num_envs:
            raise ValueError(
                f"All {self.num_envs} environments share {attr_name!r}: it cannot be set for {sorted(chosen)} only."
            )
        else:
            setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Call a method of the environments, also of those that are not chosen where they run in processes of their own, as
        Gymnasium does; if the vector environment is not made of single ones its own method, once.
        """
        chosen = self._get_indices(indices)
        if isinstance(self._single_envs, gym.vector.SyncVectorEnv):
            return [method(*method_args, **method_kwargs) for method in self.get_attr(method_name, indices)]
        if self._single_envs is not None:
            self._check_attr(method_name)
            results = self._single_envs.call(method_name, *method_args, **method_kwargs)
        else:
            results = (getattr(self.env.unwrapped, method_name)(*method_args, **method_kwargs),) * self.num_envs
        return [results[n] for n in chosen]

    def _check_attr(self, name: str) -> None:
        """Asked for what is missing, the processes of single environments would end."""
        assert self._single_envs is not None
        if not all(self._single_envs.call("has_wrapper_attr", name)):
            raise AttributeError(f"{self._single_envs} has environments without {name!r}.")

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Tell which environments are wrapped; of those in processes of their own none is known to be."""
        envs = getattr(self.env.unwrapped, "envs", None)
        return [envs is not None and is_wrapped(envs[n], wrapper_class) for n in self._get_indices(indices)]


def in_processes(env: VecEnv) -> bool:
    """Tell whether each environment runs in a process of its own."""
    inner = env.unwrapped
    return isinstance(inner, SubprocVecEnv) or (
        isinstance(inner, GymnasiumVecEnv) and isinstance(inner.env.unwrapped, gym.vector.AsyncVectorEnv)
    )


def env_specs(env: VecEnv) -> list[EnvSpec | None]:
    """Gymnasium's specifications, where the environments run in this process."""
    # A specification that cannot be pickled, as with a lambda as entry point, would end the process of its environment
    if not in_processes(env):
        # A vector environment of somebody else may have no attributes
        with suppress(AttributeError, NotImplementedError):
            return env.get_attr("spec")
    return [None] * env.num_envs


def wrappers_of(env: VecEnv) -> list[Any]:
    """The wrappers of a vector environment and of its first single one in this process, the outermost first."""
    wrappers: list[Any] = []
    inner: Any = env
    while True:
        if isinstance(inner, (VecEnvWrapper, gym.Wrapper, gym.vector.VectorWrapper)):
            wrappers.append(inner)
        elif not isinstance(inner, (GymnasiumVecEnv, DummyVecEnv, gym.vector.SyncVectorEnv)):
            return wrappers
        inner = inner.venv if isinstance(inner, VecEnvWrapper) else inner.envs[0] if hasattr(inner, "envs") else inner.env


def _unbatched(batch: dict[str, Any], rows: np.ndarray) -> list[dict[str, Any]]:
    """The infos of single environments."""
    names, columns, partial = [], [], []
    for name, values in batch.items():
        if name in ("final_obs", "final_info") or (name[:1] == "_" and name[1:] in batch):
            continue
        if isinstance(values, dict):
            column: list[Any] = _unbatched(values, rows)
        else:
            chosen = np.asarray(values)[rows]
            # Numbers as an environment of its own would return them
            column = chosen.tolist() if chosen.ndim == 1 else list(chosen)
        mask = batch.get(f"_{name}")
        if mask is None or mask[rows].all():
            names.append(name)
            columns.append(column)
        else:
            partial.append((name, column, mask[rows].tolist()))
    infos: list[dict[str, Any]] = [dict(zip(names, row, strict=False)) for row in zip(*columns, strict=True)]
    if not columns:
        infos = [{} for _ in rows]
    for name, column, holds in partial:
        for info, value, hold in zip(infos, column, holds, strict=True):
            if hold:
                info[name] = value
    return infos


def _copied(observations: Any) -> Any:
    # The replay buffer is filled one step later: an environment that reuses its arrays must not change them meanwhile
    if isinstance(observations, dict):
        return {name: _copied(part) for name, part in observations.items()}
    if isinstance(observations, th.Tensor):
        raise ValueError(
            "The vector environment returns tensors of torch, and Stable-Baselines3 takes arrays of numpy. Convert them: "
            "GymnasiumVecEnv(gymnasium.wrappers.vector.ArrayConversion(env, env_xp=torch, target_xp=numpy)). It needs "
            "pip install 'gymnasium[array-api]>=1.2'."
        )
    return np.array(observations)


def _of_one(observations: Any, n: int) -> Any:
    if isinstance(observations, dict):
        return {name: _of_one(part, n) for name, part in observations.items()}
    return observations[n]


def steps_as_one_batch(spec: EnvSpec) -> bool:
    """
    Tell whether all copies of an environment can be stepped by one call: it is registered with a vector environment that lets
    Stable-Baselines3 say when episodes start anew, and without wrappers that a vector environment would go without.
    """
    if spec.vector_entry_point is None or spec.max_episode_steps is not None or spec.additional_wrappers:
        return False
    entry_point = spec.vector_entry_point
    creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return "autoreset_mode" in inspect.signature(creator).parameters
